"""What a run conducts: the last steps beside the screening, the method that was asked for, the arm of another run."""

import json
from concurrent.futures import CancelledError
from copy import deepcopy
from dataclasses import replace
from functools import cache
from threading import Event, current_thread

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import stitch
from bench import degenerate
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import change, run, run_rig
from stitch.errors import InputError
from stitch.fit import surface_steps
from stitch.fusion.fuse import RegisteredSession, fuse_every_point
from stitch.fusion.register import DEFAULT
from stitch.model.model_toml import keep_arm_effects
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import run_headline
from stitch.output.result_document import model_of
from stitch.output.run_folder import write_with_page
from stitch.output.stored_run import load_run
from stitch.recorder import RecorderMemory, SilentRecorder
from stitch.session.reading.session_folder import load_session
from stitch.system.threads import begin
from tests.command_line import ended
from viz.recording import run_markdown

OFFSET = np.array([0, 1e-3, -1.5e-3, 4e-4, 2e-3, 0])


@cache
def arm_of(seed, views=40):
    """What a session with its own mount says about the arm."""
    session, *_ = labelled_cell(seed, views=views, offset=OFFSET)
    return keep_arm_effects(model_of(run(session, effects=["joint_offset"])))


def error_of(found, T_mount):
    """Twist (6,) of the true hand-eye in the frame of the one found, rotation first."""
    relative = np.linalg.inv(found.T_mount) @ T_mount
    return np.append(Rotation.from_matrix(relative[:3, :3]).as_rotvec(), relative[:3, 3])


def told_of(found):
    """What a run says of the arm it was given: as a doubt, and as a note."""
    return [[line for line in own if "arm of the other run" in line] for own in (found.doubts, found.notes)]


class _Told(SilentRecorder):
    def __init__(self) -> None:
        self.told: list[tuple[str, int]] = []

    def iteration(self, stage: str, index: int, *_: object) -> None:
        self.told.append((stage, index))


def test_iterations_are_told_in_their_order_and_not_before():
    memory, recorder = RecorderMemory(), _Told()
    for index in range(3):
        memory.iteration("register", index, np.eye(4)[None], 1.0, 2.0)
    assert recorder.told == []
    memory.replay(recorder)
    assert recorder.told == [("register", 0), ("register", 1), ("register", 2)]


def test_a_stage_that_nobody_wants_ends_with_its_next_iteration():
    memory = RecorderMemory()

    def stage() -> None:
        for index in range(10**9):
            memory.iteration("register", index, np.eye(4)[None], 1.0, 2.0)

    begun = begin(stage)
    memory.stopped = True
    with pytest.raises(CancelledError):
        begun.result(timeout=10)


def test_an_error_is_raised_where_the_result_is_asked():
    with pytest.raises(ZeroDivisionError):
        begin(lambda: 1 / 0).result(timeout=10)


def test_views_are_fused_while_they_are_screened_and_errors_are_told(monkeypatch):
    session, threads = session_of(measured_blade(2, views=3, pixels=40)), []

    def fused(registered):
        threads.append(current_thread().name)
        return fuse_every_point(registered)

    monkeypatch.setattr(surface_steps, "fuse_every_point", fused)
    found = run(session)
    own = RegisteredSession(session, found.measurement, found.model, found.measurement.capture, found.poses)
    assert threads == ["stitch-beside"]
    assert np.array_equal(found.fused.points, fuse_every_point(own)[0].points)

    def without_room(registered):
        raise InputError("no room")

    monkeypatch.setattr(surface_steps, "fuse_every_point", without_room)
    with pytest.raises(InputError, match="no room"):
        run(session)


def test_numbers_are_handed_over_before_the_cloud_is_there(monkeypatch):
    session, looked_at = session_of(measured_blade(2, views=3, pixels=40)), Event()

    def fused(registered):
        assert looked_at.wait(timeout=30), "the run waited for the cloud"
        return fuse_every_point(registered)

    def look(runs):
        (early,) = runs
        numbers.update(T_mount=early.T_mount, covariance=early.mount_covariance, headline=headline_of(early))
        stages.extend(stage.name for stage in early.fit.stages_before)
        looked_at.set()

    def headline_of(found):
        return run_headline(found, model_history(found))

    numbers, stages, memory = {}, [], RecorderMemory()
    monkeypatch.setattr(surface_steps, "fuse_every_point", fused)
    (found,) = run_rig([session], recorders=[memory], on_registered=look)
    assert np.array_equal(found.T_mount, numbers["T_mount"])
    assert np.array_equal(found.mount_covariance, numbers["covariance"])
    assert headline_of(found) == numbers["headline"]
    assert [*stages, "fuse"] == [stage.name for stage in found.stages]
    assert [arguments[0].name for call, arguments in memory.calls if call == "stage"] == [*stages, "fuse"]
    assert memory.calls[-1][0] == "finish"
    # A copy holds the cloud and no thread.
    assert np.array_equal(deepcopy(found).fused.points, found.fused.points)


