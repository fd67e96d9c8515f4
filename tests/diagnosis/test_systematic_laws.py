"""Laws at every place: each is found by its place and what it follows, and no effect is beaten by its own law."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures import labelled_arm
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidate_of, candidates_of
from stitch.diagnosis.diagnose import diagnose_state, linear_model_of
from stitch.diagnosis.effect_trend import trend_of_law
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.law_ranking import law_size, rank_laws
from stitch.diagnosis.ranking import stands_out
from stitch.diagnosis.score import scatter_limit, score
from stitch.diagnosis.sentences import law_in_words
from stitch.diagnosis.systematic_laws import (
    GRAVITY,
    STEP,
    Driver,
    Law,
    Place,
    dictionary_of,
    law_of,
)
from stitch.effects.contract import EFFECTS, effect, twist
from stitch.numerics.reml import fit_variances

VIEWS = 30
PAYLOAD = 3 + np.cos(np.arange(VIEWS) ** 1.5)


@pytest.fixture(scope="module")
def cell():
    """A session of labelled points that only scatter, with a column, as a linear model."""
    found = run(labelled_cell(5, views=VIEWS, payload=PAYLOAD)[0])
    return linear_model_of(found), scatter_limit(found.session)


@pytest.fixture
def own_effect():
    """A mount that follows the payload, as somebody writes it into a file of effects."""

    @effect("mount", needs=("payload_kg",), tier="user", xi=twist("/kg", 1e-4, 0.02))
    def mount_by_payload(views, xi):
        """M·exp(ξ (m − m₀))"""
        return np.outer(views.since_first("payload_kg"), xi)

    yield EFFECTS["mount_by_payload"]
    del EFFECTS["mount_by_payload"]


def shown(linear, column):
    """The same session where a column (n,) of the reduced observations is added to what was seen."""
    mixed = replace(linear.mixed, z=linear.mixed.z + column.reshape(linear.mixed.z.shape))
    return replace(linear, mixed=mixed, null=fit_variances(mixed, both_starts=True))


@pytest.mark.parametrize(
    ("place", "follows", "words"),
    [
        ("joint 3", "payload_kg", "joint 3 follows payload_kg (a line)"),
        ("joint 4", "j2_move_deg", "joint 4 follows j2_move_deg (in proportion)"),
        ("the scanner's stand or the base", STEP, "the scanner's stand or the base sits displaced from view v12 on"),
        ("the part on the flange", "payload_kg", "the part on the flange follows payload_kg (a line)"),
        ("the part on the flange", GRAVITY, "the part on the flange follows gravity (a step as it falls along y)"),
    ],
)
def test_a_law_is_found_by_its_place_and_what_it_follows(cell, place, follows, words):
    linear, _ = cell
    laws = [law for law in dictionary_of(linear).laws if law.key == (place, follows) and law.is_full]
    law = next(law for law in laws if law.words == words)
    size = np.zeros(len(law.sizes))
    size[0 if law.place.joint else 3] = 1e-3 if law.place.joint else 0.3
    found = rank_laws(shown(linear, law.reduced_columns(linear.observation) @ size), dictionary_of(linear))
    assert law_of(found[0]).key == law.key and stands_out(found[0])
    value, sigma, _ = law_size(linear, found[0])
    moved = np.ptp(law.shapes, axis=0).max() * size.max()
    assert abs(value - moved) < 4 * sigma + (0.3 if law.place.joint is None else 0.0) * moved


@pytest.mark.parametrize(
    ("driven", "said"),
    [
        (76, "the error of joint 5 changes with its angle, over the 76° driven"),
        (119, "the error of joint 5 changes with its angle, over the 119° driven"),
        (121, "joint 5 follows its angle (a wave, three times a turn)"),
    ],
)
def test_how_many_waves_a_turn_has_is_said_only_where_a_whole_one_was_driven(driven, said):
    shape = "a wave, three times a turn"
    angles = np.linspace(25.0, 25.0 + driven, 18)
    place = Place("joint 5", np.zeros((18, 6, 1)), np.ones(1), np.arange(1), ("rad",), joint=5)
    driver = Driver("j5_deg, in short waves", "deg", angles, {shape: np.zeros((18, 2))}, 5)
    law = Law(place, driver, shape, place.independent)
    assert law_in_words(law) == said
    base = replace(law, place=replace(place, name="joint 1 or the base"))
    assert ("the angle of joint 5" in law_in_words(base)) and ("a turn" in law_in_words(base)) == (driven > 120)


@pytest.mark.parametrize("still", [True, False])
def test_a_base_that_rocks_about_the_axis_of_joint_2_is_said_beside_the_joint(monkeypatch, still):
    """With joint 1 at rest the axis stands still in the base: both motions are one. Where it turns they are two."""
    drawn = labelled_arm.joints_of
    monkeypatch.setattr(labelled_arm, "joints_of", lambda rng, views: drawn(rng, views) * [1 - still, 1, 1, 1, 1, 1])
    errors = np.outer(PAYLOAD - 3, [0, 3e-4, 0, 0, 0, 0])
    session = labelled_cell(7, VIEWS, payload=PAYLOAD, errors=(errors, np.zeros((VIEWS, 6))))[0]
    found = diagnose_state(run(session))
    assert [law_of(r).place.name for r in found.laws] == ["joint 2", "the scanner's stand or the base"][: 1 + still]
    # The dots lie about the law by what is independent between views.
    trend = trend_of_law(found.linear, found.laws[0])
    assert trend.of == "joint 2" and trend.follows == "payload kg"
    assert 0.4 < np.mean(((trend.measured - trend.predicted) / trend.sigma) ** 2) < 2
    assert np.ptp(trend.predicted) > 5 * np.median(trend.sigma)


@pytest.mark.slow
def test_scatter_alone_stands_out_in_one_session_of_a_hundred(cell):
    """Of 40 draws, family-wise over all laws: three or more have a chance of 0.007."""
    linear, _ = cell
    rng = np.random.default_rng(3)
    half = np.linalg.cholesky(linear.covariance)
    dictionary = dictionary_of(linear)
    alarms = 0
    for _ in range(40):
        z = (half @ rng.standard_normal((*linear.mixed.z.shape, 1)))[..., 0]
        drawn = shown(linear, (z - linear.mixed.z).ravel())
        alarms += stands_out(rank_laws(drawn, dictionary)[0])
    assert alarms <= 2


def test_effects_say_the_laws_that_they_are(cell, own_effect):
    linear, _ = cell
    said = dictionary_of(linear, candidates_of(linear)[0]).said_by
    assert "mount_by_payload" in said["the scanner's stand or the base", "payload_kg"]
    assert "settling" in said["joint 2", "j2_move_deg"] and "settling" not in said["joint 2", "j3_move_deg"]
    assert "part_slip" in said["the part on the flange", STEP]
    assert not said["joint 3", "payload_kg"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["part_slip", "joint_offset", "gear_eccentricity", "settling", "mount_by_payload"])
def test_no_effect_loses_as_it_grows(cell, own_effect, name):
    """From its usual size to a hundred times: more evidence each time, and named each time."""
    linear, limit = cell
    candidate = candidate_of(linear, EFFECTS[name])
    form = candidate.forms[len(candidate.forms) // 2 if name == "part_slip" else 0]
    rng = np.random.default_rng(8)
    column = form.columns @ (rng.choice([-1, 1], len(form.sizes)) * form.sizes)
    candidates = candidates_of(linear)[0]
    evidence = []
    for amplitude in (1, 3, 10, 30, 100):
        seen = shown(linear, amplitude * column)
        evidence.append(score(seen, candidate).log_bayes_factor)
        found = gather_evidence(seen, candidates, limit)
        assert evidence[-1] < 3 or name in [r.name for r in found.named], (amplitude, found.verdict, found.laws[:2])
    assert (np.diff(evidence) > 0).all(), evidence
