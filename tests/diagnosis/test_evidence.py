"""The verdict and what leads to it: questions asked in order, names held against what else may explain the views."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth import kinematics
from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from data_synth.ordinary_arm import draw_arm
from data_synth.write import robot_table
from stitch import diagnose, run
from stitch.diagnosis import evidence as gathering
from stitch.diagnosis import naming
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.evidence import gather_evidence, pair_is_validated
from stitch.diagnosis.naming import find_missing_pair
from stitch.diagnosis.ranking import Ranked, conditioned_on_effects, is_certain, rank_all, rank_one
from stitch.diagnosis.score import scatter_limit
from stitch.diagnosis.validation import CrossValidation
from stitch.diagnosis.verdict import Evidence
from stitch.effects.contract import EFFECTS, Parameter
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.observations.surfaces.field_error import FieldError
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.robot import forward
from stitch.session.session import Scanner, SessionData, Sighting, View
from tests.diagnosis.freed_blade import freed_blade

NO_CASE = gathering.Case(None, (), None)
ONE, OTHER = (SimpleNamespace(name=n, score=SimpleNamespace(log_bayes_factor=8.0)) for n in ("backlash", "settling"))
LARGE, SMALL = (FieldError(0.02, 0.0, gain, over_noise) for gain, over_noise in ((20.0, True), (5.0, False)))
REPEATS = (SimpleNamespace(words="wander"),)


@pytest.mark.parametrize(
    ("verdict", "evidence"),
    [
        ("missing_effect", {"alarm": True, "explanation": (ONE,)}),
        ("missing_effect", {"alarm": True, "explanation": (ONE,), "scanner_error": SMALL, "overlap_misfit": 0.1}),
        ("missing_effect", {"alarm": True, "explanation": (ONE,), "implausible_scatter": True}),
        ("cannot_tell", {"alarm": True, "explanation": (ONE, OTHER)}),
        ("cannot_tell", {"explanation": (ONE, OTHER)}),
        ("unknown_effect", {"alarm": True}),
        ("unknown_effect", {"alarm": True, "explanation": (ONE,), "unmodelled_explains_it": True}),
        ("unknown_effect", {"alarm": True, "explanation": (ONE,), "refuted": True}),
        ("unknown_effect", {"alarm": True, "explanation": (ONE,), "scanner_error": LARGE}),
        ("unknown_effect", {"repeating_errors": REPEATS}),
        ("unknown_effect", {"implausible_scatter": True}),
        ("unknown_effect", {"beyond_expected": True}),
        ("unknown_effect", {"scanner_error": LARGE}),
        ("unknown_effect", {"overlap_misfit": 0.1}),
        ("adequate", {"repeating_errors": (), "scanner_error": SMALL}),
        ("adequate", {}),
    ],
)
def test_each_row_of_the_table_of_verdicts_holds(verdict, evidence):
    found = Evidence((), (), **evidence)
    assert found.verdict == verdict
    assert found.named == (evidence["explanation"] if verdict in ("missing_effect", "cannot_tell") else ())


def test_a_second_effect_goes_with_the_first():
    pair = {"alarm": True, "explanation": (ONE,), "further": OTHER}
    assert Evidence((), (), **pair).second is OTHER
    assert Evidence((), (), **pair, refuted=True).second is None


HELPS = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.9)
USELESS = CrossValidation(inside=0.5, heldout=1.0, poses=1.0, poses_sigma=0.1, steadiness=0.9)


def ranked(name, beside=None, adjusted=1e-6):
    of = SimpleNamespace(name=name, empirical=False, effect=SimpleNamespace(prior=1.0))
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


@pytest.fixture
def without_halves(monkeypatch):
    monkeypatch.setattr(gathering, "objection_in_halves", lambda score: None)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: HELPS)
    monkeypatch.setattr(naming, "regime_of", lambda linear: SimpleNamespace(many_views=True))


def upheld(monkeypatch, evidence, *, together, refused):
    """With what the views say of two effects together, and names that the scanner's own error outweighs."""
    pair = together and (together.explanation[0], together.further)
    monkeypatch.setattr(naming, "regime_of", lambda linear: SimpleNamespace(many_views=False))
    monkeypatch.setattr(gathering, "find_missing_pair", lambda *asked: pair)
    monkeypatch.setattr(gathering, "pair_is_validated", lambda *asked: True)
    monkeypatch.setattr(gathering, "moves_points", lambda terms: True)
    outweighed = [[r.name for r in (e.explanation[0], e.further) if r is not None] for e in refused]
    found = {tuple(names): SMOOTH for names in outweighed}
    monkeypatch.setattr(
        gathering, "find_scanner_error", lambda linear, other_terms=(): found.get(tuple(t.name for t in other_terms))
    )
    return gathering.ask(gathering.TESTS[:3], NO_CASE, replace(evidence, proposed=evidence))


