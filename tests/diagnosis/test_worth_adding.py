"""Of many poses nothing is named that would be dropped again as soon as it is in the model."""

from types import SimpleNamespace

import pytest

from stitch.diagnosis import stepwise_selection
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.thresholds import MAX_REMAINING_SHARE
from stitch.diagnosis.validation import CrossValidation


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
def test_what_is_missing_helps_and_what_is_idle_is_said(monkeypatch, left, named, idle):
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


def test_a_hundredth_of_the_distances_is_worth_it_and_chance_is_not():
    assert (
        leaving(MAX_REMAINING_SHARE - 1e-6).rejection_reason("x") is None
        and leaving(MAX_REMAINING_SHARE + 1e-6).rejection_reason("x") is not None
    )
    assert leaving(0.9, sigma=0.2).rejection_reason("x") is not None
