"""Where the overlaps show that the scanner errs over its field, that comes before names and beside adequate."""

from types import SimpleNamespace

import pytest

from stitch.diagnosis import verdict as scanner_first
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.verdict import Selection
from stitch.observations.surfaces.scanner_errors import FieldError


def named(gain: float) -> Selection:
    """An effect of a joint that the data want by so many nats."""
    term = SimpleNamespace(effect=SimpleNamespace(place="robot"))
    score = SimpleNamespace(name="backlash", log_bayes_factor=gain, form=SimpleNamespace(term=term))
    ranked = Ranked(score, adjusted=1e-6, log_posterior=gain, posterior=0.99)
    return Selection("missing_effect", (ranked,), (ranked,), ())


def held(monkeypatch: pytest.MonkeyPatch, selection: Selection, shown: FieldError | None) -> Selection:
    monkeypatch.setattr(scanner_first, "scanner_error", lambda linear, beside=(): shown)
    return scanner_first.check_scanner_errors(None, selection)[0]


def error(gain: float, over_noise: bool = True) -> FieldError:
    return FieldError(0.02, 0.0, gain, over_noise)


def test_the_clearer_of_the_two_is_said(monkeypatch):
    assert held(monkeypatch, named(80.0), error(20.0)).verdict == "missing_effect"
    refused = held(monkeypatch, named(8.0), error(20.0))
    assert refused.verdict == "unknown_effect" and not refused.named and "backlash" in refused.notes[0]


def test_only_more_than_the_noise_is_not_adequate(monkeypatch):
    nothing = Selection("adequate", (), (), ())
    assert held(monkeypatch, nothing, None).verdict == "adequate"
    assert held(monkeypatch, nothing, error(8.0, over_noise=False)).verdict == "adequate"
    assert held(monkeypatch, nothing, error(8.0)).verdict == "unknown_effect"
