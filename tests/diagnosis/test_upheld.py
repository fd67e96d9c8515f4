"""What is said where an effect does not hold on views left out."""

from types import SimpleNamespace

import pytest

from stitch.diagnosis.evidence import with_validation
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.validation import CrossValidation
from stitch.diagnosis.verdict import Evidence

HELPS = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.9)
USELESS = CrossValidation(inside=0.5, heldout=1.0, poses=1.0, poses_sigma=0.1, steadiness=0.9)
ON_ONE_VIEW = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.1)


def told(found: CrossValidation) -> tuple[str, tuple[str, ...]]:
    named = Ranked(SimpleNamespace(name="backlash"), adjusted=1e-3, log_posterior=5.0, posterior=0.99)
    evidence = Evidence((named,), (), alarm=True, explanation=(named,))
    upheld = with_validation(evidence, {"backlash": found}, {"backlash": None})
    return upheld.verdict, upheld.notes


def test_a_name_that_holds_stays():
    assert told(HELPS) == ("missing_effect", ())


@pytest.mark.parametrize("found", [USELESS, ON_ONE_VIEW])
def test_where_a_name_does_not_hold_the_alarm_stands(found):
    verdict, notes = told(found)
    assert verdict == "unknown_effect"
    assert len(notes) == 1
