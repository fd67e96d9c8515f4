"""Effects that are missing at once: what is idle is not named, and what was found first gives way to what does more.

What is learned where views were taken is judged where they were left out.

What sessions of one arm with other loads decide together, where gravity and gears are one curve.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import TARGETS, flange, labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis import stepwise_selection
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.ranking import Ranked, is_certain, rank_one
from stitch.diagnosis.stepwise_selection import exchanged_set, find_exchange, forward_selection, is_better_set
from stitch.diagnosis.thresholds import MAX_REMAINING_SHARE
from stitch.diagnosis.together import decide_together, together_document, together_sentence
from stitch.diagnosis.validation import CrossValidation, Extrapolation, extrapolate, untested_ends_reason
from stitch.effects.contract import EFFECTS
from stitch.model.model import Model
from stitch.numerics.folds import JointEnd
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

LOADS = (1.0, 6.0)
JUMP = np.array([3e-4, -2e-4, 4e-4, 0.15, 0.1, -0.2])  # rad, mm


def leaving(poses: float, sigma: float = 1e-3) -> CrossValidation:
    return CrossValidation(inside=poses, heldout=poses, poses=poses, poses_sigma=sigma, steadiness=1.0)


def ranked(name: str) -> Ranked:
    score = SimpleNamespace(name=name, candidate=SimpleNamespace(name=name), variances=None)
    return Ranked(score, adjusted=1e-9, log_posterior=9.0, posterior=0.99)


@pytest.mark.parametrize(
    ("left", "named", "idle"),
    [
        ({"part_sag": 0.999, "backlash": 0.9}, ["backlash"], ["part_sag"]),
        ({"part_sag": 0.9, "backlash": 0.999}, ["part_sag"], ["backlash"]),
        ({"part_sag": 0.9, "backlash": 0.9, "settling": 0.999}, ["part_sag", "backlash"], ["settling"]),
        ({"part_sag": 0.999, "backlash": 0.995}, [], ["backlash", "part_sag"]),
    ],
)
def test_an_effect_that_is_idle_is_not_named_and_said_to_be(monkeypatch, left, named, idle):
    monkeypatch.setattr(
        stepwise_selection,
        "conditioned_without",
        lambda linear, chosen, one: [r.name for r in chosen if r.name != one.name],
    )
    asked, scored = [], []

    def cross_validated(beside, score):
        asked.append((score.name, beside))
        return leaving(left[score.name])

    def again(beside, candidate, tests, start):
        scored.append((candidate.name, beside))
        return ranked(candidate.name)

    monkeypatch.setattr(stepwise_selection, "cross_validate", cross_validated)
    monkeypatch.setattr(stepwise_selection, "rank_one", again)
    monkeypatch.setattr(stepwise_selection, "is_certain", lambda r: True)
    kept, why = stepwise_selection.keep_worth_adding(None, [ranked(name) for name in left], 20)
    assert [r.name for r in kept] == named and list(why) == idle
    weakest = list(left)[-1]
    assert asked[0] == (weakest, list(left)[:-1])  # beside all that are missing
    assert all("hardly helps on views left out" in text for text in why.values())
    # What stays was scored beside what went: it is asked again.
    assert {name for name, _ in scored} >= (set(named) if idle else set())


def test_an_effect_is_worth_adding_from_a_hundredth_of_the_distances_on():
    assert (
        leaving(MAX_REMAINING_SHARE - 1e-6).rejection_reason("x") is None
        and leaving(MAX_REMAINING_SHARE + 1e-6).rejection_reason("x") is not None
    )
    assert leaving(0.9, sigma=0.2).rejection_reason("x") is not None


TRUE = ("joint_offset", "joint_compliance")


@pytest.fixture(scope="module")
def arm():
    """An arm of which every joint counts from a wrong zero and joint 2 gives way, and what may be asked of it."""
    offset = 1e-3 * np.random.default_rng(0).standard_normal(6)
    session, T_mount, _ = labelled_cell(2, views=100, offset=offset, sag=1e-6)
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    asked = (*TRUE, "gear_eccentricity", "gear_harmonic", "backlash", "settling")
    candidates = {name: c for name in asked if (c := candidate_of(linear, EFFECTS[name])) is not None}
    return linear, list(candidates.values()), {name: rank_one(linear, c, len(asked)) for name, c in candidates.items()}


def test_an_imitation_gives_way_to_what_is_there(arm):
    linear, candidates, alone = arm
    stuck = [alone["gear_eccentricity"], alone["gear_harmonic"]]
    found = exchanged_set(linear, candidates, stuck)
    assert {c.name for c in found} == set(TRUE)
    right = [alone[name] for name in TRUE]
    assert is_better_set(linear, right, stuck) and not is_better_set(linear, stuck, right)


def test_effects_that_are_there_stay(arm):
    linear, candidates, alone = arm
    assert exchanged_set(linear, candidates, [alone[name] for name in TRUE]) == []


@pytest.mark.parametrize("first", ["joint_offset", "part_slip"])
def test_a_jump_in_time_is_found_beside_an_effect_that_lasts(first):
    moved = np.outer(np.arange(100) >= 60, JUMP)
    session, T_mount, _ = labelled_cell(2, views=100, offset=1e-3, errors=(np.zeros((100, 6)), moved))
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    candidates = [candidate_of(linear, EFFECTS[name]) for name in ("joint_offset", "part_slip", "backlash")]
    best = rank_one(linear, next(c for c in candidates if c.name == first), len(candidates))
    found = forward_selection(linear, candidates, best)
    assert {r.name for r in found.effects} == {"joint_offset", "part_slip"}


def stands(session, name):
    """Whether an effect would be named, and what it leaves at left-out ends of joints' ranges."""
    linear = linear_model_of(run(session))
    own = rank_one(linear, candidate_of(linear, EFFECTS[name]), tests=1)
    return is_certain(own), extrapolate(linear, own.score)