def rivals_of(evidence):
    return gathering.ask([gathering.which_predict_as_well], NO_CASE, evidence)


@pytest.mark.usefixtures("without_halves")
def test_a_second_effect_may_look_like_an_error_of_the_scanner(monkeypatch):
    found = upheld(monkeypatch, ALONE, together=PAIR, refused=[ALONE])
    assert (found.named, found.second, found.scanner_error) == ((FIRST,), SECOND, None)


@pytest.mark.usefixtures("without_halves")
@pytest.mark.parametrize("together", [None, PAIR])
def test_an_error_that_two_effects_do_not_explain_stays_the_scanners(monkeypatch, together):
    found = upheld(monkeypatch, ALONE, together=together, refused=[ALONE, PAIR])
    assert found.verdict == "unknown_effect" and not found.named and found.scanner_error is SMOOTH


@pytest.mark.usefixtures("without_halves")
@pytest.mark.parametrize(
    ("alone", "adjusted", "named"), [(HELPS, 1e-6, True), (USELESS, 1e-6, False), (HELPS, 0.2, False)]
)
def test_a_second_effect_without_the_first_is_asked_alone_and_by_chance_gets_no_name(
    monkeypatch, alone, adjusted, named
):
    first, second = ranked("backlash", beside=SECOND), ranked("fixture_drift", beside=FIRST)
    by_itself = ranked("fixture_drift", adjusted=adjusted)
    said = {id(first.score): USELESS, id(second.score): HELPS, id(by_itself.score): alone}
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: said[id(score)])
    evidence = Evidence((ranked("backlash"), by_itself), (), alarm=True, explanation=(first,), further=second)
    found = upheld(monkeypatch, evidence, together=None, refused=[])
    assert found.named == ((by_itself,) if named else ())
    assert named or found.verdict == "unknown_effect"
    assert "backlash" in found.notes[0]


@pytest.mark.usefixtures("without_halves")
@pytest.mark.parametrize(
    ("squares", "notes", "rivals"),
    [
        ((SAME, SAME), (), True),  # the same on views left out, though one is likelier in the fit
        ((WORSE, WORSE), (), False),
        ((SAME, WORSE), (), False),  # where points do not tell, poses do
        ((SAME, SAME), ("lens_distortion helps among the measured poses, but not beyond",), False),
    ],
)
def test_an_effect_that_predicts_views_left_out_as_well_is_not_told_from_the_name(monkeypatch, squares, notes, rivals):
    rival = replace(HELPS, fold_squares=squares)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: rival)
    named = {FIRST.name: replace(HELPS, fold_squares=((1.0,) * 4, (1.0,) * 4))}
    found = rivals_of(replace(ALONE, left_out=named, notes=notes))
    assert found.verdict == ("cannot_tell" if rivals else "missing_effect")
    assert found.named == ((FIRST, SECOND) if rivals else (FIRST,))
    # Where both are missing, each was asked beside the other.
    assert rivals_of(replace(PAIR, left_out=named)).named == (FIRST,)


@pytest.mark.usefixtures("without_halves")
@pytest.mark.parametrize(
    ("squares", "stands", "named"),
    [
        ((BETTER, BETTER), True, (SECOND,)),
        ((BETTER, SAME), True, (FIRST, SECOND)),  # points alone may be the scanner's noise
        ((BETTER, BETTER), False, (FIRST, SECOND)),
    ],
)
def test_an_effect_that_predicts_views_left_out_clearly_better_is_named_though_another_is_likelier(
    monkeypatch, squares, stands, named
):
    rival = replace(HELPS, fold_squares=squares, steadiness=0.9 if stands else 0.1)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: rival)
    left_out = {FIRST.name: replace(HELPS, fold_squares=((1.0,) * 4, (1.0,) * 4))}
    assert rivals_of(replace(ALONE, left_out=left_out)).named == named


