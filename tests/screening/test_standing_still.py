"""What stands still before the scanner: walls of known place in simulated scans, and surfaces that only look still."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.screening.background import find_standing_scene, find_static_background
from stitch.screening.deep_check import deep_check
from stitch.session.capture import part_size, prepare_capture
from stitch.session.scan import prepare_scan
from stitch.session.session import Cloud

TOLERANCE = 0.1
SIDE = np.arange(-40.0, 40.0, 1.0)
GRID = np.stack(np.meshgrid(SIDE, SIDE), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def measured():
    return measured_blade(21, views=12, pixels=80)


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
    assert found.kind == "foreign" and len(found.views) == 12
    assert "stands still before the scanner" in found.fix and "state within = [[" in found.fix


def test_a_wall_behind_the_part_is_said_first_with_the_box_that_leaves_it_out(measured):
    session, depth = before_wall(session_of(measured), 40.0, 25.0)
    found = run(session)
    said = run_verdict(found, model_history(found))
    assert "of what the scans show stands still before the scanner: a wall" in said
    assert "12 views show it" in said and "may hold the rest of it; to fix: state within = [[" in said
    scans, poses = prepare_capture(session), found.model.T_mount
    still = find_static_background(scans.scans, scans.poses(poses), TOLERANCE, part_size([scans]))
    shown = np.mean(np.abs(np.concatenate([view.cloud.points for view in session.views])[:, 2] - depth) < 0.2)
    assert still.share == pytest.approx(shown, abs=0.05)
    assert still.box[:, 2] == pytest.approx([depth, depth], abs=0.2)
    without = cut(session, still.within)
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
