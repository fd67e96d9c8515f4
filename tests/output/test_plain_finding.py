"""What a diagnosis says on the shop floor, the command that it names, and its sources of error."""

from types import SimpleNamespace

import numpy as np
import pytest

import stitch.diagnosis.validation as validation
import stitch.output.finding_screen as finding_screen
import stitch.output.plain_finding as plain
from bench.docs.page_examples import refused
from stitch.api import stepwise
from stitch.cli.diagnose import show_budget
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.sentences import posterior_text, why_without_a_name
from stitch.diagnosis.validation import CrossValidation
from stitch.effects import EFFECTS
from stitch.observations.surfaces.field_error import FieldError, FieldMap
from stitch.output.comparison.run_verdict import prediction_text
from stitch.output.diagnosis_document import DIAGNOSIS
from stitch.output.plain_finding import largest_error_sources, next_step_line, plain_finding, remedy_at_machine
from stitch.output.plain_words import effect_in_words
from stitch.screening.pose_tests import PoseStep
from viz.review.run_snapshot import told_diagnosis


def finding(verdict, *effects, **more):
    """A certain diagnosis in a session without doubts; `more` says what is otherwise."""
    candidates = [SimpleNamespace(name=name, cross_validation=None) for name in effects]
    usual = {"laws": (), "rival_trend": "", "doubts": (), "dropped_before": None, "certain": True, "curves": ()}
    usual |= {"likelier_than_not": True, "time_curve": None, "candidates": candidates, "effects": effects, "next": ()}
    return SimpleNamespace(verdict=verdict, **usual | more)


def test_every_effect_of_the_library_has_words():
    library = [effect.name for effect in EFFECTS.values() if effect.tier == "physical"]
    said = [effect_in_words(name) for name in library]
    assert len(said) > 20 and len(set(said)) == len(said)
    assert all(words.startswith(f"{name} (") for name, words in zip(library, said, strict=True))
    assert effect_in_words("of_my_own") == "of_my_own"


@pytest.mark.parametrize("verdict", ["missing_effect", "cannot_tell", "unknown_effect", "adequate"])
@pytest.mark.parametrize(("curves", "time_curve"), [((), None), (("of joint 3",), None), ((), "of the flange")])
@pytest.mark.parametrize("follows_field", [False, True])
def test_the_next_command_can_be_typed(monkeypatch, verdict, curves, time_curve, follows_field):
    """No formula is looked for of what the scanner itself errs by."""
    monkeypatch.setattr("stitch.output.plain_finding.group_share", lambda linear, group: (0.7, 0.1))
    more = {"curves": curves, "time_curve": time_curve, "linear": None, "follows_field": follows_field}
    found = finding(verdict, **more)
    command = next_step_line(found, "RUN").rsplit(": ", 1)[1]
    assert command.startswith("stitch ") and refused(command) is None
    explained = verdict == "unknown_effect" and bool(curves or time_curve) and not follows_field
    assert ("explain" in command) == explained


@pytest.mark.parametrize("share", [0.949, 0.951])
def test_a_group_that_is_refused_is_not_proposed(monkeypatch, share):
    """Neither before it was asked for nor, again, right after: `stitch add --group` judges by the same number."""
    for module in (plain, validation):
        monkeypatch.setattr(module, "group_share", lambda linear, group: (share, 0.05))
    cause = SimpleNamespace(name="play", ranked=SimpleNamespace(score=None))
    linear = SimpleNamespace(measurement=SimpleNamespace(length_unit="mm"))
    found = finding("cannot_tell", "play", candidates=(cause,), sentence="", linear=linear)
    monkeypatch.setattr(stepwise, "diagnose", lambda state: found)
    monkeypatch.setattr(stepwise, "change", lambda state, effects, recorder: pytest.fail("it is added"))
    command = next_step_line(found, "RUN").rsplit(": ", 1)[1]
    assert refused(command) is None and ("--group" in command) == (share < 0.95)
    if share > 0.95:
        model = SimpleNamespace(effects=[])
        assert stepwise.suggest_group(SimpleNamespace(model=model))[0] is None and command == "stitch next RUN"


