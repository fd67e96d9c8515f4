"""Views are planned: searched, held against random ones, and written."""

import json
import shutil
from dataclasses import replace
from itertools import combinations
from unittest.mock import patch

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.write import write_session
from stitch.diagnosis.candidate_views import candidate_measurement
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.observations.surfaces.surface_model import surface_model
from stitch.plugins.metrology.planning import plan
from stitch.plugins.metrology.planning.expected_model import cell_of_session, simulate_views
from stitch.plugins.metrology.planning.information import TwistChannel, noise_of, separations
from stitch.plugins.metrology.planning.plan import (
    KnownPlace,
    PlanRequest,
    choose_views,
    place_lever,
    plan_further_views,
    travel_order,
    with_views,
)
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended


@pytest.fixture
def channel():
    rng = np.random.default_rng(0)
    half = rng.standard_normal((60, 60))
    return TwistChannel(half @ half.T + np.eye(60), rng.standard_normal((60, 9)))


def test_one_more_view_is_worth_what_the_whole_says(channel):
    rows = np.r_[0:12, 24:30, 48:54]
    inverse = np.linalg.inv(channel.covariance[np.ix_(rows, rows)])
    whole = channel.columns[rows].T @ inverse @ channel.columns[rows]
    np.testing.assert_allclose(channel.normal([0, 1, 4, 8]), whole, rtol=1e-9)
    np.testing.assert_allclose(channel.with_each([0, 1, 4], [2, 8])[1], whole, rtol=1e-9)


def test_a_pattern_keeps_what_its_rival_cannot_imitate(channel):
    """Least squares with a weak prior on the rival, column by column."""
    X = channel.columns
    left = separations(X.T @ X, slice(7, 9), slice(5, 7))
    rows = np.vstack([X[:, :7], np.hstack([np.zeros((2, 5)), 0.1 * np.eye(2)])])
    for k, y in enumerate(X[:, 7:].T):
        y = np.append(y, [0.0, 0.0])
        rest = y - rows @ np.linalg.lstsq(rows, y, rcond=None)[0]
        assert left[k] == pytest.approx(rest @ rest, rel=1e-6)


def test_what_a_view_does_not_see_is_as_good_as_unknown():
    information = np.diag([4.0, 4.0, 0.0, 1.0, 1.0, 1.0])[None]
    noise = np.diag(noise_of(information, variance=0.01, lever=2.0))
    np.testing.assert_allclose(noise[[0, 1, 3, 4, 5]], [0.0025, 0.0025, 0.01, 0.01, 0.01])
    assert noise[2] > 1e3


def test_the_chosen_views_are_the_best_there_are(channel):
    """Against all pairs of ten views beside the first; and driven the short way round."""
    joints = np.random.default_rng(1).uniform(-1, 1, (10, 6))
    goal = KnownPlace(channel, place_lever(np.array([0.0, 0.0, 1.0]), 9), now=1e3, share=1e-9)
    chosen = choose_views([goal], joints, present=3, most=2)
    best = min(float(goal.U(channel.normal([0, 1, 2, *pair]))) for pair in combinations(range(3, 10), 2))
    assert float(goal.U(channel.normal([0, 1, 2, *chosen]))) == pytest.approx(best, rel=0.02)
    assert travel_order(np.array([[0.0], [5.0], [1.0], [3.0]]), 0, [1, 2, 3]) == [2, 3, 1]


def test_the_lever_of_a_place_is_what_a_twist_moves_it_by():
    place, twist = np.array([40.0, -25.0, 300.0]), 1e-6 * np.array([3.0, -1.0, 2.0, 500.0, 100.0, -300.0])
    moved = frames.transform(frames.exp(twist), place[None])[0] - place
    np.testing.assert_allclose(place_lever(place, 15, 6)[:, 6:12] @ twist, moved, rtol=1e-4)
    assert not place_lever(place, 15, 6)[:, [*range(6), *range(12, 15)]].any()


def test_no_view_is_chosen_that_is_not_needed(channel):
    joints = np.zeros((10, 6))
    reached = float(
        np.min(KnownPlace(channel, place_lever(np.zeros(3), 9), 1.0).U(channel.with_each([0, 1, 2], range(3, 10))))
    )
    goal = KnownPlace(channel, place_lever(np.zeros(3), 9), now=reached / 0.5 * 1.001)
    assert len(choose_views([goal], joints, present=3, most=6)) == 1


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_where_there_is_no_hand_eye_yet_as_many_views_are_chosen_as_are_asked_for(channel, unit):
    """In any unit of length."""
    goal = KnownPlace(channel, place_lever(np.array([0.0, 0.0, unit]), 9), now=float("nan"))
    assert len(choose_views([goal], np.zeros((10, 6)), present=1, most=4)) == 4


