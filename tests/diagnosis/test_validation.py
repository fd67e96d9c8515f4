"""What is learned where views were taken is judged where they were left out."""

import numpy as np

from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.ranking import is_certain, rank_one
from stitch.diagnosis.stepwise_selection import find_exchange
from stitch.diagnosis.validation import Extrapolation, extrapolate, untested_ends_reason
from stitch.effects.contract import EFFECTS
from stitch.numerics.folds import JointEnd


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
