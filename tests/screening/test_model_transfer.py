"""The model of another day, and an arm that sessions share: what holds is not doubted, what does not is said or refused.

U of the hand-eye with what the views cannot show, against a fit of hand-eye and all these effects together.
"""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from stitch.api.pipeline import change, diagnose, run, run_rig
from stitch.errors import NoResultError
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.observations.surfaces.hand_eye_fit import Repeatability, pose_covariance
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.output.comparison.run_verdict import run_light, run_verdict
from stitch.output.plain_finding import next_step_line, plain_finding
from stitch.output.result_document import model_of
from stitch.screening.hand_eye_anywhere import hand_eye_sigma_anywhere
from stitch.screening.model_transfer import compare_with_own_effects
from stitch.screening.view_model import UsualEffects, thin_correspondences, view_model
from stitch.session.measurement import measurement_of, with_part_origin

OFFSETS = np.array([0, 8e-4, -9e-4, 0, 1e-3, 0])
SCATTER = Repeatability(2e-5, 0.02, 1.0)


def seen_by(session, T):
    """As a sensor sees it that stands elsewhere: T takes points of the old one into the new."""
    views = tuple(
        replace(v, sighting=replace(v.sighting, points=frames.transform(T, v.sighting.points))) for v in session.views
    )
    return replace(session, views=views)


def only(session, target_of):
    """Of every view the one target of a number, by names of its own."""

    def of(k, view):
        s = view.sighting
        at = [s.targets.index(target_of(k))]
        own = replace(s, targets=[s.targets[at[0]]], points=s.points[at], sigma=np.asarray(s.sigma)[at])
        return replace(view, sighting=own)

    return replace(session, views=tuple(of(k, view) for k, view in enumerate(session.views)))


@pytest.fixture(scope="module")
def cell():
    """Views of one day, and others of another in which nothing has moved."""
    session, *_ = labelled_cell(70, views=60)
    first, then = (replace(session, views=session.views[k::2]) for k in (0, 1))
    return model_of(run(first)), then


@pytest.mark.slow
def test_what_holds_is_not_doubted():
    """Of 12 cells one at the most: a hundredth is doubted by chance."""
    doubted = 0
    for seed in range(12):
        session, *_ = labelled_cell(700 + seed, views=40)
        first, then = (replace(session, views=session.views[k::2]) for k in (0, 1))
        doubted += bool(run(then, model=model_of(run(first))).doubts)
    assert doubted <= 1


def test_a_sensor_that_was_moved_is_said_by_how_much(cell):
    """0.6 mm and 0.3 mrad."""
    model, then = cell
    moved = frames.exp(np.array([3e-4, 0, 0, 0, 0.6, 0]))
    (doubt,) = run(seen_by(then, moved), model=model).doubts
    assert "The hand-eye of the other run does not hold here" in doubt and "--arm" in doubt
    here = run(seen_by(then, moved)).T_mount
    off = frames.log(frames.inverse(model.T_mount) @ here)
    assert f"{1e3 * np.linalg.norm(off[:3]):.3g} mrad" in doubt


@pytest.mark.usefixtures("few_effects")
def test_a_diagnosis_says_first_what_is_doubted(cell):
    """A sensor that was moved looks like an effect of the arm; what is found is said to be perhaps no more than that."""
    model, then = cell
    moved = run(seen_by(then, frames.exp(np.array([3e-4, 0, 0, 0, 0.6, 0]))), model=model)
    found = diagnose(moved)
    assert found.doubts == moved.doubts
    assert plain_finding(found, "mm").startswith("The hand-eye of the other run does not hold here. The findings below")
    assert next_step_line(found, "RUN").startswith("Next: fix the problem above")
    # Fitted anew, hand-eye and targets are of this session, and nothing is doubted.
    assert not diagnose(change(moved, ["joint_offset"])).doubts


def test_a_tool_that_was_mounted_anew_is_said_by_its_targets(cell):
    """All targets 0.5 mm along the flange; the sensor stands where it stood."""
    model, _ = cell
    session, *_ = labelled_cell(70, views=60, targets=TARGETS + np.array([0.5, 0, 0]))
    (doubt,) = run(replace(session, views=session.views[1::2]), model=model).doubts
    assert "lie elsewhere than in the other run" in doubt and "hand-eye of the other run does not hold" not in doubt


def test_a_model_of_another_set_up_is_refused(cell):
    model, _ = cell
    other, *_ = labelled_cell(71, views=30)
    with pytest.raises(NoResultError, match="does not hold here.*--arm"):
        run(other, model=model)


def test_targets_seen_once_need_the_model_of_another_run(cell):
    model, then = cell
    names = then.views[0].sighting.targets
    once = only(replace(then, views=then.views[: len(names)]), lambda k: names[k])
    with pytest.raises(NoResultError, match="no target is seen in two views.*--hand-eye"):
        run(once)
    # Known to the other run, they say how far its model is off.
    known = run(once, model=model)
    assert not known.doubts and 0.005 < known.residual_rms < 0.2
    assert "seen in one view alone" not in run_verdict(known, None)
    light, doubted = run_light(known, None, 10.0), run_light(replace(known, doubts=("A doubt.",)), None, 10.0)
    assert light.light == "good" and doubted.light == "check" and light.sentence in doubted.sentence


