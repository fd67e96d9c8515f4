"""What is concluded where a name does not stand by itself: with a second effect, or without the first."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from stitch.diagnosis import evidence as gathering
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.validation import CrossValidation
from stitch.diagnosis.verdict import Evidence

HELPS = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.9)
USELESS = CrossValidation(inside=0.5, heldout=1.0, poses=1.0, poses_sigma=0.1, steadiness=0.9)


def ranked(name, beside=None, adjusted=1e-6):
    of = SimpleNamespace(name=name, empirical=False)
    seen = {
        "observable": True,
        "values": (),
        "form": SimpleNamespace(free=(), term=SimpleNamespace(name=name)),
        "log_bayes_factor": 12.0,
    }
    score = SimpleNamespace(name=name, base_model=beside, candidate=of, fitted=True, **seen)
    return Ranked(score, adjusted, log_posterior=9.0, posterior=0.9)


FIRST, SECOND = ranked("range_nonlinearity"), ranked("lens_distortion")
ALONE = Evidence((FIRST, SECOND), (), alarm=True, explanation=(FIRST,))
PAIR = replace(ALONE, further=SECOND, together=(FIRST, SECOND))
SAME, WORSE, BETTER = (1.02, 0.97, 1.05, 0.98), (1.9, 2.1, 2.0, 2.2), (0.5, 0.6, 0.55, 0.5)
SMOOTH = SimpleNamespace(gain=50.0, over_noise=False)


@pytest.fixture(autouse=True)
def without_halves(monkeypatch):
    monkeypatch.setattr(gathering, "objection_in_halves", lambda score: None)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: HELPS)
    monkeypatch.setattr(gathering, "regime_of", lambda linear: SimpleNamespace(many_views=True))


def upheld(monkeypatch, evidence, *, together, refused):
    """With what the views say of two effects together, and names that the scanner's own error outweighs."""
    pair = together and (together.explanation[0], together.further)
    monkeypatch.setattr(gathering, "regime_of", lambda linear: SimpleNamespace(many_views=False))
    monkeypatch.setattr(gathering, "find_missing_pair", lambda *asked: pair)
    monkeypatch.setattr(gathering, "pair_is_validated", lambda *asked: True)
    monkeypatch.setattr(gathering, "moves_points", lambda terms: True)
    outweighed = [[r.name for r in (e.explanation[0], e.further) if r is not None] for e in refused]
    found = {tuple(names): SMOOTH for names in outweighed}
    monkeypatch.setattr(
        gathering, "find_scanner_error", lambda linear, other_terms=(): found.get(tuple(t.name for t in other_terms))
    )
    return gathering.ask(gathering.TESTS[:3], None, (), replace(evidence, proposed=evidence))


def rivals_of(evidence):
    return gathering.ask([gathering.which_predict_as_well], None, (), evidence)


def test_what_looks_like_an_error_of_the_scanner_may_be_a_second_effect(monkeypatch):
    found = upheld(monkeypatch, ALONE, together=PAIR, refused=[ALONE])
    assert (found.named, found.second, found.scanner_error) == ((FIRST,), SECOND, None)


@pytest.mark.parametrize("together", [None, PAIR])
def test_what_two_effects_do_not_explain_stays_the_scanners(monkeypatch, together):
    found = upheld(monkeypatch, ALONE, together=together, refused=[ALONE, PAIR])
    assert found.verdict == "unknown_effect" and not found.named and found.scanner_error is SMOOTH


@pytest.mark.parametrize("alone", [HELPS, USELESS])
def test_a_second_effect_without_the_first_is_asked_alone(monkeypatch, alone):
    first, second = ranked("backlash", beside=SECOND), ranked("fixture_drift", beside=FIRST)
    by_itself = ranked("fixture_drift")
    said = {id(first.score): USELESS, id(second.score): HELPS, id(by_itself.score): alone}
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: said[id(score)])
    evidence = Evidence((ranked("backlash"), by_itself), (), alarm=True, explanation=(first,), further=second)
    found = upheld(monkeypatch, evidence, together=None, refused=[])
    assert found.named == ((by_itself,) if alone is HELPS else ())
    assert "backlash" in found.notes[0]


def test_a_second_effect_that_alone_may_be_chance_gets_no_name(monkeypatch):
    first, second = ranked("backlash", beside=SECOND), ranked("fixture_drift", beside=FIRST)
    by_itself = ranked("fixture_drift", adjusted=0.2)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: USELESS if score is first.score else HELPS)
    evidence = Evidence((ranked("backlash"), by_itself), (), alarm=True, explanation=(first,), further=second)
    found = upheld(monkeypatch, evidence, together=None, refused=[])
    assert found.verdict == "unknown_effect" and not found.named
    assert "backlash" in found.notes[0]


@pytest.mark.parametrize(
    ("squares", "notes", "rivals"),
    [
        ((SAME, SAME), (), True),  # the same on views left out, though one is likelier in the fit
        ((WORSE, WORSE), (), False),
        ((SAME, WORSE), (), False),  # where points do not tell, poses do
        ((SAME, SAME), ("lens_distortion helps among the measured poses, but not beyond",), False),
    ],
)
def test_what_predicts_views_left_out_as_well_is_not_told_from_the_name(monkeypatch, squares, notes, rivals):
    rival = replace(HELPS, fold_squares=squares)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: rival)
    named = {FIRST.name: replace(HELPS, fold_squares=((1.0,) * 4, (1.0,) * 4))}
    found = rivals_of(replace(ALONE, left_out=named, notes=notes))
    assert found.verdict == ("cannot_tell" if rivals else "missing_effect")
    assert found.named == ((FIRST, SECOND) if rivals else (FIRST,))
    # Where both are missing, each was asked beside the other.
    assert rivals_of(replace(PAIR, left_out=named)).named == (FIRST,)


@pytest.mark.parametrize(
    ("squares", "stands", "named"),
    [
        ((BETTER, BETTER), True, (SECOND,)),
        ((BETTER, SAME), True, (FIRST, SECOND)),  # points alone may be the scanner's noise
        ((BETTER, BETTER), False, (FIRST, SECOND)),
    ],
)
def test_what_predicts_views_left_out_clearly_better_is_named_though_another_is_likelier(
    monkeypatch, squares, stands, named
):
    rival = replace(HELPS, fold_squares=squares, steadiness=0.9 if stands else 0.1)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: rival)
    left_out = {FIRST.name: replace(HELPS, fold_squares=((1.0,) * 4, (1.0,) * 4))}
    assert rivals_of(replace(ALONE, left_out=left_out)).named == named


@pytest.mark.parametrize(("together", "named"), [(PAIR, (FIRST,)), (None, (FIRST, SECOND))])
def test_rivals_that_a_second_effect_makes_equal_do_not_take_the_name(monkeypatch, together, named):
    alone = upheld(monkeypatch, ALONE, together=together, refused=[])
    rival = replace(HELPS, fold_squares=(SAME, SAME))
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: rival)
    left_out = {FIRST.name: replace(HELPS, fold_squares=((1.0,) * 4, (1.0,) * 4))}
    assert rivals_of(replace(alone, left_out=left_out)).named == named