def test_where_a_view_decides_it_comes_before_a_group():
    """On the terminal as on the page; the review's main button is this command."""
    found = finding("cannot_tell", "play", "sag", next=(SimpleNamespace(probability=0.7),))
    command = next_step_line(found, "RUN")
    assert command.endswith(": stitch next RUN -o next.src")
    document = {"verdict": "cannot_tell", "effects": ["play", "sag"], "plain": "", "sentence": ""}
    assert told_diagnosis(document | {"next_command": command}, 1e3)["advised"] == "next"
    assert told_diagnosis(document | {"next_command": "Next: stitch add RUN --group"}, 1e3)["advised"] == "group"
    assert told_diagnosis(document | {"next_command": "Next: stitch export RUN --to ros"}, 1e3)["advised"] == "export"


def test_a_table_holds_no_number_that_did_not_decide():
    """How often an effect is met shares out what the views cannot: beside "cannot tell" only the sum is known."""
    shares = {"joint_offset": 0.94, "joint_step": 0.004, "sag": 0.01}
    rivals = ("joint_offset", "joint_step")
    told = [posterior_text("cannot_tell", rivals, shares, name) for name in shares]
    assert told == ["0.94 together", "0.94 together", "0.01"]
    assert posterior_text("missing_effect", ("joint_offset",), shares, "joint_offset") == "0.94"
    assert posterior_text("cannot_tell", ("joint_offset",), shares, "joint_offset") == "cannot tell"


@pytest.mark.parametrize("verdict", ["missing_effect", "cannot_tell", "unknown_effect", "adequate"])
def test_no_model_is_built_on_a_doubtful_session(verdict):
    found = finding(verdict, "backlash", curves=("of joint 3",), doubts=("knocked",))
    command = next_step_line(found, "RUN").rsplit(": ", 1)[1]
    assert command == "stitch review RUN" and refused(command) is None


@pytest.mark.parametrize("moved", ["part", "scanner"])
@pytest.mark.parametrize("distinguishable", [True, False])
@pytest.mark.parametrize("further", [(), ("knocked",)])
@pytest.mark.parametrize("named", ["part_slip", "mount_step"])
def test_a_step_that_is_named_is_no_doubt_beside_it(moved, distinguishable, further, named):
    """The step and the effect are one sentence; a scanner that was knocked is no slip of the part, and none is it."""
    step = PoseStep(2, moved, distinguishable, (7e-4, 0.12), (7e-4, 0.12), 1e-30)
    found = finding("missing_effect", named, doubts=(step.describe(["a", "b", "c", "d"], "mm"), *further))
    same = distinguishable and named == ("part_slip" if moved == "part" else "mount_step")
    told, command = plain_finding(found, "mm"), next_step_line(found, "RUN").rsplit(": ", 1)[1]
    assert (f"{named} (from view c on the {moved} sits elsewhere, " in told) == same
    assert told.count("sits elsewhere") == 1
    assert ("may only be consequences" in told) == (not same or bool(further))
    assert command == ("stitch add RUN --suggested" if same and not further else "stitch review RUN")


def test_what_the_scans_err_by_is_part_of_what_explains_the_rest():
    """Beside adequate it is no second thing that contradicts the first."""
    same = FieldError(0.017, 0.0, 9.0, over_noise=False)
    own = FieldError(0.0, 0.012, 9.0, over_noise=False, by_view=True)
    for smooth, said in ((None, "arm's scatter explain"), (same, "own error (17 µm over"), (own, "own error (12 µm, ")):
        assert said in plain_finding(finding("adequate", scanner_error=smooth), "mm")


