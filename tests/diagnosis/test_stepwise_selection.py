"""Effects that are missing at once: what is idle is not named, and what was found first gives way to what does more."""

from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.diagnosis import stepwise_selection
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.ranking import Ranked, rank_one
from stitch.diagnosis.stepwise_selection import exchanged_set, is_better_set
from stitch.diagnosis.thresholds import MAX_REMAINING_SHARE
from stitch.diagnosis.validation import CrossValidation
from stitch.effects.contract import EFFECTS
from stitch.model.model import Model
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of


def leaving(poses: float, sigma: float = 1e-3) -> CrossValidation:
    return CrossValidation(inside=poses, heldout=poses, poses=poses, poses_sigma=sigma, steadiness=1.0)


def ranked(name: str) -> Ranked:
    score = SimpleNamespace(name=name, candidate=SimpleNamespace(name=name), variances=None)
    return Ranked(score, adjusted=1e-9, log_posterior=9.0, posterior=0.99)


@pytest.mark.parametrize(
    ("left", "named", "idle"),
    [
        ({"part_sag": 0.999, "backlash": 0.9}, ["backlash"], ["part_sag"]),
        ({"part_sag": 0.9, "backlash": 0.999}, ["part_sag"], ["backlash"]),
        ({"part_sag": 0.9, "backlash": 0.9, "settling": 0.999}, ["part_sag", "backlash"], ["settling"]),
        ({"part_sag": 0.999, "backlash": 0.995}, [], ["backlash", "part_sag"]),
    ],
)
def test_an_effect_that_is_idle_is_not_named_and_said_to_be(monkeypatch, left, named, idle):
    monkeypatch.setattr(
        stepwise_selection,
        "conditioned_without",
        lambda linear, chosen, one: [r.name for r in chosen if r.name != one.name],
    )
    asked, scored = [], []

    def cross_validated(beside, score):
        asked.append((score.name, beside))
        return leaving(left[score.name])

    def again(beside, candidate, tests, start):
        scored.append((candidate.name, beside))
        return ranked(candidate.name)

    monkeypatch.setattr(stepwise_selection, "cross_validate", cross_validated)
    monkeypatch.setattr(stepwise_selection, "rank_one", again)
    monkeypatch.setattr(stepwise_selection, "is_certain", lambda r: True)
    kept, why = stepwise_selection.keep_worth_adding(None, [ranked(name) for name in left], 20)
    assert [r.name for r in kept] == named and list(why) == idle
    weakest = list(left)[-1]
    assert asked[0] == (weakest, list(left)[:-1])  # beside all that are missing
    assert all("hardly helps on views left out" in text for text in why.values())
    # What stays was scored beside what went: it is asked again.
    assert {name for name, _ in scored} >= (set(named) if idle else set())


def test_an_effect_is_worth_adding_from_a_hundredth_of_the_distances_on():
    assert (
        leaving(MAX_REMAINING_SHARE - 1e-6).rejection_reason("x") is None
        and leaving(MAX_REMAINING_SHARE + 1e-6).rejection_reason("x") is not None
    )
    assert leaving(0.9, sigma=0.2).rejection_reason("x") is not None


TRUE = ("joint_offset", "joint_compliance")


@pytest.fixture(scope="module")
def arm():
    """An arm of which every joint counts from a wrong zero and joint 2 gives way, and what may be asked of it."""
    offset = 1e-3 * np.random.default_rng(0).standard_normal(6)
    session, T_mount, _ = labelled_cell(2, views=100, offset=offset, sag=1e-6)
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    asked = (*TRUE, "gear_eccentricity", "gear_harmonic", "backlash", "settling")
    candidates = {name: c for name in asked if (c := candidate_of(linear, EFFECTS[name])) is not None}
    return linear, list(candidates.values()), {name: rank_one(linear, c, len(asked)) for name, c in candidates.items()}


def test_an_imitation_gives_way_to_what_is_there(arm):
    linear, candidates, alone = arm
    stuck = [alone["gear_eccentricity"], alone["gear_harmonic"]]
    found = exchanged_set(linear, candidates, stuck)
    assert {c.name for c in found} == set(TRUE)
    right = [alone[name] for name in TRUE]
    assert is_better_set(linear, right, stuck) and not is_better_set(linear, stuck, right)


def test_effects_that_are_there_stay(arm):
    linear, candidates, alone = arm
    assert exchanged_set(linear, candidates, [alone[name] for name in TRUE]) == []
