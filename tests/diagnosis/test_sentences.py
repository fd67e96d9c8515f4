"""A diagnosis says of the poses and the scans what was seen of them, and nothing where nothing was."""

from types import SimpleNamespace

import numpy as np
import pytest

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.ranking import too_large
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sentences import diagnosis_sentence, odds_text, scanner_advice, scanner_error_sentence
from stitch.diagnosis.verdict import Evidence
from stitch.effects.contract import Parameter
from stitch.observations.surfaces.field_error import FieldError


def linear_of(scanners):
    return SimpleNamespace(measurement=SimpleNamespace(views=SimpleNamespace(scanners=scanners)))


@pytest.mark.parametrize("verdict", ["adequate", "unknown_effect"])
def test_the_scatter_of_the_poses_is_told_where_there_is_one(verdict):
    common = {
        "verdict": verdict,
        "residual_rms": 0.0132,
        "noise_floor": 0.0142,
        "notes": ("a note",),
        "missing": {},
        "depends_on": (),
        "implausible": False,
        "repeating_errors": (),
        "overlap_misfit": 0.0,
        "follows_field": False,
        "scanner_error": None,
        "laws": (),
        "places": (),
        "candidates": (),
        "expected_scatter": ScatterLimit(4.5e-5, 0.04),
        "beyond_expected": False,
        "linear": linear_of(()),
    }
    told = diagnosis_sentence(SimpleNamespace(**common, rotation=2e-5, translation=0.02), "mm", None)
    assert "20 µm and 0.02 mrad" in told and told.endswith("Not named: a note.")
    assert "scales of scanners" not in told
    cell = diagnosis_sentence(
        SimpleNamespace(**common | {"linear": linear_of(("left", "right"))}, rotation=2e-5, translation=0.02),
        "mm",
        None,
    )
    assert ("beside scales of scanners that differ by 0.02 % (1 σ), explains" in cell) == (verdict == "adequate")
    silent = diagnosis_sentence(SimpleNamespace(**common, rotation=0.0, translation=0.0), "mm", None)
    assert "13.2 µm" in silent and "mrad" not in silent and "scatter" not in silent
    assert silent.endswith("Not named: a note.")


def test_more_than_an_expected_scatter_is_said_with_what_is_expected():
    found = SimpleNamespace(
        verdict="unknown_effect",
        residual_rms=0.153,
        noise_floor=0.02,
        rotation=1e-4,
        translation=0.09,
        notes=(),
        candidates=(),
        missing={},
        depends_on=(),
        implausible=False,
        expected_scatter=ScatterLimit(4.5e-5, 0.04),
        beyond_expected=True,
        repeating_errors=(),
        overlap_misfit=0.0,
        follows_field=False,
        scanner_error=None,
        laws=(),
        rival_trend="",
        places=(),
    )
    told = diagnosis_sentence(found, "mm", None)
    assert "ordinary arms stay below 40 µm and 0.045 mrad. So more is left than scatter explains." in told


_LASTING = SimpleNamespace(term=SimpleNamespace(parameters=()))
NOT_FITTED = SimpleNamespace(fitted=False, form=_LASTING)


def said_at(odds: float, verdict: str, *effects: str, score=NOT_FITTED) -> str:
    """What is said of effects at such odds over nothing."""
    ranked = SimpleNamespace(score=score, adjusted=1e-3)
    found = SimpleNamespace(
        verdict=verdict,
        effects=effects,
        candidates=[SimpleNamespace(name=name, ranked=ranked, cross_validation=None, aliases={}) for name in effects],
        next=(),
        residual_rms=0.0132,
        noise_floor=0.0110,
        rotation=0.0,
        translation=0.0,
        log_odds_over_nothing=np.log(odds),
        coincidence="",
        laws=(),
        rival_trend="",
        beyond_belief=too_large([SimpleNamespace(score=score)]) if score.fitted else (),
    )
    found.certain = Diagnosis.certain.fget(found)
    return diagnosis_sentence(found, "mm", None)


