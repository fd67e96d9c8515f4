"""The diagnosis on scans of a blade with known truth: a small part of bench/blind.py."""

import json

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import change, diagnose, run
from stitch.diagnosis.diagnose import linear_model_of
from stitch.numerics import frames
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.json_file import to_json


def blade_run(seed, hidden, mount="eye_to_hand", views=12, plan_seed=None, pixels=90):
    measured = measured_blade(seed, views=views, mount=mount, hidden=hidden, pixels=pixels, plan_seed=plan_seed)
    return measured, run(session_of(measured))


@pytest.fixture(scope="module")
def nothing_hidden():
    """A run of a cell in which nothing is hidden, and its diagnosis."""
    _, result = blade_run(11, {}, "eye_in_hand", views=9, plan_seed=1, pixels=60)
    return result, diagnose(result)


# Sizes that are two to four times what these cells can show at the least.
VISIBLE = [
    ("joint_offset", "eye_in_hand", 4.0),
    ("joint_compliance", "eye_to_hand", 3.0),
    ("lens_distortion", "eye_to_hand", 3.0),
]


# In `make test` by the commands and in the browser: test_diagnosis_commands.py, test_review_in_browser.py.
@pytest.mark.slow
@pytest.mark.parametrize(("name", "mount", "size"), VISIBLE)
def test_a_hidden_effect_is_named_added_and_the_error_falls(name, mount, size):
    measured, before = blade_run(1, {name: size}, mount)
    found = diagnose(before)
    assert found.verdict in ("missing_effect", "cannot_tell"), found.sentence
    assert name in found.effects, found.sentence
    after = change(before, [name])
    assert after.residual_rms < before.residual_rms
    assert after.heldout_rms < before.heldout_rms
    assert [s.effects for s in after.ledger] == [(), (name,)]
    # What the linear prediction promised comes true when everything is fitted and matched anew.
    left = next(s.cross_validation for s in found.candidates if s.name == name)
    assert after.residual_rms == pytest.approx(before.residual_rms * np.sqrt(left.inside), rel=0.15)
    # The truth, which no overlap knows, comes nearer too: a fit that borrows from the hand-eye would not show above.
    errors = [frames.log(frames.inverse(measured.T_mount) @ r.T_mount)[3:] for r in (before, after)]
    assert np.linalg.norm(errors[1]) < max(
        np.linalg.norm(errors[0]), 3 * np.sqrt(np.trace(after.mount_covariance[3:, 3:]))
    )
    told = measured.hidden[name]
    z = [(p.value - told.get(p.name, 0.0)) / p.sigma for p in after.terms[0].parameters if p.fitted and not p.grid]
    assert np.max(np.abs(z)) < 4.0


def test_nothing_hidden_is_adequate(nothing_hidden):
    _, found = nothing_hidden
    assert found.verdict == "adequate", found.sentence
    assert 5e-6 < found.rotation < 6e-5
    assert 5e-3 < found.translation < 6e-2


@pytest.mark.slow
@pytest.mark.parametrize(("name", "follows"), [("covariate_bias", "humidity_percent")])
def test_what_the_library_does_not_know_gets_no_name(name, follows):
    _, result = blade_run(2, {name: 4.0}, "eye_in_hand", 14)
    found = diagnose(result)
    assert found.verdict == "unknown_effect", found.sentence
    assert not found.effects
    assert follows in [d.covariate for d in found.depends_on[:3]]


@pytest.mark.slow
def test_offset_of_the_first_joint_is_never_named_where_the_hand_eye_hides_it():
    """eye_to_hand: joint 1 turns everything about one axis of the base; that is a hand-eye."""
    measured = measured_blade(3, views=16, pixels=90)
    session = session_of(measured)
    result = change(run(session), ["joint_offset"])
    offsets, sigmas = result.terms[0].values, result.terms[0].sigmas
    assert offsets[0] == 0.0
    assert np.isnan(sigmas[0])
    assert offsets[5] == 0.0  # the last joint moves the whole part
    assert np.isnan(sigmas[5])


@pytest.mark.slow
def test_turning_the_last_joint_alone_names_nothing():
    measured = measured_blade(
        4, views=10, pixels=90, tilt=0.0, roll=0.0, aim=0.0, distance=0.0, hidden={"joint_offset": 3.0}
    )
    found = diagnose(run(session_of(measured)))
    assert found.verdict in ("adequate", "cannot_tell")


@pytest.mark.slow
def test_prediction_of_the_null_is_the_present_residual():
    _, result = blade_run(6, {})
    linear = linear_model_of(result)
    g, present = linear.observation.unconstrained.overlaps.gram, linear.baseline_trial
    assert np.sqrt(present.squares(present.solve()).sum() / g.weight.sum()) == pytest.approx(
        result.residual_rms, rel=0.15
    )


def test_document_has_no_infinite_number(nothing_hidden):
    text = to_json(diagnosis_document(nothing_hidden[1]))
    assert json.loads(text)["verdict"] == "adequate"