def test_the_method_is_written_read_again_and_kept_by_a_change(session, tmp_path):
    loaded = load_session(session)
    usual, asked = run(loaded), run(loaded, register="gicp")
    assert usual.register_method == DEFAULT
    assert asked.register_method == "gicp"
    assert not np.array_equal(usual.poses, asked.poses)
    write_with_page(asked, tmp_path)
    stages = json.loads((tmp_path / "result.json").read_text())["stages"]
    assert [stage.get("method") for stage in stages] == [None, None, "gicp", None]
    state = load_run(tmp_path)
    assert state.register_method == "gicp"
    assert change(state, []).register_method == "gicp"
    assert usual.register_method == DEFAULT
    assert "Registered by plane to plane (GICP)" in run_markdown(asked, None)
    assert "Registered by DPWVM-style weighted fit" in run_markdown(usual, None)


def test_a_method_of_another_name_is_bad_input(session):
    with pytest.raises(
        InputError, match="register icp: no method has this name; did you mean .gicp.*to fix: dpwvm, gicp or vmm"
    ):
        run(load_session(session), register="icp")
    ended("run", session, "--register", "icp", code=2)


def test_from_python_the_method_is_that_of_the_command(session):
    loaded = stitch.load_session(session)
    found = stitch.run(loaded, register="gicp")
    assert found.register_method == "gicp"
    assert np.array_equal(found.poses, run(loaded, register="gicp").poses)
    assert stitch.run_rig([loaded], register="gicp")[0].register_method == "gicp"


@pytest.mark.parametrize("mount", [pytest.param("eye_to_hand", marks=pytest.mark.slow), "eye_in_hand"])
def test_few_views_under_another_mount_gain_from_a_known_arm(mount):
    arm = arm_of(0)
    session, T_mount, _ = labelled_cell(1, views=8, mount=mount, offset=OFFSET)
    nominal, kept = run(session), run(session, arm=arm)
    assert kept.heldout_rms < 0.3 * nominal.heldout_rms
    assert np.linalg.norm(error_of(kept, T_mount)[3:]) < 0.3 * np.linalg.norm(error_of(nominal, T_mount)[3:])
    stated = arm.effects["joint_offset"]
    assert {p.name: (p.value, p.kept) for p in kept.terms[0].parameters} == {
        name: (p.value, True) for name, p in stated.items()
    }
    np.testing.assert_equal([p.sigma for p in kept.terms[0].parameters], [p.sigma for p in stated.values()])


@pytest.mark.slow
def test_errors_of_the_kept_arm_are_in_the_covariance_of_the_hand_eye():
    """Few views say what the arm is, many where the scanner sits: without the arm's own errors sigmas were far too small."""
    together, alone, degrees = 0.0, 0.0, 0
    for seed in range(12):
        session, T_mount, _ = labelled_cell(100 + seed, views=60, offset=OFFSET)
        arm = arm_of(200 + seed, views=9)
        found = run(session, arm=arm)
        xi = error_of(found, T_mount)
        together += xi @ np.linalg.solve(found.mount_covariance, xi)
        free = run(session, effects=["joint_offset"])
        alone += xi @ np.linalg.solve(free.mount_covariance, xi)
        degrees += 6
    assert together < chi2.ppf(0.999, degrees)
    assert alone > chi2.ppf(0.999, degrees)  # the test would see it