@pytest.mark.parametrize(
    ("odds", "said"),
    [
        (25.0, "Missing in the model: settling"),
        (4.0, "against chance are 4 to 1."),
        (0.5, "against chance are 1 to 2."),
    ],
)
def test_a_name_that_may_be_chance_is_no_statement(odds, said):
    """20 to 1 over nothing, as over every other name."""
    found = finding("missing_effect", "settling", log_odds_over_nothing=np.log(odds), beyond_belief=())
    found.certain = Diagnosis.certain.fget(found)
    found.likelier_than_not = Diagnosis.likelier_than_not.fget(found)
    told = plain_finding(found, "mm")
    assert ("though chance is more likely" in told) == (odds < 1)
    assert said in told and told.startswith("Perhaps missing") == (odds < 20)


@pytest.mark.parametrize(
    ("inside", "poses", "said"),
    [
        (0.25, 0.64, "reduce the error from 40 µm to 20 µm"),
        (1.02, 0.64, "predicted about 20% better"),
        (1.02, 1.1, "with it, rms)."),
    ],
)
def test_an_error_that_should_rise_is_no_gain(inside, poses, said):
    """Of 20 µm of scatter a small effect moves the residual by less than chance does, either way."""
    left = CrossValidation(inside=inside, heldout=1.0, poses=poses, poses_sigma=0.1, steadiness=0.9)
    found = finding("missing_effect", "settling", residual_rms=0.04)
    found.candidates[0].cross_validation = left
    told = plain_finding(found, "mm")
    assert said in told and ("reduce the error" in told) == (inside < 1)


def _found(
    verdict: str, p_value: float, *, certain: bool = True, heldout: float = 0.5, posterior: float = 0.97
) -> SimpleNamespace:
    """A diagnosis of one effect that helps, and another that holds 3 % where both hold all."""
    ranked, other = (
        SimpleNamespace(
            name="play",
            adjusted=p_value,
            posterior=share,
            tests=21,
            score=SimpleNamespace(observable=seen, fitted=True),
        )
        for share, seen in ((posterior, True), (posterior * 3 / 97, False))
    )
    candidate = SimpleNamespace(name="play", ranked=ranked, cross_validation=SimpleNamespace(heldout=heldout))
    effects = ("play",) if verdict == "missing_effect" else ()
    candidates = (candidate, SimpleNamespace(name="sag", ranked=other, cross_validation=None))
    more = {
        "depends_on": (SimpleNamespace(p_value=p_value),),
        "repeating_errors": (),
        "implausible": False,
        "notes": (),
    }
    odds = np.log(3)
    return finding(verdict, *effects, candidates=candidates, certain=certain, log_odds_over_nothing=odds, **more)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (_found("missing_effect", 1e-46), "less than one of a million sessions (p = 1e-46). Of 1 known effects tried"),
        (_found("missing_effect", 1e-3), "one of 1,000 sessions (p = 0.001). Of 1 known effects tried, it holds 97%"),
        (
            _found("missing_effect", 1e-3, posterior=0.22),
            "it holds 97% of the evidence. Its cause is less sure: a curve without a name would explain as much.",
        ),
        (
            _found("missing_effect", 1e-3, certain=False),
            "Not very sure: the odds that it is more than chance are 3 to 1",
        ),
        (_found("unknown_effect", 2e-4), "one of 5,000 sessions (p = 0.0002)."),
        (_found("unknown_effect", 0.4), "play comes nearest. Chance alone would show as much in 40% of such sessions"),
        (_found("adequate", 0.4), "play comes nearest. Chance alone would show as much in 40% of such sessions"),
    ],
)
def test_the_screen_says_how_sure_it_is(found, said):
    assert said in finding_screen.certainty(found)


@pytest.mark.parametrize(
    ("curves", "said"),
    [
        ((), "look for what changes with the angle of joint 2."),
        ((SimpleNamespace(joint=5, place="joint 5"),), "have joint 5 checked: gear, bearing, and what hangs on it."),
    ],
)
def test_where_no_effect_is_named_the_machine_is_still_told_of(curves, said):
    follows = (SimpleNamespace(covariate="j2_deg", p_value=1e-9),)
    found = finding("unknown_effect", curves=curves, depends_on=follows, follows_field=False)
    assert remedy_at_machine(found) == f"At the machine: {said}"
    for by_view, told in ((False, "At the machine: have the scanner calibrated."), (True, "")):
        found.follows_field, found.scanner_error = True, SimpleNamespace(by_view=by_view)
        assert remedy_at_machine(found) == told


