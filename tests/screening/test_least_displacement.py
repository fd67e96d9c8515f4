"""The smallest displacement that evidence admits, against the closed form of poses that are observed directly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated, with_part
from data_synth.scene import load_scene
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.numerics.reml import at_variances
from stitch.screening.pose_tests import find_blunders, least_displacement
from tests.screening.direct_views import direct_views

VIEWS, SIGMA, OFF = 20, 0.02, 7


def direct(shown, blunder, seed=0):
    """All poses observed directly, the mean of all the unknown hand-eye; of one view each direction is shown by a share."""
    reduction = np.eye(6 * VIEWS)
    reduction[6 * OFF : 6 * OFF + 6, 6 * OFF : 6 * OFF + 6] = np.diag(np.sqrt(shown))
    moved = reduction[:, 6 * OFF : 6 * OFF + 6] @ blunder
    return direct_views(SIGMA * np.random.default_rng(seed).standard_normal(6 * VIEWS) + moved, reduction)


def least(model):
    found = replace(find_blunders(model), fit=at_variances(model.mixed(), np.array([SIGMA**2, SIGMA**2, 1.0])))
    return least_displacement(model, found, [], (), OFF, np.zeros(3))


def test_what_every_direction_shows_is_shorter_by_the_radius_of_its_confidence():
    rotation, shift = least(direct(np.ones(6), np.array([0, 0, 0, 3.0, 0, 4.0])))
    radius = SIGMA * np.sqrt(6 * stats.f.isf(0.01, 6, 6 * VIEWS - 12) / (1 - 1 / VIEWS))
    assert shift == pytest.approx(5.0 - radius, abs=3 * SIGMA) and rotation < 3 * SIGMA


def test_less_than_chance_makes_is_none():
    assert least(direct(np.ones(6), np.zeros(6))) == (0.0, 0.0)


def test_a_direction_in_which_nothing_holds_the_view_has_no_size():
    """A thousandth of it is seen: what noise makes of that would be thirty times as much."""
    shown = np.array([1, 1, 1, 1e-3, 1, 1])
    rotation, shift = least(direct(shown, np.array([0, 0, 0, 30.0, 0, 1.0])))
    assert shift < 1.0 and rotation < 3 * SIGMA


@pytest.mark.slow
def test_scans_that_slide_along_a_plate_cost_no_view_beside_backlash():
    """All slid about the plate's axis by 4 mrad and more, and five of the views that backlash displaces were left out."""
    scene = load_scene("blade-table")
    scene = replace(scene, scanner=replace(scene.scanner, columns=120, rows=120))
    plate = with_part(scene, "curved_drill_plate", length=150.0, width=120.0, pitch=36.0, radius=150.0)
    assert run(session_of(simulated(plate, {"backlash": 3.0}, 9042, 14))).left_out == ()


@pytest.mark.slow
def test_views_behind_a_step_are_not_called_displaced_where_the_part_looks_alike():
    """From half way on a plate sits 3 mm elsewhere; three right scans of its other side were called 120° off."""
    scene = load_scene("blade-table")
    scene = replace(scene, scanner=replace(scene.scanner, columns=120, rows=120))
    plate = with_part(scene, "curved_drill_plate", length=150.0, width=120.0, pitch=36.0, radius=150.0)
    session, views = session_of(simulated(plate, {}, 9086, 12)), []
    rng = np.random.default_rng([9086, 11])
    turn, shift = rng.standard_normal((2, 3))
    K = frames.exp(np.r_[6e-3 * turn / np.linalg.norm(turn), 3 * shift / np.linalg.norm(shift)])
    for v, view in enumerate(session.views):
        T = view.T_base_flange if v < 6 else K @ view.T_base_flange
        views.append(replace(view, T_base_flange=T, joints=None))
    gone = run(replace(session, views=tuple(views))).left_out
    assert gone and all("clamped anew between v005 and v006" in item.why for item in gone)
