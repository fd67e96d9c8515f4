"""What scans show beside the part: squares and walls of known place in simulated scans, and what only looks still."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.screening.background import find_occluder, find_standing_scene, find_static_background
from stitch.screening.deep_check import deep_check
from stitch.session.capture import part_size, prepare_capture
from stitch.session.scan import prepare_scan
from stitch.session.session import Cloud

BLADE_VIEWS, SQUARE_SIDE, SQUARE_POINTS = 10, 8.0, 300
TOLERANCE = 0.1
SIDE = np.arange(-40.0, 40.0, 1.0)
GRID = np.stack(np.meshgrid(SIDE, SIDE), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def blade():
    return measured_blade(21, views=BLADE_VIEWS, pixels=60)


def with_squares(blade, shown_by):
    """Some scans with a square before the part, on the way to another scanner; in each before another one."""
    session, T = session_of(blade), blade.T_reference_scanner
    rng, views = np.random.default_rng(3), list(session.views)
    for v in shown_by:
        other = (v + BLADE_VIEWS // 2) % BLADE_VIEWS
        flat = np.column_stack(
            [rng.uniform(-SQUARE_SIDE / 2, SQUARE_SIDE / 2, (SQUARE_POINTS, 2)), np.zeros(SQUARE_POINTS)]
        )
        square = 0.8 * session.views[other].cloud.points.mean(axis=0) + flat
        here = frames.transform(frames.inverse(T[v]) @ T[other], square)
        views[v] = replace(views[v], cloud=Cloud(np.concatenate([views[v].cloud.points, here])))
    return replace(session, views=tuple(views))


def found_in(blade, session):
    own = prepare_capture(session)
    return find_occluder(own.scans, blade.T_reference_scanner, part_size([own]))


def test_nothing_is_in_the_way_of_a_good_session(blade):
    assert found_in(blade, session_of(blade)) is None


@pytest.mark.parametrize("shown_by", [(4,), (1, 6), range(BLADE_VIEWS)])
def test_what_others_look_through_is_said_with_the_views_and_its_share(blade, shown_by):
    session = with_squares(blade, shown_by)
    views, share = found_in(blade, session)
    # A square that its scan sees from the edge has no normals, and does not count.
    assert set(views) <= set(shown_by) and len(views) >= 0.5 * len(shown_by)
    shares = [SQUARE_POINTS / len(session.views[v].cloud.points) for v in shown_by]
    # Only what has the part behind it is looked through.
    assert 0.3 * np.mean(shares) < share < 1.3 * np.mean(shares)


@pytest.mark.parametrize(("edge", "in_the_way_of_it"), [(30.0, True), (0.0, False)])
def test_what_stands_beside_all_looks_is_looked_through_by_none(edge, in_the_way_of_it):
    """A strip before a wall, and one beside its end, where a face too steep to be seen may lead to it."""
    x, y = np.meshgrid(np.arange(-60.0, edge + 0.5), np.arange(-40.0, 40.5))
    wall = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 500.0)])
    # Its rays pass the wall's end by less than the wall's points lie apart.
    x, y = np.meshgrid(np.linspace(0.2, 1.0, 5), np.linspace(-20.0, 20.0, 60))
    strip = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 500.0)]) * 0.9
    scans = [prepare_scan("wall", wall), prepare_scan("strip", np.concatenate([strip, wall[:3000]]))]
    found = find_occluder(scans, np.tile(np.eye(4), (2, 1, 1)), 100.0)
    assert (found is not None and found[0] == (1,)) == in_the_way_of_it


def test_a_run_and_a_deep_check_say_it_alike(blade):
    session = with_squares(blade, (4,))
    (said,) = run(session).doubts
    assert "of what v004 shows stands where other scans see through" in said
    assert [(p.kind, p.views) for p in deep_check(session)] == [("foreign", ("v004",))]


@pytest.fixture(scope="module")
def measured():
    return measured_blade(21, views=8, pixels=80)


def before_wall(session, width, behind):
    """Every scan with the same square wall behind the part, in the scanner's frame."""
    rng = np.random.default_rng(3)
    every = np.concatenate([view.cloud.points for view in session.views])
    place = np.append(every.mean(axis=0)[:2], every[:, 2].max() + behind)

    def with_wall(points):
        flat = GRID[np.abs(GRID).max(axis=1) < width / 2]
        wall = place + np.column_stack([flat, 0.02 * rng.standard_normal(len(flat))])
        return Cloud(np.concatenate([points, wall]))

    views = [replace(view, cloud=with_wall(view.cloud.points)) for view in session.views]
    return replace(session, views=tuple(views)), place[2]