@pytest.mark.usefixtures("without_halves")
@pytest.mark.parametrize(("together", "named"), [(PAIR, (FIRST,)), (None, (FIRST, SECOND))])
def test_rivals_that_a_second_effect_makes_equal_do_not_take_the_name(monkeypatch, together, named):
    alone = upheld(monkeypatch, ALONE, together=together, refused=[])
    rival = replace(HELPS, fold_squares=(SAME, SAME))
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: rival)
    left_out = {FIRST.name: replace(HELPS, fold_squares=((1.0,) * 4, (1.0,) * 4))}
    assert rivals_of(replace(alone, left_out=left_out)).named == named


ON_ONE_VIEW = CrossValidation(inside=0.5, heldout=0.6, poses=0.4, poses_sigma=0.1, steadiness=0.1)


def held(monkeypatch, left_out: CrossValidation) -> tuple[str, tuple[str, ...]]:
    """Verdict and notes after the question whether a name holds on views left out."""
    score = SimpleNamespace(name="backlash", base_model=None)
    named = Ranked(score, adjusted=1e-3, log_posterior=5.0, posterior=0.99)
    evidence = Evidence((named,), (), alarm=True, explanation=(named,))
    monkeypatch.setattr(gathering, "objection_in_halves", lambda score: None)
    monkeypatch.setattr(gathering, "cross_validate", lambda linear, score: left_out)
    upheld = gathering.ask([gathering.does_it_hold_elsewhere], NO_CASE, evidence)
    return upheld.verdict, upheld.notes


def test_a_name_that_holds_stays(monkeypatch):
    assert held(monkeypatch, HELPS) == ("missing_effect", ())


@pytest.mark.parametrize("found", [USELESS, ON_ONE_VIEW])
def test_the_alarm_stands_where_a_name_does_not_hold(monkeypatch, found):
    verdict, notes = held(monkeypatch, found)
    assert verdict == "unknown_effect"
    assert len(notes) == 1


def named_with_gain(gain: float) -> Evidence:
    """An effect of a joint that the data want by so many nats."""
    term = SimpleNamespace(effect=SimpleNamespace(place="robot"))
    score = SimpleNamespace(name="backlash", log_bayes_factor=gain, form=SimpleNamespace(term=term))
    ranked = Ranked(score, adjusted=1e-6, log_posterior=gain, posterior=0.99)
    return Evidence((ranked,), (), alarm=True, explanation=(ranked,))


def beside_the_scanner(monkeypatch: pytest.MonkeyPatch, evidence: Evidence, shown: FieldError | None) -> Evidence:
    monkeypatch.setattr(gathering, "find_scanner_error", lambda linear, other_terms=(): shown)
    return gathering.ask([gathering.does_the_scanner_explain_it], NO_CASE, evidence)


def scanner_error(gain: float, over_noise: bool = True) -> FieldError:
    return FieldError(0.02, 0.0, gain, over_noise)


def test_the_clearer_of_effect_and_scanner_error_is_said(monkeypatch):
    assert beside_the_scanner(monkeypatch, named_with_gain(80.0), scanner_error(20.0)).verdict == "missing_effect"
    refused = beside_the_scanner(monkeypatch, named_with_gain(8.0), scanner_error(20.0))
    assert refused.verdict == "unknown_effect" and not refused.named and "backlash" in refused.notes[0]


def test_a_scanner_error_is_not_adequate_where_it_exceeds_the_noise(monkeypatch):
    nothing = Evidence((), ())
    assert beside_the_scanner(monkeypatch, nothing, None).verdict == "adequate"
    assert beside_the_scanner(monkeypatch, nothing, scanner_error(8.0, over_noise=False)).verdict == "adequate"
    assert beside_the_scanner(monkeypatch, nothing, scanner_error(8.0)).verdict == "unknown_effect"