def test_it_is_said_when_to_act_at_the_machine():
    """The scans at hand are saved by the model; what is mended serves the next ones."""
    mount = "fasten the scanner's mount."
    said = remedy_at_machine(finding("missing_effect", "mount_drift"))
    assert said == f"At the machine, after adding it: {mount}"
    for effects, told in (((), "Nothing to do at the machine."), (("mount_drift",), f"At the machine: {mount}")):
        added = SimpleNamespace(model=SimpleNamespace(effects=effects))
        assert remedy_at_machine(finding("adequate", linear=added)) == told


def _trend(effect, drawn, **more):
    usual = {
        "effect": np.array(effect),
        "predicted": np.array(drawn),
        "views": np.arange(len(effect)),
        "of": "the mount",
    }
    return SimpleNamespace(**usual | {"value_unit": "mm", "follows": "time"} | more)


@pytest.mark.parametrize(
    ("trend", "said"),
    [
        (
            _trend([0, 0.1, 0.183], [-0.09, 0, 0.08]),
            "is off by up to 183 µm, of which the hand-eye takes all but 90 µm; it",
        ),
        (_trend([-0.1, 0, 0.1], [-0.1, 0, 0.1]), "is off by up to 100 µm; it goes with time."),
        (_trend([0, 0, 0.1], [0, 0, 0.1], follows="view order"), "1 of 3 views sit 100 µm away from the others."),
        (_trend([0.1, 0.1, 0], [0.1, 0.1, 0], follows="view order"), "The mount is off by up to 100 µm."),
    ],
)
def test_a_size_is_that_of_the_plot_or_says_what_the_hand_eye_takes(trend, said):
    assert said in finding_screen._size(trend, "mm")


@pytest.mark.parametrize(
    ("then", "said"), [(0.098, "though play takes the worst place of the part from 68 µm to 98"), (0.05, "")]
)
def test_a_worst_place_that_grows_is_said_beside_the_gain(then, said):
    before, after = (SimpleNamespace(overall=np.array([0.01, np.nan, worst])) for worst in (0.068, then))
    told = finding_screen._worse_place("play", before, after, "mm")
    assert said in told and bool(told) == bool(said)


def test_a_cause_beside_a_curve_without_a_name_is_no_headline_by_itself(monkeypatch):
    monkeypatch.setattr(finding_screen, "_cause", lambda candidate, trend: candidate.name)
    found = _found("missing_effect", 1e-9)
    found.verdict, found.rival_trend = "cannot_tell", "joint 3 errs along its angle"
    told = finding_screen._headline(found, {})
    assert "play, or joint 3 errs" in told.replace("Play", "play") and told.endswith("these views cannot tell which.")


@pytest.mark.parametrize(("heldout", "shown"), [(0.5, 1), (1.1, 0)])
def test_an_effect_that_makes_views_left_out_worse_is_offered_only_where_it_is_named(heldout, shown):
    assert len(finding_screen.compared(_found("adequate", 0.4, heldout=heldout))) == shown
    assert len(finding_screen.compared(_found("missing_effect", 0.4, heldout=heldout))) == 1


SHARES = {"sensor noise": 0.1, "backlash": 0.885, "smooth, unnamed": 0.009, "scanner field": 0.006, "joint_offset": 0.0}
BUDGET = tuple(BudgetLine(name, share, 0.02 * share**0.5, "mm") for name, share in SHARES.items())


def test_small_sources_are_told_together_and_nothing_is_lost():
    told = largest_error_sources(BUDGET)
    assert [line.source for line in told] == ["backlash", "sensor noise", "others"]
    assert sum(line.variance_share for line in told) == pytest.approx(1.0)
    assert sum(line.sigma**2 for line in told) == pytest.approx(0.02**2)
    assert largest_error_sources(()) == []


