"""Sessions of labelled points of one arm: its effects are common, hand-eye and targets each session's own."""

import json
from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run, run_rig
from stitch.cli.main import main
from stitch.effects.contract import EFFECTS
from stitch.errors import InputError
from stitch.fit.target_fit import LinearisedTargets, TargetSession
from stitch.model.forward import corrected_capture
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.observations.targets.rows import initial_landmarks

OFFSET = np.array([0, 1e-3, -0.7e-3, 0, 0.8e-3, 0])


def named(session, name):
    return replace(session, name=name, path=session.path / name)


@pytest.fixture(scope="module")
def days():
    """Two days: the sensor elsewhere, other poses, three targets and then one."""
    found = [
        labelled_cell(20, views=30, offset=OFFSET),
        labelled_cell(21, views=26, offset=OFFSET, targets=TARGETS[:1]),
    ]
    return [named(session, f"day {k}") for k, (session, *_) in enumerate(found)], [T for _, T, _ in found]


def test_the_arm_is_common_and_each_hand_eye_its_own(days):
    sessions, true = days
    runs = run_rig(sessions, effects=["joint_offset"])
    values = [[p.value for term in r.terms for p in term.parameters] for r in runs]
    assert values[0] == values[1]
    for r, T in zip(runs, true, strict=True):
        off = frames.log(frames.inverse(T) @ r.T_mount)
        sigma = np.sqrt(np.diag(r.mount_covariance))
        assert np.abs(off / sigma).max() < 4
        assert r.residual_rms < 0.5 * run(r.session).residual_rms
    sigmas = [p.sigma for term in runs[0].terms for p in term.parameters]
    off, joints = np.array(values[0]) - OFFSET, [1, 2, 4]
    assert np.all(np.abs(off[joints]) < 4 * np.array(sigmas)[joints])


def test_what_two_sessions_say_of_the_arm_adds_up(days):
    """Against the two alone: their estimates weighed by their own covariances (independent sessions)."""
    sessions, _ = days
    both = run_rig(sessions, effects=["joint_offset"])[0].terms[0]
    information, vector = np.zeros((3, 3)), np.zeros(3)
    joints = [1, 2, 4]
    for session in sessions:
        alone = run(session, effects=["joint_offset"])
        matrix = dict(zip(alone.model.effects_covariance.names, np.arange(9), strict=False))
        own = [matrix[f"joint_offset.d{j + 1}"] for j in joints]
        C = alone.model.effects_covariance.matrix[np.ix_(own, own)] / alone.targets.inflation
        information += np.linalg.inv(C)
        vector += np.linalg.solve(C, alone.terms[0].values[joints])
    expected, sigma = np.linalg.solve(information, vector), np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.abs(both.values[joints] - expected).max() < 0.5 * sigma.max()


def test_three_loads_share_one_compliance():
    """Each kilogram bends joint 2 by the same: one number explains all, where each load alone says little."""
    sag, loads = 4e-7, (1.0, 4.0, 8.0)
    sessions = [
        named(labelled_cell(30 + k, views=24, sag=sag, payload=np.full(24, kg))[0], f"load {k}")
        for k, kg in enumerate(loads)
    ]
    plain, bent = run_rig(sessions), run_rig(sessions, effects=["joint_compliance"])
    for before, after in zip(plain[1:], bent[1:], strict=True):
        assert after.heldout_rms < 0.7 * before.heldout_rms
    assert bent[2].residual_rms < 1.3 * bent[0].residual_rms


def test_other_arms_and_other_kinds_are_refused(days):
    sessions, _ = days
    other = replace(sessions[1], robot=replace(sessions[1].robot, theta=sessions[1].robot.theta + 1e-3))
    with pytest.raises(InputError, match="another arm"):
        run_rig([sessions[0], other])


def test_the_command_writes_a_folder_a_session_and_an_arm_to_keep(days, tmp_path, capsys):
    sessions, _ = days
    folders = [write_labelled(tmp_path / name, s) for name, s in zip(("one", "two"), sessions, strict=True)]
    out = tmp_path / "both"
    with pytest.raises(SystemExit) as stop:
        main(["run", *map(str, folders), "-o", str(out), "--effects", "joint_offset", "--no-recording", "--json"])
    assert not stop.value.code
    documents = json.loads(capsys.readouterr().out)
    assert documents[0]["effects"] == documents[1]["effects"]
    assert documents[0]["hand_eye"] != documents[1]["hand_eye"]
    third = write_labelled(tmp_path / "three", labelled_cell(22, views=24, offset=OFFSET)[0])
    with pytest.raises(SystemExit) as stop:
        main(["run", str(third), "-o", str(tmp_path / "r"), "--arm", str(out), "--no-recording", "--json"])
    assert not stop.value.code
    kept = json.loads(capsys.readouterr().out)
    assert kept["residual_rms"] < 0.5 * run(labelled_cell(22, views=24, offset=OFFSET)[0]).residual_rms


def test_a_parameter_that_goes_to_zero_is_made_up_for_in_the_same_step():
    """From a model with an offset that is no longer fitted, the step ends where it ends from a model without it."""
    session, *_ = labelled_cell(5, views=30)
    found = run(session)
    ends = []
    for value in (0.0, 1e-5):
        term = term_of(found.measurement, EFFECTS["joint_offset"])
        model = Model(found.model.T_mount, (term.at(np.array([0, value, 0, 0, 0, 0])),))
        landmarks = initial_landmarks(corrected_capture(found.measurement, model), model.T_mount)
        begun = TargetSession(found.measurement, model, landmarks)
        step = LinearisedTargets([begun], None).solve(np.zeros(6, bool))
        assert not step.model.terms[0].values.any()
        ends.append(step.model.T_mount)
    moved_by_it = 1e-5 * 1000
    assert np.abs(ends[0] - ends[1]).max() < 1e-2 * moved_by_it
