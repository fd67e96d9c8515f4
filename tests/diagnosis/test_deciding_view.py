"""The view that decides: odds against a closed form, predictions against views that were taken, poses within reach.

The dots of a trend are measurements about the true displacement, the same for every candidate; its lines are not.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import stitch
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, plan_for
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.diagnosis import deciding_view
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.deciding_view import (
    Prediction,
    RivalForms,
    competing_forms,
    deciding_views,
    possible_joints,
    predict_views,
    unnamed_joints,
)
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.effect_trend import expected_in_view, trend_in_model, trends_of_candidates
from stitch.diagnosis.fitted_effect import EffectTrend
from stitch.diagnosis.score import score
from stitch.diagnosis.thresholds import ODDS
from stitch.effects.contract import EFFECTS, parameters_in
from stitch.model.model import Term
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.session.capture import build_capture
from tests.diagnosis.freed_blade import FreedBlade, freed_blade

VIEWS, FURTHER, PIXELS = 12, 3, 110
JOINT = 2


def prediction(mean, sigma):
    """Of one view with one number, which scatters alone."""
    return Prediction(np.array([[mean]]), np.full((1, 1, 1, 1), sigma**2), np.zeros((1, 1, 0)))


def alike(count):
    """Rivals of one form each, equally likely."""
    return RivalForms([], np.zeros(count), np.arange(count), np.zeros(count))


@pytest.mark.parametrize("apart", [2.0, 3.0, 5.0])
def test_the_odds_of_two_rivals_that_differ_in_one_number_are_those_of_the_closed_form(apart):
    """The log likelihood ratio of two normals δ sigmas apart is itself normal: mean δ²/2, variance δ²."""
    draws = np.random.default_rng(0).standard_normal((40_000, 1))
    rivals = [prediction(0.0, 0.02), prediction(0.02 * apart, 0.02)]
    right, _ = deciding_view._simulate_decisions(rivals, alike(2), [], np.zeros(1, int), draws)
    assert right[0] == pytest.approx(norm.cdf((apart**2 / 2 - ODDS) / apart), abs=0.01)


def test_a_view_in_which_the_rivals_expect_the_same_decides_nothing():
    draws = np.random.default_rng(0).standard_normal((1000, 1))
    rivals = [prediction(0.1, 0.02), prediction(0.1, 0.02)]
    right, share = deciding_view._simulate_decisions(rivals, alike(2), [], np.zeros(1, int), draws)
    assert (right[0], share[0]) == (0.0, 0.5)


def test_a_rival_that_may_take_the_form_of_another_leaves_that_one_unnamed():
    """With half of its weight on the same prediction no view makes the other more than twice as likely."""
    draws = np.random.default_rng(0).standard_normal((20_000, 1))
    predictions = [prediction(0.0, 0.02), prediction(0.0, 0.02), prediction(0.4, 0.02)]
    forms = RivalForms([], np.log([0.5, 0.25, 0.25]), np.array([0, 1, 1]), np.zeros(2))
    right, share = deciding_view._simulate_decisions(predictions, forms, [], np.zeros(1, int), draws)
    assert right[0] == pytest.approx(0.25, abs=1e-3)
    assert share[0] == pytest.approx(0.5 * 2 / 3 + 0.25 / 3 + 0.25, abs=1e-3)


def test_what_is_believed_of_a_rival_makes_it_harder_to_name_and_the_other_no_easier():
    draws = np.random.default_rng(0).standard_normal((40_000, 1))
    rivals = [prediction(0.0, 0.02), prediction(0.06, 0.02)]
    belief = np.log([1.0, 0.04])
    for true, harder in ((0, 0.0), (1, np.log(25.0))):
        weights = np.where(np.arange(2) == true, 0.0, -50.0)
        forms = RivalForms([], weights, np.arange(2), belief)
        right, _ = deciding_view._simulate_decisions(rivals, forms, [], np.zeros(1, int), draws)
        # The weights take the other for out of the question by 50 nats: what is left to decide is that less.
        fair = replace(forms, log_belief=belief * 0)
        assert right[0] == deciding_view._simulate_decisions(rivals, fair, [], np.zeros(1, int), draws)[0][0]
        ahead = np.array([[3.5], [0.0]]) if true == 0 else np.array([[0.0], [3.5]])
        assert forms.margins(ahead)[true, 0] == pytest.approx(3.5 - harder)


@pytest.fixture(scope="module")
def cell():
    """A cell with an uneven gear: what its first views tell, and further ones that were taken."""
    scene = clean("blade", rays=60)
    plan, rail = plan_for(scene, 3, VIEWS + FURTHER)
    measured = simulate(scene, {"gear_eccentricity": 1.5}, 3, planned=(plan, rail))
    session = session_of(measured)
    run = stitch.run(replace(session, views=session.views[:VIEWS]))
    return stitch.diagnose(run), measured, plan, run


def rivals_of(found):
    """As if the first views told them not apart at all, both as likely as the better one."""
    named = [c.ranked for c in found.candidates if c.name in ("gear_eccentricity", "gear_harmonic")]
    likelier = max(ranked.log_posterior for ranked in named)
    return [replace(ranked, log_posterior=likelier) for ranked in named]


def test_what_is_expected_of_a_further_view_is_what_it_shows_within_what_is_known(cell):
    """True poses of the generator, whose kinematics are its own: squares in units of the covariance stay small."""
    found, measured, plan, _ = cell
    linear = found.linear
    (true,) = [ranked for ranked in rivals_of(found) if ranked.name == "gear_eccentricity"]
    expected = predict_views(linear, [true.score], plan.joints[VIEWS:], np.zeros(FURTHER))[0]
    to_centre = frames.make(np.eye(3), -linear.observation.centre)
    model = build_capture("all", (), measured.T_base_flange, linear.measurement.mount).poses(linear.model.T_mount)
    twists = frames.log(to_centre @ measured.T_reference_scanner @ frames.inverse(to_centre @ model))
    seen = twists[VIEWS:] - twists[:VIEWS].mean(axis=0)
    mean, covariance = expected.of_sets([0, 1], np.array([2]))
    off = seen.ravel() - mean[0]
    square = off @ np.linalg.solve(covariance[0], off)
    # 18 numbers: a chi square beyond 42 has a chance of one in a thousand.
    assert square < 42


def test_proposed_poses_are_near_those_driven_and_their_odds_rise_with_each(cell):
    found, _, plan, _ = cell
    joints, _, probability = deciding_views(found.linear, rivals_of(found))
    assert (np.diff(probability) > -0.02).all()
    driven = plan.joints[:VIEWS]
    for q in joints:
        assert np.abs(q - driven).max(axis=1).min() < np.radians(61)
        assert np.abs(q).max() < np.radians(171)
    seen = kinematics.flange(plan.arm, joints)
    assert np.isfinite(seen).all()


def test_the_chosen_view_decides_at_least_as_often_as_those_that_were_tried(cell, monkeypatch):
    found, *_ = cell
    monkeypatch.setattr(deciding_view, "MOST_VIEWS", 1)
    rivals = rivals_of(found)
    _, _, probability = deciding_views(found.linear, rivals)
    joints = possible_joints(found.linear)[:40]
    scores = [r.score for r in rivals]
    weights = np.array([r.log_posterior for r in rivals])
    forms = competing_forms(scores, weights, unnamed=unnamed_joints(found.linear, scores))
    tried = predict_views(found.linear, forms.scores, joints, np.zeros(len(joints)))
    draws = np.random.default_rng(5).standard_normal((2000, 6))
    right = deciding_view._simulate_decisions(tried, forms, [], np.arange(len(joints)), draws)[0]
    assert probability[0] > right.max() - 0.05


def test_the_law_of_an_effect_that_was_added_is_drawn_as_it_was_before(cell):
    """Dots before: as without it, and small with it; the line is what it does, whatever its other parameters are."""
    found, *_, run = cell
    linear = linear_model_of(stitch.add(run, "gear_eccentricity"))
    score = next(ranked.score for ranked in rivals_of(found) if ranked.name == "gear_eccentricity")
    before = trends_of_candidates(found.linear, [score])["gear_eccentricity"]
    now = trend_in_model(linear, linear.model.terms[-1])
    assert now.of == before.of == "joint 5"
    scatter = float(np.median(before.sigma))
    # Matches are found anew and the hand-eye moves: the dots keep their course.
    assert np.corrcoef(now.measured, before.measured)[0, 1] > 0.9
    assert np.corrcoef(now.predicted, before.predicted)[0, 1] > 0.9
    assert np.std(now.after) < 0.7 * np.std(now.measured)
    assert np.isfinite(now.predicted_sigma).all() and now.predicted_sigma.max() < 3 * scatter


def test_rivals_that_a_verdict_holds_undecided_are_not_decided_by_the_evidence_so_far(cell, monkeypatch):
    """Evidence that did not count for the verdict must not make its view as good as certain."""
    found = cell[0]
    monkeypatch.setattr(deciding_view, "MOST_VIEWS", 1)
    first, second = rivals_of(found)
    both = [replace(ranked, log_posterior=first.log_posterior + 9.0) for ranked in (first, second)]
    ahead = [both[0], second]
    alike = deciding_views(found.linear, both, undecided=2)
    held = deciding_views(found.linear, ahead, undecided=2)
    believed = deciding_views(found.linear, ahead)
    assert held[2] == pytest.approx(alike[2])
    assert believed is None or believed[2][0] > 0.99


@pytest.mark.slow
def test_a_base_that_gives_way_is_a_rival_of_joints_that_do_and_a_further_view_is_predicted_for_both():
    """Beside joints that may give way by any size a base explains nothing: it is asked where those are not there."""
    scene = load_scene("blade")
    scene = replace(scene, scanner=replace(scene.scanner, columns=PIXELS, rows=PIXELS))
    plan, rail = plan_for(scene, 0, 36)
    plan = replace(plan, **{key: getattr(plan, key)[:7] for key in ("joints", "torque", "velocity")})
    measured = simulate(scene, {"base_compliance": 8.0}, 0, planned=(plan, rail[:7]), waits=np.zeros(7))
    found = stitch.diagnose(stitch.run(session_of(measured)))
    assert (found.verdict, set(found.effects)) == ("cannot_tell", {"joint_compliance", "base_compliance"})
    assert sum(c.ranked.posterior for c in found.candidates) <= 1
    assert any(proposal.probability for proposal in found.next)


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


@pytest.mark.slow
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
    assert [at for at, *_ in views] == pytest.approx(trend.at)
    heights = np.array([expected["gear_harmonic"] for *_, expected in views])
    assert np.corrcoef(heights[:, 0], trend.predicted)[0, 1] > 0.9
    assert heights[:, 1].min() > 0 and min(scatter for _, scatter, _ in views) > 0


def test_a_part_in_a_near_corner_of_the_box_of_all_scans_is_not_in_the_field(cells: list[FreedBlade]):
    """The field is a frustum: as far to the side as in the far scans, but as near as the nearest, nothing is seen."""
    linear = cells[0].seen(_with_gear(cells[0])[0])
    surfaces = surfaces_of(linear)
    assert surfaces is not None
    capture, poses = surfaces.capture, surfaces.capture.poses(linear.model.T_mount)
    boxes = np.array([scan.box for scan in capture.scans])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    corner = [0.9 * high[0], (low[1] + high[1]) / 2, low[2] + 0.1 * (high[2] - low[2])]
    middle = capture.scans[0].points.mean(axis=0)
    moved = poses[0] @ frames.make(np.eye(3), middle - corner)
    at_scan, at_corner = deciding_view.seen_shares(surfaces, poses, np.array([poses[0], moved]))
    assert at_corner < 0.5 * at_scan


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