def test_views_not_taken_yet_come_after_those_that_were():
    """Temperatures count from the session's first view, an event before them has happened, a scan at rest has no delay."""
    session, *_ = labelled_cell(2, views=9, grown=(0.0, 0.0))
    speeds = {f"j{i + 1}_velocity_deg_s": 5.0 for i in range(6)}
    session = replace(session, views=tuple(replace(v, covariates=v.covariates | speeds) for v in session.views))
    measurement = measurement_of(session, prepare_capture(session))
    later = candidate_measurement(measurement, measurement.views.joints[:3] + 0.1).views
    warmth = [v.covariates["part_temperature_c"] for v in session.views]
    np.testing.assert_allclose(later.since_first("part_temperature_c"), warmth[-1] - warmth[0])
    assert EFFECTS["part_slip"].function(later, xi=np.ones(6), v=8.0).all()
    assert not (EFFECTS["latency"].function(later.joints, later, dt=1.0) - later.joints).any()


VIEWS = 6


@pytest.fixture(scope="module")
def measured():
    return measured_blade(1, views=VIEWS, mount="eye_in_hand", pixels=8)


@pytest.fixture(scope="module")
def planned(tmp_path_factory, measured):
    """A session with poses and no clouds, and its part as a mesh."""
    folder = tmp_path_factory.mktemp("plan")
    write_session(folder / "s", measured, "s")
    shutil.rmtree(folder / "s" / "clouds")
    measured.mesh.export(folder / "blade.ply")
    return folder


@pytest.mark.slow
def test_before_any_scan_it_says_what_views_tell_and_which_to_add(planned, measured, stitch_command):
    options = ("--part", planned / "blade.ply", "--halve", "--views", 3, "-o", planned / "more", "--json")
    told = json.loads(stitch_command("plan", planned / "s", *options))
    assert told == json.loads((planned / "more" / "plan.json").read_text())
    assert told["format"] == "stitch-plan/1" and told["mount_frame"] == "flange"
    assert len(told["now"]["hand_eye"]["U"]) == 6 and told["now"]["views"] == VIEWS
    assert told["after"]["hand_eye"]["U_at_part"] < told["now"]["hand_eye"]["U_at_part"]
    assert told["now"]["hand_eye"]["U_at_part"] < told["now"]["hand_eye_of_an_ordinary_arm"]["U_at_part"]
    chances = [e for e in told["now"]["effects"] if e["observable"]]
    assert all(0 <= e["chance_named"] <= e["chance_detected"] <= 1 for e in chances)
    assert {"intensity_bias", "latency"} == set(told["now"]["not_asked"])
    # The poses are those of another kinematics at these joints, and the table can be driven and planned from.
    assert 0 < len(told["proposed"]) <= 3
    U = [told["now"]["hand_eye"]["U_at_part"], *(view["U_at_part"] for view in told["proposed"])]
    assert max(np.diff(U)) <= 0 and U[-1] == pytest.approx(told["after"]["hand_eye"]["U_at_part"])
    shutil.copy(planned / "s" / "session.toml", planned / "more")
    again = load_session(planned / "more", scans=False)
    for view, row in zip(again.views, told["proposed"], strict=True):
        T = kinematics.flange(measured.scene.arm, np.radians([row["joints_deg"]]))[0]
        np.testing.assert_allclose(row["pose"], T, atol=2e-2)
        np.testing.assert_allclose(view.T_base_flange, T, atol=2e-2)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (None, [], ["the scanned part is not stated", "--part", "--size"]),
        (None, ["--size", "-3"], ["--size -3", "to fix"]),
        (None, ["--size", "9", "--views", "0"], ["--views 0", "to fix"]),
        (None, ["--size", "9", "--field", "200"], ["--field 200", "to fix"]),
        (None, ["--size", "9", "--for", "hole"], ["--for 'hole'", "x,y,z"]),
        (None, ["--size", "9", "--for", "1,2,3,0,0,0"], ["no direction", "nx,ny,nz"]),
        (None, ["--part", "nowhere.stl"], ["nowhere.stl", "not found"]),
        (None, ["--size", "9", "--split", "elbow", "backlash"], ["no effect 'elbow'"]),
        (None, ["--size", "250", "--split", "backlash", "backlash"], ["--split", "two"]),
        (("pose", "_"), ["--size", "9"], ["session.toml", "scanner.pose"]),
        (("standoff", "_"), ["--size", "9"], ["session.toml", "scanner.standoff"]),
        ("no views", ["--size", "9"], ["no views.csv", "--start"]),
        ("no views", ["--size", "9", "--start", "0,1"], ["2 joint angles", "6"]),
        ("no views", ["--size", "9", "--start", "up"], ["--start 'up'", "to fix"]),
        ("nothing", ["--size", "9"], ["session.toml"]),
    ],
)
def test_bad_use_ends_in_one_line(planned, tmp_path, change, options, words):
    folder = tmp_path / "s"
    if change == "nothing":
        folder.mkdir()
    else:
        shutil.copytree(planned / "s", folder)
    if change == "no views":
        (folder / "views.csv").unlink()
    elif isinstance(change, tuple):
        text = (folder / "session.toml").read_text()
        table = text.index("[scanner]")
        end = text.index("[robot]") if text.index("[robot]") > table else len(text)
        text = text[:table] + _without(text[table:end], change[0]) + text[end:]
        (folder / "session.toml").write_text(text)
    told = ended("plan", folder, *options, "-o", tmp_path / "more", code=2)
    line = told.err.strip().splitlines()[-1]
    assert all(word in line for word in words)
    assert not (tmp_path / "more").exists()