@pytest.mark.parametrize(
    ("together", "notes", "said"),
    [
        (("settling", "backlash"), (), "It is missing too; beside it, most stays unexplained without settling."),
        (("settling",), ("backlash helps among the measured poses, but not beyond",), "But backlash helps among the"),
        (("settling", "latency"), (), "Beside settling and latency it is not needed."),
    ],
)
def test_the_sentence_says_why_the_likeliest_in_the_table_is_not_named(together, notes, said):
    ranked = SimpleNamespace(score=NOT_FITTED, adjusted=1e-3, posterior=1.0)
    found = SimpleNamespace(
        verdict="missing_effect",
        effects=("settling",),
        candidates=[SimpleNamespace(name=n, ranked=ranked, cross_validation=None) for n in ("backlash", "settling")],
        residual_rms=0.0132,
        noise_floor=0.0110,
        certain=True,
        beyond_belief=(),
        log_odds_over_nothing=np.inf,
        together=together,
        notes=notes,
    )
    told = diagnosis_sentence(found, "mm", None)
    assert f"Alone, backlash would explain more (posterior 1.00). {said}" in told


@pytest.mark.parametrize(("odds", "said"), [(25.0, "is missing ("), (4.0, "may be missing (")])
def test_a_name_less_than_twenty_to_one_over_chance_may_be_missing(odds, said):
    told = said_at(odds, "missing_effect", "settling")
    assert said in told and ("more than chance are 4 to 1." in told) == (odds < 20)


@pytest.mark.parametrize(("effect", "said"), [("range_scale", True), ("settling", False)])
def test_a_scale_of_the_scanner_may_be_one_of_the_arm(effect, said):
    assert ("arm lengths that are all off by the same share" in said_at(25.0, "missing_effect", effect)) == said


def test_a_size_beyond_belief_is_asked_about_and_not_certain():
    """No size forbids a name: a number in a table may be wrong."""
    free = [Parameter(name, "mm", typical=0.3, limit=5.0) for name in ("da1", "da2")]
    form = SimpleNamespace(free=free, term=SimpleNamespace(parameters=[]), sizes=np.array([0.3, 0.3]))
    score = SimpleNamespace(fitted=True, form=form, values=np.array([0.1, -8.0]), sigmas=np.array([0.02, 0.02]))
    told = said_at(1e9, "missing_effect", "link_geometry", score=score)
    assert "da2 = -8 ± 0.02 mm" in told
    assert told.endswith(" da2 is larger than is believable: check session.toml.")
    assert told.startswith("link_geometry may be missing") and "odds" not in told


@pytest.mark.parametrize(("odds", "said"), [(25.0, "Something is missing: "), (4.0, "Something may be missing: ")])
def test_a_group_less_than_twenty_to_one_over_chance_may_be_missing(odds, said):
    told = said_at(odds, "cannot_tell", "settling", "backlash")
    assert told.startswith(said) and ("more than chance are 4 to 1." in told) == (odds < 20)
    assert "missing: settling or backlash. These views cannot tell which." in told


def test_odds_of_a_group_are_that_one_of_it_is_there():
    """Odds add up: two at 10 to 1 each are 20 to 1 that one is there."""
    each = SimpleNamespace(log_odds_over_nothing=np.log(10.0))
    group = Evidence((each, each), (), alarm=True, explanation=(each, each))
    assert group.log_odds_over_nothing == pytest.approx(np.log(20.0))
    assert Evidence((), ()).log_odds_over_nothing == np.inf


def test_odds_are_told_as_far_as_anybody_can_vouch_for_them():
    assert [odds_text(np.log(x)) for x in (4.0, 0.5, 1e4, 1e-4)] == [
        "4 to 1",
        "1 to 2",
        "more than 100 to 1",
        "1 to more than 100",
    ]
    assert odds_text(-np.inf) == "1 to more than 100"


SAME_IN_ALL = FieldError(0.02, 0.0, 9.0, over_noise=False)
BOTH_KINDS = FieldError(0.02, 0.01, 9.0, over_noise=True, with_time=True)
OF_EACH_VIEW = FieldError(0.0, 0.03, 9.0, over_noise=True, by_view=True)


def test_the_clearer_kind_is_said_with_its_size():
    same, both, own = (scanner_error_sentence(found, "mm") for found in (SAME_IN_ALL, BOTH_KINDS, OF_EACH_VIEW))
    assert "the same in every view: 20 µm" in same and "by itself" not in same
    assert "the same in every view" in both and "each view errs by itself, larger as the session goes on" in both
    assert "of its own: 30 µm" in own and "same" not in own


def test_a_scanner_error_that_the_poses_alone_show_has_no_size():
    assert "rms" not in " ".join(scanner_advice(None, "mm"))
    assert "20 µm rms" in " ".join(scanner_advice(SAME_IN_ALL, "mm"))
    assert "again at the end" in " ".join(scanner_advice(OF_EACH_VIEW, "mm"))
