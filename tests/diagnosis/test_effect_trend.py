"""The dots of a trend are measurements about the true displacement, the same for every candidate; its lines are not."""

import numpy as np
import pytest

from data_synth import kinematics
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.effect_trend import EffectTrend, expected_in_view, trends_of_candidates
from stitch.diagnosis.score import score
from stitch.effects.contract import EFFECTS, parameters_in
from stitch.model.model import Term
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import surfaces_of
from tests.diagnosis.freed_blade import FreedBlade, freed_blade

JOINT = 2


@pytest.fixture(scope="module")
def cells() -> list[FreedBlade]:
    return [freed_blade(seed, 14) for seed in (4, 5, 6)]


def _trends(linear: LinearModel, *effects: str) -> dict[str, EffectTrend]:
    candidates = [candidate_of(linear, EFFECTS[effect]) for effect in effects]
    return trends_of_candidates(linear, [score(linear, c) for c in candidates if c is not None])


def _with_gear(cell: FreedBlade) -> tuple[Array, Array]:
    """Return where the flange truly is, and would be without its error, T_base_flange (V, 4, 4)."""
    plan = cell.measured.plan
    joints = plan.joints.copy()
    joints[:, JOINT] += 2e-3 * np.sin(3 * joints[:, JOINT])
    return kinematics.flange(plan.arm, joints), kinematics.flange(plan.arm, plan.joints)


def _true_displacements(cell: FreedBlade, linear: LinearModel, true: Array, reported: Array) -> Array:
    """Return (V, 6) by how much the hidden law alone moves each view from where the fitted hand-eye puts it, a turn
    by what it does at the rim."""
    to_centre = frames.make(np.eye(3), -cell.freed.overlaps.gram.centre)
    T = [(frames.inverse(flange) if cell.measurement.eye_to_hand else flange) for flange in (true, reported)]
    T_true, T_reported = (to_centre @ flange @ cell.measured.T_mount for flange in T)
    twists = frames.log(T_true @ frames.inverse(T_reported)).reshape(-1, 1)
    white = linear.restricted(())
    moved = twists - (white.design @ white.baseline_trial.solve())[:, None]
    surfaces = surfaces_of(linear)
    assert surfaces is not None
    shown = linear.observation.expand(linear.reduce(moved)).reshape(-1, 6)
    shown[:, :3] *= surfaces.reach
    return shown


def test_dots_are_the_same_whatever_candidate_is_drawn(cells: list[FreedBlade]):
    """A wrong law does not run through its dots: they stay, and its line misses them."""
    true, _ = _with_gear(cells[0])
    trends = _trends(cells[0].seen(true), "gear_harmonic", "gear_eccentricity", "mount_drift", "joint_offset")
    first = trends["gear_harmonic"]
    assert len(trends) > 2 and (first.of, first.value_unit, first.follows) == ("joint 3", "rad", "angle of joint 3")
    np.testing.assert_allclose(first.at, np.degrees(cells[0].measured.plan.joints[:, JOINT]), atol=1e-9)
    for trend in trends.values():
        for dots in ("at", "measured", "sigma"):
            np.testing.assert_array_equal(getattr(trend, dots), getattr(first, dots))
    assert any(np.abs((t.measured - t.predicted) / t.sigma).max() > 5 for t in trends.values())


def test_dots_lie_about_the_true_displacement_within_their_sigma(cells: list[FreedBlade]):
    """Chi square a view is one: about the truth, not about the line of the candidate that happens to be drawn."""
    squares, about_wrong = [], []
    offset = EFFECTS["joint_offset"]
    for cell in cells:
        true, reported = _with_gear(cell)
        linear = cell.seen(true)
        trend = _trends(linear, "gear_harmonic")["gear_harmonic"]
        shown = _true_displacements(cell, linear, true, reported)
        turned = (
            linear.responses([Term(offset, parameters_in(linear.measurement, offset))])[0]
            .columns[:, JOINT]
            .reshape(-1, 6)
        )
        surfaces = surfaces_of(linear)
        assert surfaces is not None
        turned = turned * np.repeat([surfaces.reach, 1.0], 3)
        law = np.sum(turned * shown, axis=1) / np.sum(turned**2, axis=1)
        squares.append(np.mean(((trend.measured - law) / trend.sigma) ** 2))
        wrong = _trends(linear, "gear_harmonic", "gear_eccentricity")["gear_eccentricity"]
        about_wrong.append(np.mean(((wrong.measured - wrong.predicted) / wrong.sigma) ** 2))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)
    assert min(about_wrong) > 3


def test_a_further_view_where_one_stood_is_expected_about_where_that_one_is_predicted(cells: list[FreedBlade]):
    """A dot shows the visible directions of its view alone, a further view is expected with all of them."""
    true, _ = _with_gear(cells[0])
    linear = cells[0].seen(true)
    candidates = [candidate_of(linear, EFFECTS[name]) for name in ("gear_harmonic", "gear_eccentricity")]
    rivals = [score(linear, candidate) for candidate in candidates if candidate is not None]
    trends = trends_of_candidates(linear, rivals)
    trend = trends["gear_harmonic"]
    found = [expected_in_view(linear, rivals, joints) for joints in linear.measurement.views.joints]
    views = [view for view in found if view is not None]
    assert [view.at for view in views] == pytest.approx(trend.at)
    assert np.corrcoef([view.expected["gear_harmonic"][0] for view in views], trend.predicted)[0, 1] > 0.9
    assert min(view.expected["gear_harmonic"][1] for view in views) > 0 and min(view.sigma for view in views) > 0


def test_a_slip_is_a_step_of_its_size_in_the_order_of_views(cells: list[FreedBlade]):
    """The part is on the flange: it sits elsewhere from view 8 on, where the scanner of the first views was."""
    plan = cells[0].measured.plan
    T_base_flange = kinematics.flange(plan.arm, plan.joints)
    moved = np.array([0, 0, 0, 0.15, -0.1, 0.05])
    T_base_flange[8:] = T_base_flange[8:] @ frames.exp(moved)
    trend = _trends(cells[0].seen(T_base_flange), "part_slip")["part_slip"]
    assert (trend.of, trend.follows) == ("the part", "view order") and list(trend.views) == list(range(14))
    np.testing.assert_allclose(trend.effect[:8], 0, atol=1e-3)
    assert trend.effect[8:].mean() == pytest.approx(np.linalg.norm(moved[3:]), rel=0.15)
    assert np.abs(trend.measured - trend.predicted).max() < 4 * trend.sigma.max()
