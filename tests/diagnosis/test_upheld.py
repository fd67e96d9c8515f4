"""What is said where an effect does not hold on views left out."""

from types import SimpleNamespace

import pytest

from stitch.diagnosis import evidence as gathering
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.validation import CrossValidation
from stitch.diagnosis.verdict import Evidence

HELPS = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.9)
USELESS = CrossValidation(inside=0.5, heldout=1.0, poses=1.0, poses_sigma=0.1, steadiness=0.9)
ON_ONE_VIEW = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.1)


def held(monkeypatch, left_out: CrossValidation) -> tuple[str, tuple[str, ...]]:
    """Verdict and notes after the question whether a name holds on views left out."""
    score = SimpleNamespace(name="backlash", base_model=None)
    named = Ranked(score, adjusted=1e-3, log_posterior=5.0, posterior=0.99)
    evidence = Evidence((named,), (), alarm=True, explanation=(named,))
    monkeypatch.setattr(gathering, "objection_in_halves", lambda score: None)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: left_out)
    upheld = gathering.ask([gathering.does_it_hold_elsewhere], None, (), evidence)
    return upheld.verdict, upheld.notes


def test_a_name_that_holds_stays(monkeypatch):
    assert held(monkeypatch, HELPS) == ("missing_effect", ())


@pytest.mark.parametrize("found", [USELESS, ON_ONE_VIEW])
def test_where_a_name_does_not_hold_the_alarm_stands(monkeypatch, found):
    verdict, notes = held(monkeypatch, found)
    assert verdict == "unknown_effect"
    assert len(notes) == 1