def _without(table, key):
    """A TOML table without one key, whose value may go over several lines."""
    out, skip = [], False
    for line in table.splitlines():
        if line.startswith(f"{key} ="):
            skip = line.rstrip().endswith("[")
        elif skip:
            skip = line != "]"
        else:
            out.append(line)
    return "\n".join(out) + "\n"


@pytest.mark.slow
def test_without_any_view_it_proposes_them_all(planned, measured, tmp_path, stitch_command):
    shutil.copytree(planned / "s", tmp_path / "s")
    (tmp_path / "s" / "views.csv").unlink()
    start = ",".join(f"{x:.3f}" for x in np.degrees(measured.plan.joints[0]))
    options = ("--part", planned / "blade.ply", f"--start={start}", "--views", 8, "--json")
    told = json.loads(stitch_command("plan", tmp_path / "s", *options))
    assert told["now"] is None
    U = [view["U_at_part"] for view in told["proposed"]]
    assert 4 <= len(U) <= 8 and np.diff(U[2:]).max() <= 0
    assert told["after"]["hand_eye"]["U_at_part"] < 1.0


@pytest.mark.slow
def test_views_for_a_place_are_sought_again_close_to_the_first(planned):
    session = load_session(planned / "s", scans=False)
    known = cell_of_session(session, planned / "blade.ply")
    request, U = PlanRequest(split_any=False, views=3, feature=known.cell.part.centre), []
    for closer in (0, plan._CLOSER):
        with patch.object(plan, "_CLOSER", closer):
            U.append(plan_further_views(session, known, request).proposed[-1].U)
    assert U[1] < U[0]


@pytest.mark.slow
def test_views_that_are_to_split_two_effects_do(planned, measured):
    """A compliance, bent into the poses by the simulator's own kinematics: not named in the planned views, named with
    those that were proposed, in most draws of the arm's scatter."""
    session = load_session(planned / "s", scans=False)
    known = cell_of_session(session, planned / "blade.ply")
    rivals = ("joint_compliance", "gear_eccentricity")
    found = plan_further_views(session, known, PlanRequest(halve=False, split=rivals, split_any=False, views=8))
    assert found.proposed
    further = with_views(session, [view.joints for view in found.proposed])
    named = [[_named(s, known.cell, measured, draw) for draw in range(3)] for s in (session, further)]
    assert sum(named[1]) > sum(named[0]) and sum(named[1]) >= 2


def _named(session, cell, measured, draw):
    """Whether a diagnosis names the compliance, where views are freed to where a bent, scattering arm truly was."""
    rng, arm = np.random.default_rng([7, draw]), measured.scene.arm
    found = simulate_views(session, cell)
    joints = np.array([view.joints for view in session.views])
    torque = kinematics.gravity_torques(arm, joints)
    compliance = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]) * 4e-4 / np.abs(torque[:, 1]).max()
    scatter = rng.standard_normal((len(joints), 6)) * np.repeat([2e-5, 0.02], 3)
    true = kinematics.flange(arm, joints + compliance * torque) @ frames.exp(scatter)
    poses = true @ cell.model.T_mount
    freed = replace(found.unconstrained, poses=poses).relative_to(found.unconstrained.poses)
    linear = surface_model(found.measurement, cell.model, found.measurement.capture, freed)
    selection = gather_evidence(linear, candidates_of(linear)[0], scatter_limit(session_of(measured)))
    return selection.verdict == "missing_effect" and selection.named[0].name == "joint_compliance"
