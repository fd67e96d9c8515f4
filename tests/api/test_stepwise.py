"""What a diagnosis adds stays where views left out are predicted better; what was dropped is not proposed again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api import stepwise
from stitch.api.pipeline import change, diagnose, run
from stitch.diagnosis.validation import CrossValidation, _squares_by_fold
from stitch.effects.contract import find_effect, parameters_in
from stitch.model.model import Term
from stitch.output.diagnosis_document import diagnosis_document, named_before
from stitch.output.json_file import write_json
from stitch.output.plain_finding import next_step_line
from stitch.output.run_folder import write_with_page
from stitch.output.stored_run import diagnosed_state, load_run, standing_diagnosis
from stitch.session.reading.session_folder import load_session

OFFSET = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])


@pytest.fixture(scope="module", autouse=True)
def small_library(library_of):
    """What follows a diagnosis is tested here, and not how long all of one takes."""
    with library_of(("joint_offset", "joint_compliance", "gear_eccentricity", "gear_harmonic", "backlash", "settling")):
        yield


@pytest.fixture(scope="module")
def first():
    session, *_ = labelled_cell(1, views=24, offset=OFFSET)
    return run(session)


@pytest.fixture(scope="module")
def diagnosed(first):
    return diagnose(first)


def answered(monkeypatch, verdict, effects):
    """Diagnoses that say what a session with such effects would lead to."""
    named = tuple(SimpleNamespace(name=name) for name in effects)
    monkeypatch.setattr(stepwise, "diagnose", lambda state: replace(diagnose(state), verdict=verdict, named=named))


def test_a_group_that_helps_is_added_as_one(first, monkeypatch):
    answered(monkeypatch, "cannot_tell", ("joint_offset", "gear_eccentricity"))
    result, lines, _ = stepwise.suggest_group(first)
    assert result.effects == ["joint_offset", "gear_eccentricity"]
    assert result.heldout_rms < 0.5 * first.heldout_rms
    assert "do not tell its parts apart" in lines[-1] and result.notes[0] == lines[-1]


def test_a_group_stays_out_where_none_of_its_effects_is_there(monkeypatch):
    answered(monkeypatch, "cannot_tell", ("backlash", "settling"))
    session, *_ = labelled_cell(3, views=24)
    result, lines, _ = stepwise.suggest_group(run(session))
    assert result is None and "do not help on views left out" in lines[-1]


def test_no_group_is_suggested_where_one_effect_is_named(first):
    result, lines, found = stepwise.suggest_group(first)
    assert found.verdict == "missing_effect" and result is None and "no group" in lines[-1]
    # For everybody first, then the evidence.
    assert lines[0].startswith("Missing in the model: joint_offset (a joint counts its angle from a wrong zero). Add")
    assert lines[1] == found.sentence


def test_an_effect_less_likely_than_chance_is_not_added(first, diagnosed, monkeypatch):
    found = replace(diagnosed, log_odds_over_nothing=-0.1)
    monkeypatch.setattr(stepwise, "diagnose", lambda state: found)
    result, lines, _ = stepwise.suggest(first, at_most=3)
    assert result is None and lines[-1].startswith("joint_offset was not added: chance is more likely.")


@pytest.mark.parametrize(
    ("share", "poses", "zero", "stays"),
    [
        (0.80, 1.0, True, True),  # the error of left-out points fell by more than its uncertainty
        (0.96, 0.8, False, True),  # it does not tell; that of left-out poses does
        (0.96, 1.0, False, False),  # neither tells
        (0.96, 0.8, True, False),  # the fit finds nothing of the effect
        (1.06, 0.8, False, False),  # it rose
    ],
)
def test_an_effect_stays_if_views_left_out_are_better_by_more_than_is_uncertain(share, poses, zero, stays):
    judged = CrossValidation(0.5, 0.9, poses, poses_sigma=0.1, steadiness=1.0, heldout_sigma=0.05)
    reason = judged.fit_rejection_reason("settling", share, zero=zero)
    assert (reason is None) == stays
    assert stays or f"{share:.2f} ± 0.05 of the mean square error" in reason


def test_the_uncertainty_of_the_error_on_views_left_out_is_that_between_folds(diagnosed):
    """As a ratio of sums over folds (Cochran 1977, eq. 2.39), by leaving folds out one by one."""
    found = diagnosed
    judged = found.candidates[0].cross_validation
    scored, linear = found.candidates[0].ranked.score, found.linear.restricted(())
    squares = _squares_by_fold(linear, scored)[1]
    folds = squares.shape[1]
    shares = [np.delete(squares[0], k).sum() / np.delete(squares[1], k).sum() for k in range(folds)]
    jackknife = np.sqrt((folds - 1) / folds * np.sum((shares - np.mean(shares)) ** 2))
    assert judged.heldout == pytest.approx(squares[0].sum() / squares[1].sum())
    assert judged.heldout_sigma == pytest.approx(jackknife, rel=0.3)


def test_effects_that_were_added_give_way_to_others_that_do_more_together(first):
    """Gears that run out imitate wrong zeros over these ranges, worse than the zeros themselves."""
    stuck = stepwise.change(first, ["gear_eccentricity", "gear_harmonic"])
    result, told = stepwise._exchange_added(stuck, given=set())
    assert result.effects == ["joint_offset"] and result.heldout_rms < stuck.heldout_rms
    gone = "gear_eccentricity and gear_harmonic"
    assert told == [f"joint_offset: views left out are predicted better than with {gone}, which went."]
    assert stepwise._exchange_added(result, given=set()) == (result, [])


def test_an_effect_that_was_dropped_is_remembered_and_not_proposed_again(monkeypatch, tmp_path):
    session, *_ = labelled_cell(1, views=24, offset=OFFSET)
    first = run(load_session(write_labelled(tmp_path / "session", session)))
    monkeypatch.setattr(stepwise, "change", lambda state, effects, recorder: replace(first, heldout_rms=9.0))
    monkeypatch.setattr(stepwise, "_drop_unneeded", lambda run, given, recorder: (with_effect(run), []))
    result, lines, found = stepwise.suggest(first, at_most=3)
    assert result is None and "joint_offset was tried and dropped: with joint_offset the error" in lines[-1]
    assert list(found.tried) == ["joint_offset"] and "It was tried in this run and dropped: with" in said(found)
    assert "--suggested" not in next_step_line(found, "RUN")
    # In a later process too, as diagnosis.json of the run has it.
    (tmp_path / "run").mkdir()
    write_with_page(first, tmp_path / "run")
    write_json(diagnosis_document(found), tmp_path / "run" / "diagnosis.json")
    again = load_run(tmp_path / "run")
    assert again.tried == found.tried
    monkeypatch.setattr(stepwise, "change", lambda state, effects, recorder: pytest.fail("it is fitted again"))
    result, lines, later = stepwise.suggest(again, at_most=3)
    assert result is None and "was dropped in this run before" in lines[-1] and later.tried == found.tried


def test_a_diagnosis_of_the_same_state_is_read_and_not_made_again(monkeypatch, tmp_path):
    session, *_ = labelled_cell(1, views=24, offset=OFFSET)
    folder = write_labelled(tmp_path / "session", session)
    first = run(load_session(folder))
    (tmp_path / "run").mkdir()
    write_with_page(first, tmp_path / "run")
    found, made = diagnose(first), []
    write_json(
        diagnosis_document(found) | {"of": diagnosed_state(first, tmp_path / "run")}, tmp_path / "run/diagnosis.json"
    )
    again = load_run(tmp_path / "run")
    known = named_before(standing_diagnosis(tmp_path / "run", again), again.tried)

    def of_what_was_added(state):
        made.append(state.effects)
        return replace(found, verdict="adequate", named=())

    monkeypatch.setattr(stepwise, "diagnose", of_what_was_added)
    result, lines, _ = stepwise.suggest(again, 3, known)
    assert result.effects == ["joint_offset"] and made == [["joint_offset"]]
    assert lines[: len(known.lines)] == [said(found), found.sentence, *(f"{note}." for note in found.notes)]
    with open(folder / "views.csv", "a") as table:
        table.write("\n")
    assert standing_diagnosis(tmp_path / "run", again) == {} and named_before({}, again.tried) is None


def said(found):
    return diagnosis_document(found)["plain"]


def with_effect(state):
    """The run as if joint_offset had been fitted, and were far from zero."""
    effect = find_effect("joint_offset")
    parameters = tuple(replace(p, value=1e-3, sigma=1e-5) for p in parameters_in(state.measurement, effect))
    return replace(state, model=state.model.with_terms([Term(effect, parameters)]))


def test_an_effect_that_ends_with_nothing_is_taken_out():
    """Of labelled points whose gears are right, waves of the gears are zero: what was given stays, what was added goes."""
    session, *_ = labelled_cell(3, views=24)
    added = change(run(session), ["gear_harmonic"])
    assert added.terms[0].sigmas_from_zero < 3
    faint = tuple(replace(p, value=0.5 * p.sigma if p.fitted else p.value) for p in added.terms[0].parameters)
    added = replace(added, model=added.model.with_terms([replace(added.terms[0], parameters=faint)]))
    fewer, lines = stepwise._drop_idle(added, set(), None)
    assert not fewer.effects and "gear_harmonic" in fewer.tried and "differs from zero; it was dropped" in lines[0]
    assert stepwise.error_with(added, []) == fewer.heldout_or_fit_rms
    assert stepwise._drop_idle(added, {"gear_harmonic"}, None) == (added, [])


def test_an_effect_without_which_views_left_out_are_predicted_better_is_taken_out(monkeypatch):
    """Of two that were added the one goes that raises the error; a step of matching anew is no reason."""
    of_effects = {("a",): 0.9, ("b",): 1.1, ("a", "b"): 1.0, (): 1.3}

    def state(names, clouds=False):
        terms = tuple(SimpleNamespace(name=n, sigmas_from_zero=9.0) for n in names)
        return SimpleNamespace(
            terms=terms,
            effects=names,
            model=SimpleNamespace(effects=names),
            heldout_or_fit_rms=of_effects[names],
            session=SimpleNamespace(has_clouds=clouds),
            tried={},
        )

    monkeypatch.setattr(stepwise, "change", lambda run, names, *_: state(tuple(names), run.session.has_clouds))
    monkeypatch.setattr(
        stepwise, "error_with", lambda run, names: state(tuple(names), run.session.has_clouds).heldout_or_fit_rms
    )
    monkeypatch.setattr(stepwise, "replace", lambda run, tried: SimpleNamespace(**vars(run) | {"tried": tried}))
    fewer, lines = stepwise._drop_idle(state(("a", "b")), set(), None)
    assert fewer.effects == ("a",) and "without b views left out are predicted better" in lines[0]
    assert stepwise._drop_idle(state(("a", "b")), {"b"}, None)[0].effects == ("a", "b")
    of_effects["a",] = 0.97
    assert stepwise._drop_idle(state(("a", "b"), clouds=True), set(), None)[0].effects == ("a", "b")