ASKED = ("joint_offset", "link_geometry", "gear_eccentricity", "backlash", "settling", "mount_drift", "fixture_drift")


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange and its freed views under the true hand-eye."""
    return freed_blade(4, 14)


def best_of(cell, play, drift):
    """Model, candidates and the likeliest of them where joint 5 has play (rad) and the flange drifts (mm a view)."""
    measured, views = cell.measured, cell.measurement.views
    off = np.zeros_like(measured.plan.joints)
    off[:, 4] = play * views.approach[:, 4]
    drifts = frames.exp(np.arange(views.count)[:, None] * drift * np.array([0, 0, 0, 0, 1.0, 0]))
    linear = cell.seen(drifts @ kinematics.flange(measured.plan.arm, measured.plan.joints + off))
    candidates = [c for name in ASKED if (c := candidate_of(linear, EFFECTS[name])) is not None]
    best = rank_all(linear, candidates)[0][0]
    assert is_certain(best)
    return linear, candidates, best


def test_two_effects_are_found_beside_each_other_and_hold(cell):
    linear, candidates, best = best_of(cell, play=4e-4, drift=0.03)
    pair = find_missing_pair(gathering.Case(linear, candidates, None), best)
    assert pair is not None and {r.name for r in pair} == {"backlash", "mount_drift"}
    assert pair_is_validated(linear, pair)
    score = next(r.score for r in pair if r.name == "backlash")
    found = dict(zip((p.name for p in score.form.free), score.values, strict=True))
    # q* = q − b·approach
    assert found["b5"] == pytest.approx(-4e-4, rel=0.3)


def test_a_pair_is_refused_where_one_of_the_two_does_not_help_on_views_left_out(cell):
    linear, candidates, best = best_of(cell, play=6e-4, drift=0.0)
    beside = conditioned_on_effects(linear, [best])
    idle = rank_one(beside, next(c for c in candidates if c.name == "fixture_drift"), len(candidates))
    assert best.name == "backlash" and not any(pair_is_validated(linear, pair) for pair in ((best, idle), (idle, best)))


@pytest.mark.parametrize(("play", "drift"), [(6e-4, 0.0), (0.0, 0.05)])
def test_no_second_effect_is_found_beside_one_that_is_alone(cell, play, drift):
    linear, candidates, best = best_of(cell, play=play, drift=drift)
    assert find_missing_pair(gathering.Case(linear, candidates, None), best) is None


@pytest.mark.parametrize(
    ("pair", "verdict", "named"),
    [((FIRST, SECOND), "missing_effect", (FIRST,)), (None, "cannot_tell", (FIRST, SECOND))],
)
def test_of_few_views_effects_that_come_near_each_other_are_a_group_unless_both_are_missing(
    monkeypatch, pair, verdict, named
):
    monkeypatch.setattr(naming, "regime_of", lambda linear: SimpleNamespace(many_views=False))
    monkeypatch.setattr(naming, "find_missing_pair", lambda *asked: pair)
    monkeypatch.setattr(naming, "conditioned_on_effects", lambda linear, chosen: linear)
    monkeypatch.setattr(naming, "rank_laws", lambda linear, dictionary: ())
    case = naming.Case(None, (), SimpleNamespace(without=lambda *asked: ()))
    asked = naming.NAMING[naming.NAMING.index(naming.which_come_near) :]
    found = naming.ask(asked, case, replace(ALONE, contenders=(FIRST, SECOND)))
    assert (found.verdict, found.named, found.second) == (verdict, named, SECOND if pair else None)


VIEWS, TURNS = 48, 30
JUMP = np.array([3e-4, -2e-4, 4e-4, 0.15, 0.1, -0.2])  # rad, mm


def evidence_of(third_joint):
    """What is said of a part that sits otherwise from a view on, where joint 3 comes from these sides (V,)."""
    moved = np.outer(np.arange(VIEWS) >= TURNS, JUMP)
    session, T_mount, _ = labelled_cell(3, views=VIEWS, errors=(np.zeros((VIEWS, 6)), moved))
    sides = np.random.default_rng(0).choice([-1.0, 1.0], (VIEWS, 6))
    sides[:, 2] = third_joint
    views = tuple(replace(view, approach=side) for view, side in zip(session.views, sides, strict=True))
    session = replace(session, views=views)
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    asked = ("part_slip", "backlash", "joint_offset")
    candidates = [c for name in asked if (c := candidate_of(linear, EFFECTS[name])) is not None]
    return gather_evidence(linear, candidates, scatter_limit(session))


ONCE = np.where(np.arange(VIEWS) < TURNS, 1.0, -1.0)


def test_a_jump_where_a_joint_turns_back_once_may_be_either():
    found = evidence_of(ONCE)
    assert found.verdict == "cannot_tell" and [r.name for r in found.named] == ["part_slip", "backlash"]
    assert found.coincidence == "part_slip begins at view v30, and from there on joint 3 comes from the other side"


@pytest.mark.parametrize(
    "third_joint", [np.where(np.arange(VIEWS) < TURNS - 8, 1.0, -1.0), ONCE * (-1.0) ** np.arange(VIEWS)]
)
def test_a_jump_that_no_joint_follows_is_one_in_time(third_joint):
    """The joint turns back eight views earlier, or to and fro all the time."""
    found = evidence_of(third_joint)
    assert found.verdict == "missing_effect" and [r.name for r in found.named] == ["part_slip"]


def test_of_two_that_are_missing_the_one_of_a_believable_size_is_named():
    """A gravity of the wrist 60 times as large as usual stands behind an offset that any arm may have."""
    sized = {}
    for name, value in (("joint_compliance", 3e-4), ("joint_offset", 1e-3)):
        parameter = Parameter("x1", "rad", typical=5e-6 if value < 1e-3 else 1e-3)
        form = SimpleNamespace(free=(parameter,), term=SimpleNamespace(name=name))
        known = {"values": (value,), "sigmas": (value / 50,), "form": form}
        one = ranked(name)
        sized[name] = replace(one, score=SimpleNamespace(**vars(one.score) | known))
    large, usual = sized.values()
    found = Evidence((large, usual), (), alarm=True, explanation=(large,), further=usual, together=(large, usual))
    after = gathering.ask([gathering.is_its_size_believable], NO_CASE, found)
    assert after.named == (usual,) and after.second is large and after.together == (usual, large)
    assert "joint_compliance is missing too, but x1 is larger than is believable" in after.notes
    alone = replace(found, further=None, together=(large,))
    assert gathering.ask([gathering.is_its_size_believable], NO_CASE, alone).named == (large,)


def swept_session(slip, at, rng):
    """Reflectors on an IRB 120 whose joints are swept in turn, each up and back; the part slips (6,) at a view."""
    arm = ARMS["ABB IRB 120"]
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    order = rng.permutation(6)
    rng.uniform(low, high)
    joints = []
    for joint in np.tile(order, 2):
        posture = rng.uniform(low, high)
        way = np.linspace(low[joint], high[joint], 6)
        joints += [np.where(np.arange(6) == joint, angle, posture) for angle in (*way, *(way[::-1] + 0.02))]
    joints = np.array(joints)
    true = draw_arm(6, 0.0, rng).flange(arm, joints)
    true = true @ frames.exp(np.repeat([2e-5, 0.02], 3) * rng.normal(size=joints.shape))
    true[at:] = true[at:] @ frames.exp(slip)
    X = frames.make(Rotation.random(rng=rng).as_matrix(), 1500 * rng.normal(size=3))
    rows = [{key: row[key] for key in ("a", "alpha_deg", "d", "theta_deg")} for row in robot_table(arm)["joints"]]
    robot = robot_from_dh("arm", "standard", rows, None, np.array([0, 0, -9.81]), "mm")
    views = []
    for v, (q, T) in enumerate(zip(joints, true, strict=True)):
        points = frames.transform(frames.inverse(X) @ T, TARGETS[:3]) + 0.01 * rng.normal(size=(3, 3))
        approach = np.sign(q - joints[max(v - 1, 0)])
        sighting = Sighting(("t0", "t1", "t2"), points, np.full(3, 0.01))
        views.append(View(f"v{v}", None, forward(robot, q), q, approach, 10.0 * v, {}, sighting))
    scanner = Scanner(None, 0.01, None, np.array([0, 0, 1.0]), "tracker")
    return SessionData(Path("arm"), "arm", "mm", "eye_to_hand", scanner, robot, None, None, None, tuple(views))


def test_a_step_of_the_last_joint_and_a_part_that_turned_about_its_axis_are_not_told_apart():
    found = diagnose(run(swept_session(np.array([0, 0, -3.1e-4, 0, 0, 0]), 48, np.random.default_rng(409))))
    assert found.verdict == "cannot_tell" and found.effects == ("joint_step", "part_slip")