def cut(session, box):
    views = [replace(view, cloud=view.cloud.within(np.array(box))) for view in session.views]
    return replace(session, views=tuple(views))


@pytest.mark.slow
def test_check_deep_says_of_a_wall_what_a_run_says(measured):
    session, _ = before_wall(session_of(measured), 40.0, 25.0)
    (found,) = deep_check(session)
    assert found.kind == "foreign" and len(found.views) == 8
    assert "stands still before the scanner" in found.fix and "state within = [[" in found.fix


def test_a_wall_behind_the_part_is_said_first_with_the_box_that_leaves_it_out(measured):
    session, depth = before_wall(session_of(measured), 40.0, 25.0)
    found = run(session)
    said = run_verdict(found, model_history(found))
    assert "of what the scans show stands still before the scanner: a wall" in said
    assert "8 views show it" in said and "may hold the rest of it; to fix: state within = [[" in said
    scans, poses = prepare_capture(session), found.model.T_mount
    share, _, box, within = find_static_background(scans.scans, scans.poses(poses), TOLERANCE, part_size([scans]))
    shown = np.mean(np.abs(np.concatenate([view.cloud.points for view in session.views])[:, 2] - depth) < 0.2)
    assert share == pytest.approx(shown, abs=0.05)
    assert box[:, 2] == pytest.approx([depth, depth], abs=0.2)
    without = cut(session, within)
    assert [v.cloud.count for v in without.views] == [v.cloud.count for v in session_of(measured).views]
    assert run(without).doubts == ()


def test_without_a_wall_nothing_stands_still(measured):
    own = prepare_capture(session_of(measured))
    assert find_static_background(own.scans, own.poses(measured.T_mount), TOLERANCE, part_size([own])) is None


def scans_of(shape):
    rng = np.random.default_rng(0)
    return [prepare_scan(str(v), shape + [0, 0, 300] + 0.02 * rng.standard_normal(shape.shape)) for v in range(12)]


@pytest.mark.parametrize("overlap", [0.3, 0.05])
def test_a_plate_that_slides_along_itself_does_not_stand_still(overlap):
    step = 80 * (1 - overlap)
    poses = np.array([frames.make(np.eye(3), [step * i, step * j, 0]) for i in range(4) for j in range(3)])
    flat = np.column_stack([GRID, np.zeros(len(GRID))])
    assert find_static_background(scans_of(flat), poses, TOLERANCE, 300.0) is None


def test_a_disc_that_turns_about_its_axis_does_not_stand_still():
    radius = np.linalg.norm(GRID, axis=1)
    disc = np.column_stack([GRID, 3 * np.cos(radius / 5)])[radius < 38]
    turned = frames.exp(np.array([[0, 0, 0.5 * v, 0, 0, 0] for v in range(12)]))
    assert find_static_background(scans_of(disc), turned, TOLERANCE, 80.0) is None


def before_a_table(moved, table):
    """Scans (moved, a shift for each) of a patch of 40 mm before a table of 80 mm, at 300 and 360 mm."""
    rng = np.random.default_rng(5)
    patch = np.column_stack([GRID / 2, 3 * np.cos(GRID[:, 0] / 5)])
    flat = np.column_stack([GRID, np.full(len(GRID), 60.0)])
    shapes = [np.concatenate([patch + shift, flat[: table * len(flat)]]) + np.array([0, 0, 300]) for shift in moved]
    return [prepare_scan(str(v), shape + 0.02 * rng.standard_normal(shape.shape)) for v, shape in enumerate(shapes)]


def test_a_table_that_fills_the_view_has_a_box_without_it():
    moved = np.random.default_rng(6).uniform(-30, 30, (8, 3))
    share, box = find_standing_scene(before_a_table(moved, 1))
    assert 0.4 < share < 0.6
    part = (moved[:, None] + np.array([[-20, -20, 297], [20, 20, 303]])).reshape(-1, 3)
    assert (box[0] < part.min(axis=0)).all() and (part.max(axis=0) < box[1]).all() and box[1, 2] < 360


def test_a_part_that_moves_has_no_standing_scene():
    assert find_standing_scene(before_a_table(np.random.default_rng(6).uniform(-30, 30, (8, 3)), 0)) is None
    assert find_standing_scene(before_a_table(np.zeros((8, 3)), 1)) is None