def test_a_gear_error_of_a_joint_that_was_driven_everywhere_helps_at_left_out_ends_too():
    def gears(q):
        return 8e-4 * np.array([0, np.sin(2 * q[1] + 0.4), 0, 0, 0, 0])

    named, found = stands(labelled_cell(11, views=100, targets=TARGETS[:2], gears=gears)[0], "gear_harmonic")
    assert named and found.helps and found.share < 0.3


def test_gear_errors_fitted_to_noise_are_not_named():
    for seed in range(4):
        named, found = stands(labelled_cell(20 + seed, views=100, targets=TARGETS[:2])[0], "gear_harmonic")
        assert not (named and found.helps)


def test_gear_errors_that_imitate_another_error_are_told_by_left_out_ends():
    # Bumps in two joints' angles: among the measured poses two periods a turn explain a good part of them.
    refused = 0
    for seed in range(4):
        bumps = np.random.default_rng(seed).uniform(-1.2, 1.2, 6)

        def gears(q, bumps=bumps):
            return 1.5e-3 * np.array([0, *np.exp(-((q[1:3] - bumps[1:3]) ** 2) / 0.02), 0, 0, 0])

        named, found = stands(labelled_cell(20 + seed, views=200, targets=TARGETS[:2], gears=gears)[0], "gear_harmonic")
        assert named
        refused += not found.helps
    # Of bumps near the middle two periods a turn may be a fair picture.
    assert refused >= 3


def test_effects_that_no_end_tells_of_are_refused_in_one_sentence():
    end = JointEnd(1, upper=True, views=np.arange(3))
    for share, unseen in ((0.95, False), (0.985, True), (1.0, True), (1.015, True), (1.5, False)):
        assert Extrapolation(share, 0.1, end, 1.2, 0.1, 0.5).unseen == unseen
    told = untested_ends_reason(["backlash", "mount_warmup", "settling"])
    assert told.startswith("backlash, mount_warmup and settling help") and "less than 2% together" in told


def exchanged(session, name, rivals):
    """What takes the place of an effect that was found alone, if anything."""
    linear = linear_model_of(run(session))
    every = {n: candidate_of(linear, EFFECTS[n]) for n in (name, *rivals)}
    own = rank_one(linear, every[name], tests=1)
    return find_exchange(linear, list(every.values()), [own], {name: extrapolate(linear, own.score)})


def test_an_imitation_gives_way_to_what_is_likelier_to_hold_beyond():
    # What a joint's offset does, once a turn does too among the measured poses, and more than that at the ends.
    rivals, seen = ["joint_offset", "joint_compliance", "gear_harmonic", "backlash"], 0
    for seed in range(3):
        session, *_ = labelled_cell(40 + seed, views=150, targets=TARGETS[:2], offset=np.array([0, 1e-3, 0, 0, 0, 0]))
        imitation, found = stands(session, "gear_eccentricity")[1], exchanged(session, "gear_eccentricity", rivals)
        assert (found is not None) == imitation.errs_somewhere
        seen += found is not None
        assert found is None or (found[0], found[2].name) == ("gear_eccentricity", "joint_offset")
    assert seen


def test_an_effect_that_is_there_gives_way_to_nothing():
    def gears(q):
        return 8e-4 * np.array([0, np.sin(2 * q[1] + 0.4), np.cos(2 * q[2]), 0, 0, 0])

    rivals = ["joint_offset", "joint_compliance", "gear_eccentricity", "backlash"]
    for seed in range(3):
        session, *_ = labelled_cell(50 + seed, views=150, targets=TARGETS[:2], gears=gears)
        assert exchanged(session, "gear_harmonic", rivals) is None


def loaded(kg, seed, of_load):
    """Joint 2 turns by the reach, times the load or not."""
    rng = np.random.default_rng(seed)
    joints = rng.uniform(-1.2, 1.2, (20, 6))
    reach = np.array([flange(q)[:2, 3] @ [np.cos(q[0]), np.sin(q[0])] for q in joints])
    errors = np.outer(4e-7 * reach * (kg if of_load else 3.0), np.eye(6)[1])
    session, *_ = labelled_cell(seed, views=20, errors=(errors, np.zeros((20, 6))))
    robot = replace(session.robot, payload_mass=kg)
    return linear_model_of(run(replace(session, robot=robot)))


@pytest.mark.parametrize("of_load", [True, False])
def test_gravity_is_named_where_it_grows_with_the_load_and_only_there(of_load):
    found = decide_together([loaded(kg, seed, of_load) for seed, kg in enumerate(LOADS)])
    assert (found.effects == ("joint_compliance",)) == of_load
    assert together_document(found, ["a", "b"])["verdict"] == found.verdict
    if of_load:
        (load,) = (p for p in found.candidates[0].parameters if p.name == "c2")
        assert load.value > 5 * load.sigma
        assert together_sentence(found).startswith("joint_compliance is missing (")
