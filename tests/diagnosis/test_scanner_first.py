"""Where the overlaps show that the scanner errs over its field, that comes before names and beside adequate."""

from types import SimpleNamespace

import pytest

from stitch.diagnosis import evidence as gathering
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.verdict import Evidence
from stitch.observations.surfaces.field_error import FieldError


def named(gain: float) -> Evidence:
    """An effect of a joint that the data want by so many nats."""
    term = SimpleNamespace(effect=SimpleNamespace(place="robot"))
    score = SimpleNamespace(name="backlash", log_bayes_factor=gain, form=SimpleNamespace(term=term))
    ranked = Ranked(score, adjusted=1e-6, log_posterior=gain, posterior=0.99)
    return Evidence((ranked,), (), alarm=True, explanation=(ranked,))


def beside_the_scanner(monkeypatch: pytest.MonkeyPatch, evidence: Evidence, shown: FieldError | None) -> Evidence:
    monkeypatch.setattr(gathering, "find_scanner_error", lambda linear, other_terms=(): shown)
    return gathering.ask([gathering.does_the_scanner_explain_it], None, (), evidence)


def error(gain: float, over_noise: bool = True) -> FieldError:
    return FieldError(0.02, 0.0, gain, over_noise)


def test_the_clearer_of_the_two_is_said(monkeypatch):
    assert beside_the_scanner(monkeypatch, named(80.0), error(20.0)).verdict == "missing_effect"
    refused = beside_the_scanner(monkeypatch, named(8.0), error(20.0))
    assert refused.verdict == "unknown_effect" and not refused.named and "backlash" in refused.notes[0]


def test_only_more_than_the_noise_is_not_adequate(monkeypatch):
    nothing = Evidence((), ())
    assert beside_the_scanner(monkeypatch, nothing, None).verdict == "adequate"
    assert beside_the_scanner(monkeypatch, nothing, error(8.0, over_noise=False)).verdict == "adequate"
    assert beside_the_scanner(monkeypatch, nothing, error(8.0)).verdict == "unknown_effect"
