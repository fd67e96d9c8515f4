"""Views that do not belong, in cells of known truth: what links and contradicts them, and where they really stood."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade
from stitch.numerics import frames
from stitch.screening.linkage import Link, find_contradicting_views, linkage_of_links
from stitch.screening.motions import register_scan_pairs
from stitch.screening.placement import lies_in_a_line
from stitch.screening.snooping import snoop_views
from stitch.session.scan import prepare_scan

GATE, OFF = 2.5, 6
POSES = np.tile(np.eye(4), (3, 1, 1))
TOLERANCE, SIZE = 0.1, 100.0


@pytest.fixture(scope="module")
def cell():
    return captured_blade(11, views=12, pixels=60)


def with_mounts(own, change):
    T = np.array(own.T_reference_mount)
    return replace(own, T_reference_mount=change(T))


def test_a_good_session_loses_no_view(cell):
    measured, own = cell
    found = snoop_views(own, measured.T_mount, GATE)
    assert found.left_out == () and len(found.disconnected) == 1
    # 20 µm and 20 µrad were put in.
    assert 0.01 < found.translation < 0.04 and 1e-5 < found.rotation < 4e-5


def test_views_that_most_others_do_not_meet_stand_alone_and_groups_do_not(cell):
    measured, own = cell
    found = snoop_views(own, measured.T_mount, GATE)

    def alone(*groups):
        return replace(found, disconnected=groups).alone

    assert found.alone == ()
    assert alone(tuple(range(10)), (10,), (11,)) == (10, 11)
    assert alone(tuple(range(9)), (9, 10), (11,)) == ()
    assert alone((0, 1, 2), *((v,) for v in range(3, 12))) == ()


@pytest.mark.parametrize("shift", [1.0, 40.0])
def test_a_displaced_view_is_named_with_how_far_it_is_off(cell, shift):
    measured, own = cell
    twist = np.r_[0, 0, 0, shift * np.array([0.6, 0.0, 0.8])]

    def change(T):
        T[OFF] = frames.exp(twist) @ T[OFF]
        return T

    found = snoop_views(with_mounts(own, change), measured.T_mount, GATE)
    assert found.left_out == (OFF,)
    assert found.misplaced[0].distance == pytest.approx(shift, abs=0.15)


def test_a_scan_of_something_else_belongs_nowhere(cell):
    measured, own = cell
    xy = np.random.default_rng(0).uniform(-40, 40, (2000, 2))
    waves = prepare_scan("waves", np.column_stack([xy, 420 + 9 * np.sin(xy[:, 0] / 7)]))
    scans = (*own.scans[:OFF], waves, *own.scans[OFF + 1 :])
    found = snoop_views(replace(own, scans=scans), measured.T_mount, GATE)
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
    assert snoop_views(replace(own, scans=scans), measured.T_mount, GATE).left_out == (OFF,)


def test_motions_between_scans_are_those_of_the_cell(cell):
    measured, own = cell
    found = register_scan_pairs(own)
    poses = measured.T_reference_scanner
    true = np.array([frames.inverse(poses[v]) @ poses[w] for v, w in found.pairs])
    off = frames.angle_between(true, found.T)
    assert len(found.pairs) >= 8
    assert np.mean(off < 2e-3) > 0.7


def links(*pairs, share=1.0, count=100):
    return [Link(v, w, count, share) for v, w in pairs]


def test_a_chain_is_one_component_and_its_ends_hang_by_one_pair():
    found = linkage_of_links(5, links((0, 1), (1, 2), (2, 3), (3, 4)))
    assert found.components == ((0, 1, 2, 3, 4),)
    assert found.single == ((0, 1), (4, 3))


def test_in_a_ring_nothing_hangs_by_one_pair():
    found = linkage_of_links(6, links(*((v, (v + 1) % 6) for v in range(6))))
    assert (found.single, found.unlinked) == ((), ())


def test_two_rings_are_two_groups():
    found = linkage_of_links(7, links((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 6), (6, 3)))
    assert found.components == ((3, 4, 5, 6), (0, 1, 2))


def test_pairs_that_lie_near_without_closing_link_nothing():
    found = linkage_of_links(3, [*links((0, 1)), *links((1, 2), share=0.2)])
    assert found.unlinked == (2,)
    assert linkage_of_links(3, [*links((0, 1)), *links((1, 2), count=5)]).unlinked == (2,)


def test_a_view_without_any_pair_is_unlinked_and_not_a_group():
    found = linkage_of_links(3, links((0, 1)))
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