def test_targets_nobody_knows_and_one_view_alone_shows_are_placed_without_a_verdict(cell):
    model, then = cell
    names = then.views[0].sighting.targets
    once = only(replace(then, views=then.views[: len(names)]), lambda k: names[k])
    views = tuple(replace(v, sighting=replace(v.sighting, targets=[f"hole {k}"])) for k, v in enumerate(once.views))
    found = run(replace(once, views=views), model=model)
    assert np.isfinite(found.targets.landmarks.positions).all()
    places = np.array([model.targets[name].position for name in names])
    assert np.linalg.norm(found.targets.landmarks.positions - places, axis=1).max() < 0.3
    assert "seen in one view alone" in run_verdict(found, None) and run_light(found, None, 0.1) is None


def two_days(second):
    """Two sessions, the joints of the second off by so much (6,), rad."""
    found = [labelled_cell(50 + k, views=24, offset=off)[0] for k, off in enumerate((OFFSETS, second))]
    return [replace(session, name=f"day {k}") for k, session in enumerate(found)]


def test_two_arms_in_one_fit_are_doubted():
    runs = run_rig(two_days(-OFFSETS), effects=["joint_offset"])
    for k, r in enumerate(runs):
        assert any(f"day {k} does not share the effects of this rig" in doubt for doubt in r.doubts)


@pytest.mark.parametrize(
    "effects", [pytest.param(["joint_offset"], marks=pytest.mark.slow), ["joint_offset", "link_geometry"], []]
)
def test_one_arm_is_not(effects):
    assert not any("does not share" in doubt for r in run_rig(two_days(OFFSETS), effects=effects) for doubt in r.doubts)


@pytest.mark.parametrize(("shared", "alone", "large"), [(0.296, 0.279, False), (0.511, 0.501, False), (0.6, 0.3, True)])
def test_what_is_significant_is_said_only_where_it_is_large(shared, alone, large):
    """Of 600 views a twentieth of the rms is beyond chance too."""
    squares = np.random.default_rng(0).chisquare(3, 600) / 3
    (_, separate, expected), p_value, found_large = compare_with_own_effects(shared**2 * squares, alone**2 * squares, 6)
    assert p_value < 1e-3 and found_large == large
    assert separate < expected < 1.01 * separate


@pytest.fixture(scope="module")
def ordinary_cell():
    """What the views of a cell show, its hand-eye as well known as its scatter lets it, and effects that it may have."""
    measured = measured_blade(22, views=8, pixels=70)
    capture = captured(measured)
    measurement = with_part_origin(measurement_of(session_of(measured), capture), measured.T_mount)
    views = unconstrained_poses(capture, capture.poses(measured.T_mount), 4 * capture.spacing)
    reduced = view_model(capture, measured.T_mount, views).reduced
    C = pose_covariance(reduced, SCATTER)
    model = Model(measured.T_mount)
    known = np.linalg.inv(reduced.hand_eye.T @ np.linalg.solve(C, reduced.hand_eye))
    model = replace(model, covariance=known)
    usual = UsualEffects(measurement, model).by_place(thin_correspondences(views))
    assert "base" in usual
    J = reduced.reduction @ np.hstack([columns for place, columns in usual.items() if place not in ("robot", "links")])
    return measurement, model, views, reduced.hand_eye, C, J


def test_it_is_that_of_a_fit_of_all_effects_in_their_usual_sizes(ordinary_cell):
    measurement, model, views, A, C, J = ordinary_cell
    columns = np.hstack([A, J])
    prior = np.diag([0.0] * 6 + [1.0] * J.shape[1])
    together = np.linalg.inv(columns.T @ np.linalg.solve(C, columns) + prior)
    sigma = hand_eye_sigma_anywhere(measurement, model, views, SCATTER)
    assert sigma == pytest.approx(np.sqrt(np.diag(together))[:6], rel=1e-5)
    assert (sigma > np.sqrt(np.diag(model.covariance))).all()


def test_an_effect_drawn_in_its_usual_size_moves_the_hand_eye_by_no_more_than_it_says(ordinary_cell):
    """Draws of what no view shows: of the effects, the part that is left once their visible part is known."""
    measurement, model, views, A, C, J = ordinary_cell
    rng = np.random.default_rng(0)
    both = np.hstack([A, J])
    normal = both.T @ np.linalg.solve(C, both) + np.diag([0.0] * 6 + [1.0] * J.shape[1])
    errors = []
    for _ in range(400):
        effects = rng.standard_normal(J.shape[1])
        z = J @ effects + np.linalg.cholesky(C) @ rng.standard_normal(len(C))
        errors.append(np.linalg.solve(normal, both.T @ np.linalg.solve(C, z))[:6])
    sigma = hand_eye_sigma_anywhere(measurement, model, views, SCATTER)
    # The scatter of 400 draws is known to 4 %.
    assert np.abs(np.std(errors, axis=0) / sigma - 1).max() < 0.15
