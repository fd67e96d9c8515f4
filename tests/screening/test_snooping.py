"""Views that do not belong, in cells of known truth: what links and contradicts them, and where they really stood.

What happened to views that do not belong, and how that is said: steps, exchanged scans, sizes, lists of names.

Where a scan closes among the others: at places that look alike, and together with its group.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pykdtree.kdtree import KDTree

from data_synth.fixtures.blade_cells import captured_blade
from stitch.numerics import frames
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.screening.linkage import find_contradicting_views, linkage_of_pairs, pair_holds
from stitch.screening.motions import register_scan_pairs
from stitch.screening.pairing import exchange_cycles, exchanged_pairs
from stitch.screening.placement import (
    ReferenceSurface,
    closed_placements,
    has_rival,
    lies_in_a_line,
    place_groups,
    place_scan,
)
from stitch.screening.plausibility import apply_displacement_limits
from stitch.screening.problems import SessionProblem, displacement_text, list_views
from stitch.screening.snooping import MisplacedView, snoop_views
from stitch.session.scan import prepare_scan

GATE, OFF = 2.5, 6
POSES = np.tile(np.eye(4), (3, 1, 1))
TOLERANCE, SIZE = 0.1, 100.0
NAMES = [f"v{v:03d}" for v in range(104)]
PART_SIZE = 120.0
PLACES_SLIP = np.array([0.004, -0.003, 0.005, 2.0, -2.0, 1.0])


@pytest.fixture(scope="module")
def cell():
    return captured_blade(11, views=12, pixels=60)


def with_mounts(own, change):
    T = np.array(own.T_reference_mount)
    return replace(own, T_reference_mount=change(T))


def snooped(own, T_mount):
    return snoop_views(own, T_mount, unconstrained_poses(own, own.poses(T_mount), GATE))


def test_a_good_session_loses_no_view(cell):
    measured, own = cell
    found = snooped(own, measured.T_mount)
    assert found.left_out == () and len(found.disconnected) == 1
    # 20 µm and 20 µrad were put in.
    assert 0.01 < found.translation < 0.04 and 1e-5 < found.rotation < 4e-5


def test_views_that_most_others_do_not_meet_stand_alone_and_groups_do_not(cell):
    measured, own = cell
    found = snooped(own, measured.T_mount)

    def alone(*groups):
        return replace(found, disconnected=groups).alone

    assert found.alone == ()
    assert alone(tuple(range(10)), (10,), (11,)) == (10, 11)
    assert alone(tuple(range(9)), (9, 10), (11,)) == ()
    assert alone((0, 1, 2), *((v,) for v in range(3, 12))) == ()


@pytest.mark.parametrize(("at_least", "left_out"), [((0.0, 0.5), ()), ((0.0, 500.0), (3,)), ((0.5, 0.0), (3,))])
def test_a_suspected_view_is_left_out_where_no_arm_errs_as_much(cell, at_least, left_out):
    measured, own = cell
    found = snooped(own, measured.T_mount)
    suspected = MisplacedView(3, "displaced", *at_least, None, at_least)
    judged = apply_displacement_limits(SimpleNamespace(length_unit="mm"), replace(found, suspected=(suspected,)))
    assert judged.left_out == left_out and len(judged.suspected) == 1 - len(left_out)


@pytest.mark.parametrize("shift", [1.0, pytest.param(40.0, marks=pytest.mark.slow)])
def test_a_displaced_view_is_named_with_how_far_it_is_off(cell, shift):
    measured, own = cell
    twist = np.r_[0, 0, 0, shift * np.array([0.6, 0.0, 0.8])]

    def change(T):
        T[OFF] = frames.exp(twist) @ T[OFF]
        return T

    found = snooped(with_mounts(own, change), measured.T_mount)
    assert found.left_out == (OFF,)
    assert found.misplaced[0].distance == pytest.approx(shift, abs=0.15)


def test_a_scan_of_something_else_belongs_nowhere(cell):
    measured, own = cell
    xy = np.random.default_rng(0).uniform(-40, 40, (2000, 2))
    waves = prepare_scan("waves", np.column_stack([xy, 420 + 9 * np.sin(xy[:, 0] / 7)]))
    scans = (*own.scans[:OFF], waves, *own.scans[OFF + 1 :])
    found = snooped(replace(own, scans=scans), measured.T_mount)
    assert [(m.view, m.kind) for m in found.misplaced] == [(OFF, "foreign")]


def test_a_scan_of_a_line_on_the_surface_holds_no_pose(cell):
    """It lies on the surface of the others, as it would if it were turned about itself."""
    measured, own = cell
    scan = own.scans[OFF]
    # Of the scan's own points those near one scan line, drawn into it.
    along = scan.points[scan.usable][:400] - scan.points[scan.usable][:400].mean(axis=0)
    direction = np.linalg.svd(along, full_matrices=False)[2][0]
    line = scan.points.mean(axis=0) + np.linspace(-5, 5, 400)[:, None] * direction
    assert lies_in_a_line(prepare_scan("line", line)) and not lies_in_a_line(scan)
    scans = (*own.scans[:OFF], prepare_scan("line", line), *own.scans[OFF + 1 :])
    assert snooped(replace(own, scans=scans), measured.T_mount).left_out == (OFF,)


def test_motions_between_scans_are_those_of_the_cell(cell):
    measured, own = cell
    found = register_scan_pairs(own)
    poses = measured.T_reference_scanner
    true = np.array([frames.inverse(poses[v]) @ poses[w] for v, w in found.pairs])
    off = frames.angle_between(true, found.T)
    assert len(found.pairs) >= 8
    assert np.mean(off < 2e-3) > 0.7


def test_a_chain_is_one_component_and_its_ends_hang_by_one_pair():
    found = linkage_of_pairs(5, [(0, 1), (1, 2), (2, 3), (3, 4)])
    assert found.components == ((0, 1, 2, 3, 4),)
    assert found.only_links == ((0, 1), (4, 3))


def test_in_a_ring_nothing_hangs_by_one_pair():
    found = linkage_of_pairs(6, [(v, (v + 1) % 6) for v in range(6)])
    assert (found.only_links, found.unlinked) == ((), ())


def test_two_rings_are_two_groups():
    found = linkage_of_pairs(7, [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 6), (6, 3)])
    assert found.components == ((3, 4, 5, 6), (0, 1, 2))


def test_pairs_that_lie_near_without_closing_link_nothing():
    assert pair_holds(100, 100)
    assert not pair_holds(100, 500) and not pair_holds(5, 5) and not pair_holds(0, 0)


def test_a_view_without_any_pair_is_unlinked_and_not_a_group():
    found = linkage_of_pairs(3, [(0, 1)])
    assert found.unlinked == (2,)


def plate(x=(-40.0, 40.0), raised=0.0, of=lambda x, y: x > 0):
    """Points every 2 mm of a plate 300 mm before the scanner, some of them nearer."""
    x, y = (c.ravel() for c in np.meshgrid(np.arange(*x, 2.0), np.arange(-40.0, 40.0, 2.0)))
    return prepare_scan("plate", np.c_[x, y, 300.0 - raised * of(x, y)])


def asked(scan):
    return find_contradicting_views([plate(), scan, plate()], POSES, TOLERANCE, SIZE)


def test_plates_in_one_place_do_not_contradict():
    assert asked(plate()) == ()


def test_half_of_a_scan_that_stands_elsewhere_is_told_near_and_far():
    for raised in (-8.0, -1.0, 1.0, 5.0, 8.0):
        assert asked(plate(raised=raised)) == (1,)


def test_a_few_points_that_others_show_tell_nothing():
    """Of a scan beside the others they show one row alone, and that elsewhere."""
    beside = plate(x=(36.0, 60.0), raised=2.0, of=lambda x, y: (x < 40) & (np.abs(y) < 4))
    assert asked(beside) == ()


def test_groups_that_stand_apart_do_not_contradict_each_other():
    poses = POSES.copy()
    poses[2] = frames.exp(np.array([0, 0, 0, 0, 0, 3.0]))
    assert find_contradicting_views([plate()] * 3, poses, TOLERANCE, SIZE) == (2,)
    assert find_contradicting_views([plate()] * 3, poses, TOLERANCE, SIZE, groups=[(0, 1), (2,)]) == ()


def misplaced(*views):
    return [MisplacedView(v, "displaced", 0.1, 5.0, np.eye(4)) for v in views]


def test_scans_in_each_others_rows_are_closed_rounds():
    assert exchange_cycles({2: 6, 6: 2, 4: None}) == [(2, 6)]
    assert exchange_cycles({1: 5, 5: 8, 8: 1}) == [(1, 5, 8)]


def test_one_of_two_may_show_too_little():
    assert exchanged_pairs({8: 1, 1: None}, misplaced(1, 8)) == [(8, 1)]


def test_a_row_that_two_scans_claim_is_nobodys():
    assert exchanged_pairs({8: 1, 7: 1, 1: None}, misplaced(1, 7, 8)) == []


def test_a_row_whose_own_scan_belongs_is_not_changed():
    assert exchanged_pairs({8: 1}, misplaced(8)) == []


@pytest.mark.parametrize(
    ("best", "least", "said"),
    [
        ((1e-6, 5.002), (0.0, 4.981), "5 mm"),
        ((0.03, 3.25), (0.002, 1.2), "at least 1.2 mm and 2 mrad"),
        ((np.radians(109), 50.0), (np.radians(108.6), 17.0), "at least 17 mm and 109°"),
        ((np.radians(2), 5.0), (np.radians(2), 5.0), "5 mm and 2.0°"),
        ((1e-5, 0.02), (1e-6, 0.0006), ""),
    ],
)
def test_a_size_is_told_as_far_as_it_is_held(best, least, said):
    assert displacement_text(best, least, "mm") == said


def test_views_in_a_row_are_a_range_and_two_are_not():
    assert list_views(NAMES[:103], NAMES) == "v000–v102"
    assert list_views([*NAMES[2:5], *NAMES[7:9], NAMES[20]], NAMES) == "v002–v004, v007, v008, v020"


def test_a_row_is_one_of_the_session_and_not_of_the_names():
    assert list_views(["v1", "v2", "v3"], ["v1", "x", "v2", "v3"]) == "v1, v2, v3"


def test_the_rest_of_many_is_counted():
    assert list_views(NAMES[::2], NAMES) == "v000, v002, v004, v006, v008, v010 … and 46 more"
    assert list_views([*NAMES[:20:2], *NAMES[50:]], NAMES).endswith("v010 … and 58 more")


def test_a_problem_lists_its_views_so():
    assert (
        SessionProblem("disconnected", tuple(NAMES[1:]), "add views").line(NAMES)
        == "disconnected (v001–v103): add views"
    )


def turned(degrees):
    return frames.exp(np.array([0, 0, np.radians(degrees), 0, 0, 0]))


def shown(height, low, high, count):
    """Points and normals of a wall of radius 50 + height(angle), between two angles in degrees."""
    rng, step = np.random.default_rng(0), 1e-6
    angle, z = np.radians(rng.uniform(low, high, count)), rng.uniform(-30, 30, count)
    around, out = np.array([np.cos(angle), np.sin(angle)]), 50 + height(angle)
    slope = (height(angle + step) - height(angle - step)) / (2 * step)
    normal = out * around - slope * np.array([-np.sin(angle), np.cos(angle)])
    points = np.column_stack([*(out * around), z])
    return points, np.column_stack([*(normal / np.linalg.norm(normal, axis=0)), 0 * z])


@pytest.mark.parametrize(
    ("height", "alike"),
    [
        (lambda t: 1.5 * np.cos(24 * t), True),
        (lambda t: 8 * np.exp(-(((t - 1.5) / 0.2) ** 2)) + 1.5 * np.cos(3 * t), False),
    ],
)
def test_places_that_are_alike_are_rivals(height, alike):
    points, normals = shown(height, 0, 180, 12_000)
    surface = ReferenceSurface(points, normals, KDTree(points), 1.0, 0.3)
    scan = prepare_scan("view", shown(height, 60, 110, 4_000)[0], eye=np.array([0, 300.0, 0]))
    found = place_scan(scan, surface, np.array([turned(a) for a in (-30, -15, 0, 15, 30)]), PART_SIZE)
    closed = closed_placements(scan, found, turned(-95)[None], 0.8, PART_SIZE)
    assert closed and has_rival(scan, closed[0], closed, PART_SIZE) == alike


def test_a_group_moves_back_as_one(blade_capture):
    measured, capture = blade_capture
    poses = capture.poses(measured.T_mount)
    views, half = len(poses), len(poses) // 2
    apart = poses.copy()
    apart[half:] = frames.exp(PLACES_SLIP) @ poses[half:]
    chains = [range(half), range(half, views)]
    linked = linkage_of_pairs(views, [(v, v + 1) for chain in chains for v in chain[:-1]])
    placed = place_groups(capture, apart, linked, 0.1, 0.7)
    moved, kept = (placed, set(range(views)) - set(placed))
    assert set(moved) in (set(chains[0]), set(chains[1]))
    # One common motion brings them back to the others, which stay where they are.
    stay = min(kept)
    G = apart[stay] @ frames.inverse(poses[stay])
    for v, placement in placed.items():
        middle = capture.scans[v].points.mean(axis=0)[None]
        off = frames.transform(placement.T, middle) - frames.transform(G @ poses[v], middle)
        assert np.linalg.norm(off) < 0.15