def test_the_terminal_tells_source_share_and_size(capsys):
    show_budget(BUDGET, "mm")
    told = "backlash 88 % (19 µm), sensor noise 10 % (6.3 µm), others 2 % (2.4 µm)"
    assert capsys.readouterr().err == f"The error of whole views (rms) comes from: {told}.\n"
    show_budget((), "mm")
    assert not capsys.readouterr().err


def test_a_map_is_written_with_null_where_nothing_was_seen():
    error = np.array([[0.01, np.nan], [-0.01, 0.0], [0.02, 0.03]])
    drawn = FieldMap(
        np.array([-0.2, 0.2]), np.array([-0.1, 0.0, 0.1]), error, np.where(np.isfinite(error), 0.002, np.nan)
    )

    def map_of(scanner_error):
        key = next(key for key in DIAGNOSIS.keys if key.name == "field_map")
        return key.kind.write(key.write(SimpleNamespace(scanner_error=scanner_error)))

    written = map_of(FieldError(0.02, 0.0, 9.0, over_noise=True, map=drawn))
    assert written["x_over_z"] == [-0.2, 0.2] and written["y_over_z"] == [-0.1, 0.0, 0.1]
    assert written["error"] == [[0.01, None], [-0.01, 0.0], [0.02, 0.03]]
    assert written["sigma"][0] == [0.002, None]
    assert map_of(FieldError(0.02, 0.0, 9.0, over_noise=True)) is map_of(None) is None


@pytest.mark.parametrize("verdict", ["missing_effect", "adequate", "unknown_effect"])
@pytest.mark.parametrize("misfit", [0.0, 0.01])
def test_the_sources_of_the_error_add_up_to_it(verdict, misfit):
    """Squares, as of independent errors; what is named takes what it would take away, whatever else there is."""
    found = _found(verdict, 0.4, heldout=0.25)
    vars(found).update(heldout_rms=0.05, noise_floor=0.02, overlap_misfit=misfit, budget=BUDGET)
    found.linear = SimpleNamespace(model=SimpleNamespace(effects=()))
    told = {source["kind"]: source["rms"] for source in finding_screen.error_sources(found)}
    assert sum(rms**2 for rms in told.values()) == pytest.approx(0.05**2)
    assert told["scanner"] == pytest.approx(0.02)
    if verdict == "missing_effect":
        assert told["effect"] ** 2 == pytest.approx(0.75 * 0.05**2)
    else:
        assert "effect" not in told


def _changed(before, predicted, came):
    steps = (SimpleNamespace(heldout_rms=before), SimpleNamespace(heldout_rms=came, predicted=predicted))
    return SimpleNamespace(ledger=steps, session=SimpleNamespace(length_unit="mm"))


@pytest.mark.parametrize(
    ("came", "word"),
    [
        (0.054, ": less was gained than predicted."),
        (0.042, ", as predicted."),
        (0.02, ": more was gained than predicted."),
    ],
)
def test_what_was_predicted_stands_beside_what_came(came, word):
    said = prediction_text(_changed(0.09, 0.04, came))
    assert said == f"Predicted on held-out views: 90 µm to 40 µm; it came to {came * 1e3:.0f} µm{word}"
    assert prediction_text(_changed(0.09, float("nan"), came)) == ""


@pytest.mark.parametrize(
    ("observable", "p", "said"),
    [
        (False, 1.0, "these views can test no known effect"),
        (True, 0.006, "no known effect is clear enough to be named"),
        (True, 0.4, "no known effect explains it"),
    ],
)
def test_why_nothing_is_named_is_what_was_tested(observable, p, said):
    ranked = SimpleNamespace(score=SimpleNamespace(observable=observable), adjusted=p, name="base_compliance")
    diagnosis = SimpleNamespace(candidates=(SimpleNamespace(ranked=ranked),))
    assert why_without_a_name(diagnosis) == said