def test_the_command_keeps_the_arm_through_what_follows(tmp_path, stitch_command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (labelled_cell(seed, views=16, offset=OFFSET)[0] for seed in (0, 1))
    a, b = write_labelled(tmp_path / "a", first), write_labelled(tmp_path / "b", second)
    stitch_command("run", a, "-o", "ra", "--effects", "joint_offset", "--no-recording")
    stitch_command("run", b, "-o", "rb", "--arm", "ra", "--no-recording")
    stated = json.loads((tmp_path / "ra" / "result.json").read_text())["effects"]["joint_offset"]
    for command in ((), ("add", "rb", "link_geometry"), ("drop", "rb", "link_geometry")):
        if command:
            stitch_command(*command, "--no-recording")
        assert json.loads((tmp_path / "rb" / "result.json").read_text())["effects"]["joint_offset"] == stated


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--arm", "r", "--hand-eye", "r"], "--arm and --hand-eye"),
        (["--arm", "r"], "no effect of joints or links"),
        (["--arm", "nowhere"], "nowhere"),
    ],
)
def test_what_cannot_be_kept_is_refused_in_one_line(tmp_path, stitch_command, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    folder = write_labelled(tmp_path / "s", labelled_cell(0, views=8)[0])
    stitch_command("run", folder, "-o", "r", "--no-recording")
    capsys.readouterr()
    line = ended("run", folder, "-o", "q", *arguments, code=2).err
    assert told in line and line.count("\n") == 1
    assert not (tmp_path / "q").exists()


def test_a_kept_arm_is_held_against_the_nominal_one():
    session, *_ = labelled_cell(1, views=20, offset=OFFSET)
    doubts, (note,) = told_of(run(session, arm=arm_of(0)))
    assert not doubts and "where the nominal arm leaves" in note
    other, *_ = labelled_cell(1, views=20, offset=-OFFSET)
    (doubt,), notes = told_of(run(other, arm=arm_of(0)))
    assert not notes and "does not hold here" in doubt and "run without --arm" in doubt


def test_the_effect_of_a_kept_arm_that_errs_here_is_named():
    session, *_ = labelled_cell(1, views=20, offset=OFFSET)
    arm = arm_of(0)
    parameter = next(iter(arm.effects["joint_offset"].values()))
    wrong = {f"{letter}{joint}": replace(parameter, value=5e-4) for letter in "AB" for joint in (2, 3)}
    zero = {f"{letter}{joint}": replace(parameter, value=0.0) for letter in "AB" for joint in (1, 4, 5, 6)}
    imitated = replace(arm, effects={**arm.effects, "gear_harmonic": {**wrong, **zero}})
    (doubt,), _ = told_of(run(session, arm=imitated))
    assert "without its gear_harmonic" in doubt


_QUIET = settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@_QUIET
@given(
    seed=st.integers(0, 10_000), views=st.integers(2, 6), traits=st.sets(st.sampled_from(degenerate.TRAITS["points"]))
)
def test_no_session_of_labelled_points_ends_in_a_traceback(seed, views, traits):
    job = degenerate.drawn(seed) | {"kind": "points", "views": views, "traits": sorted(traits)}
    assert degenerate.trial(job)["crashes"] == []


@pytest.mark.slow
@settings(_QUIET, max_examples=15)
@given(
    seed=st.integers(0, 10_000), views=st.integers(2, 6), traits=st.sets(st.sampled_from(degenerate.TRAITS["clouds"]))
)
def test_no_session_of_scans_ends_in_a_traceback(seed, views, traits):
    job = degenerate.drawn(seed) | {"kind": "clouds", "views": views, "traits": sorted(traits)}
    assert degenerate.trial(job)["crashes"] == []


@pytest.mark.parametrize(
    ("kind", "views", "traits"),
    [
        ("clouds", 6, ["still"]),
        ("both", 3, ["missing_cloud"]),
        ("clouds", 5, ["missing_cloud"]),
        ("points", 4, ["no_sightings"]),
        ("points", 5, ["all_outliers"]),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("clouds", 4, ["part_still"]),
                ("clouds", 5, ["copied_row"]),
                ("clouds", 3, ["copied_row", "part_still"]),
                ("clouds", 3, []),
                ("clouds", 4, ["few_points"]),
                ("clouds", 6, ["plane", "two_places"]),
                ("points", 3, []),
            )
        ),
    ],
)
def test_what_once_ended_in_a_traceback_ends_in_a_result_or_a_sentence(kind, views, traits):
    job = degenerate.drawn(7) | {"kind": kind, "views": views, "traits": traits, "checked": False}
    outcome = degenerate.trial(job)
    assert outcome["crashes"] == [] and (outcome["result"] or outcome["refused"])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20286, 20421, 21224, 21798])
def test_a_draw_that_once_ended_in_a_traceback_ends_in_a_result_or_a_sentence(seed):
    outcome = degenerate.trial(degenerate.jobs([seed])[0])
    assert outcome["crashes"] == [] and (outcome["result"] or outcome["refused"])
