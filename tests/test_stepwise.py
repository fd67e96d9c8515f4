"""A group of effects that cannot be told apart: added as one where it helps on views left out, and only there."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch import pipeline as stepwise
from stitch.pipeline import diagnose, run

OFFSET = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])


@pytest.fixture(scope="module")
def first():
    session, *_ = labelled_cell(1, views=24, offset=OFFSET)
    return run(session)


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


def test_a_group_of_which_nothing_is_there_stays_out(monkeypatch):
    answered(monkeypatch, "cannot_tell", ("backlash", "settling"))
    session, *_ = labelled_cell(3, views=24)
    result, lines, _ = stepwise.suggest_group(run(session))
    assert result is None and "do not help on views left out" in lines[-1]


def test_what_has_a_name_is_no_group(first):
    result, lines, found = stepwise.suggest_group(first)
    assert found.verdict == "missing_effect" and result is None and "no group" in lines[-1]
    # For everybody first, then the evidence.
    assert lines[0].startswith("Missing in the model: joint_offset (a joint counts its angle from a wrong zero). Add")
    assert lines[1] == found.sentence


def test_what_is_less_likely_than_chance_is_not_added(first, monkeypatch):
    found = replace(diagnose(first), log_odds_over_nothing=-0.1)
    monkeypatch.setattr(stepwise, "diagnose", lambda state: found)
    result, lines, _ = stepwise.suggest(first, at_most=3)
    assert result is None and lines[-1].startswith("joint_offset was not added: chance is more likely.")
