"""Labelled points and measured probes against a cell written down here, and against scipy's least squares."""

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stitch.calibrate.robot_calibration import calibrated, dh_rows
from stitch.cli.main import main
from stitch.diagnosis import candidates
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.design.candidate_views import candidate_measurement
from stitch.diagnosis.diagnose import diagnose
from stitch.diagnosis.initial_values import evidence_of_state
from stitch.diagnosis.score import score
from stitch.diagnosis.selection.backward_elimination import eliminated_effect
from stitch.diagnosis.selection.ranking import certain, rank
from stitch.diagnosis.validation.extrapolation import extrapolation
from stitch.effects.contract import EFFECTS
from stitch.errors import InputError
from stitch.measurement.capture import capture
from stitch.measurement.labelled_points import Sighting
from stitch.measurement.measurement import Term, measurement_of
from stitch.measurement.robot import forward
from stitch.measurement.session import Scanner, Session, View
from stitch.model.forward import corrected, shift_targets
from stitch.model.jacobian import target_shifts
from stitch.observations.targets.closed_form import closed_form
from stitch.observations.targets.landmarks import initial_landmarks
from stitch.observations.targets.rows import effect_rows, rows_of
from stitch.pipeline import run
from stitch.reading.dh_rows import robot_from_dh
from stitch.reading.session_folder import load_session
from stitch.reading.urdf import robot_from_urdf
from stitch.stepwise import suggest
from stitch.stored.load_state import state_of
from stitch.writing.result_document import model_of
from stitch.writing.urdf_file import to_urdf

ROWS = [
    {"a": 0, "alpha_deg": -90, "d": 290}, {"a": 270, "alpha_deg": 0, "d": 0, "theta_deg": -90},
    {"a": 70, "alpha_deg": -90, "d": 0}, {"a": 0, "alpha_deg": 90, "d": 302}, {"a": 0, "alpha_deg": -90, "d": 0},
    {"a": 0, "alpha_deg": 0, "d": 72, "theta_deg": 180},
]  # fmt: skip
TARGETS = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0], [10.0, 5.0, 95.0]])


def flange(joints, offset=0.0, rows=ROWS):
    """Forward kinematics from elementary matrices, without the robot of the library."""
    T = np.eye(4)
    for q, row in zip(joints + offset, rows, strict=True):
        a, d, alpha, theta = row["a"], row["d"], np.radians(row["alpha_deg"]), q + np.radians(row.get("theta_deg", 0))
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T


def pose(rng, far):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * far
    return T


def cell(
    seed=0,
    views=40,
    mount="eye_to_hand",
    offset=0.0,
    scatter=(2e-5, 0.02),
    noise=0.01,
    probe=False,
    targets=TARGETS,
    sag=0.0,
    gears=None,
    grown=None,
):
    """A session, the true T_mount and the true targets in the reference frame.

    `gears` maps joints to their errors; `grown` is the growth per degree of the part and the point that stands still.
    """
    rng = np.random.default_rng(seed)
    joints = rng.uniform(-1.2, 1.2, (views, 6))
    T_mount = pose(rng, 2000 if mount == "eye_to_hand" else 60)
    places = targets if mount == "eye_to_hand" else targets + np.array([450.0, 100.0, 200.0])
    turn = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()
    rows, warmth = [], 22 + 6 * np.sin(np.arange(views) / 5)
    for v, q in enumerate(joints):
        jitter = np.eye(4)
        jitter[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * scatter[0]).as_matrix()
        jitter[:3, 3] = rng.normal(size=3) * scatter[1]
        reach = flange(q)[:2, 3] @ [np.cos(q[0]), np.sin(q[0])]
        bent = np.array([0, sag * reach, 0, 0, 0, 0])
        T = flange(q + bent + (0 if gears is None else gears(q)), offset) @ jitter
        T_sensor_reference = np.linalg.inv(T_mount) @ (T if mount == "eye_to_hand" else np.linalg.inv(T))
        rate, still = grown or (0.0, 0.0)
        own = places + rate * (warmth[v] - warmth[0]) * (places - still)
        seen = own @ T_sensor_reference[:3, :3].T + T_sensor_reference[:3, 3] + noise * rng.normal(size=places.shape)
        names = tuple(f"t{i}" for i in range(len(places)))
        sighting = Sighting(names, seen, np.full(len(seen), noise))
        if probe:
            R = T_sensor_reference[:3, :3] @ turn @ Rotation.from_rotvec(rng.normal(size=3) * 3e-5).as_matrix()
            sighting = Sighting(("probe",), seen[:1], np.full(1, noise), R, 3e-5)
        course = {} if grown is None else {"part_temperature_c": warmth[v]}
        rows.append(View(f"v{v}", None, flange(q), q, np.zeros(6), None, course, sighting))
    robot = robot_from_dh("arm", "standard", ROWS, None, np.array([0, 0, -9.81]), "mm")
    session = Session(Path("cell"), "cell", "mm", mount, Scanner(None, noise, None, np.array([0, 0, 1.0])), robot, None,
                      None, None, tuple(rows))  # fmt: skip
    return session, T_mount, places, turn


def off(T, true):
    """Angle (rad) and distance between two poses."""
    return np.linalg.norm(Rotation.from_matrix(T[:3, :3].T @ true[:3, :3]).as_rotvec()), np.linalg.norm(
        T[:3, 3] - true[:3, 3]
    )


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_closed_form_is_exact_without_errors(mount):
    session, T_mount, *_ = cell(mount=mount, scatter=(0, 0), noise=1e-12)
    angle, distance = off(closed_form(capture(session)), T_mount)
    assert angle < 1e-9 and distance < 1e-6


def test_closed_form_of_a_probe_is_exact_without_errors():
    session, T_mount, *_ = cell(scatter=(0, 0), noise=1e-12, probe=True)
    views = [replace(v, sighting=replace(v.sighting, rotation=np.linalg.inv(T_mount)[:3, :3] @ v.T_base_flange[:3, :3]))
             for v in session.views]  # fmt: skip
    angle, distance = off(closed_form(capture(replace(session, views=tuple(views)))), T_mount)
    assert angle < 1e-9 and distance < 1e-6


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_hand_eye_and_targets_with_their_sigmas(mount):
    z = []
    for seed in range(6):
        session, T_mount, places, _ = cell(seed, mount=mount)
        found = run(session)
        relative = np.linalg.inv(found.T_mount) @ T_mount
        xi = np.append(Rotation.from_matrix(relative[:3, :3]).as_rotvec(), relative[:3, 3])
        z.append(xi @ np.linalg.solve(found.mount_covariance, xi))
        assert np.abs(found.fused.points - places).max() < 0.1
        assert found.heldout_rms > found.residual_rms
    # Six χ² of six degrees of freedom; wider sigmas are allowed, too narrow ones are not.
    assert np.sum(z) < 67.99  # 99.9 % point of χ² with 36


def test_targets_that_a_model_does_not_know_have_sigmas_of_their_own():
    """The model's hand-eye is used as it is: its error, the scatter and the noise are what moves a new target."""
    spread, squares = np.diag([1e-5] * 3 + [0.02] * 3), []
    for seed in range(8):
        session, T_mount, places, _ = cell(seed, views=25)
        xi = spread @ np.random.default_rng([seed, 1]).normal(size=6)
        wrong = T_mount @ np.block([[Rotation.from_rotvec(xi[:3]).as_matrix(), xi[3:, None]], [np.eye(4)[3:]]])
        model = replace(model_of(run(session)), T_mount=wrong, covariance=spread**2, targets={})
        found = run(session, model)
        error = (found.fused.points - places).ravel()
        covariance = found.labelled.landmarks_covariance[: error.size, : error.size]
        squares.append(error @ np.linalg.solve(covariance, error))
    assert chi2.ppf(0.001, error.size * len(squares)) < np.sum(squares) < chi2.ppf(0.999, error.size * len(squares))


def test_fit_equals_scipy_least_squares_where_all_rows_weigh_alike():
    session, *_ = cell(3, views=25, scatter=(0.0, 0.0))
    found = run(session)
    p = np.array([v.sighting.points for v in session.views])
    left = np.array([np.linalg.inv(v.T_base_flange) for v in session.views])

    def residual(x):
        placed = p @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        placed = np.einsum("vij,vkj->vki", left[:, :3, :3], placed) + left[:, None, :3, 3]
        return (placed - x[6:].reshape(-1, 3)).ravel()

    start = np.concatenate(
        [Rotation.from_matrix(found.T_mount[:3, :3]).as_rotvec(), found.T_mount[:3, 3], TARGETS.ravel()]
    )
    x = least_squares(residual, start + 1e-3, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    np.testing.assert_allclose(found.fused.points.ravel(), x[6:], atol=2e-4)
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(residual(x) ** 2) * 3), rel=1e-3)


def test_rows_are_the_slopes_of_what_is_left():
    session, T_mount, *_ = cell(1, views=6, scatter=(0, 0), noise=1e-9)
    measurement = measurement_of(session, capture(session))
    for name in ("joint_offset", "link_geometry", "joint_compliance", "range_scale", "fixture_drift"):
        effect = EFFECTS[name]
        if measurement.lacks(effect):
            continue
        zero = Term(effect, np.zeros(len(measurement.parameters(effect))))
        landmarks = initial_landmarks(measurement.capture, T_mount)
        rows = rows_of(measurement.capture, T_mount, landmarks)
        slopes = effect_rows(rows, measurement, (), zero)
        for i, parameter in enumerate(measurement.parameters(effect)):
            step = 0.01 * parameter.typical
            both = [rows_of(corrected(measurement, [replace(zero, values=s * step * np.eye(len(zero.values))[i])], T_mount),
                            T_mount, landmarks).residual for s in (1, -1)]  # fmt: skip
            numeric = (both[0] - both[1]) / (2 * step)
            scale = max(np.abs(numeric).max(), 1e-12)
            np.testing.assert_allclose(
                slopes[..., i] / scale, numeric / scale, atol=2e-4, err_msg=f"{name} {parameter.name}"
            )


def test_a_turn_of_the_flange_is_exactly_a_turn_of_the_targets():
    # The last joint's offset must not borrow from what is left, however large that is.
    session, T_mount, *_ = cell(1, views=12, scatter=(1e-3, 1.0))
    measurement = measurement_of(session, capture(session))
    term = Term(EFFECTS["joint_offset"], np.zeros(6))
    rows = rows_of(measurement.capture, T_mount, initial_landmarks(measurement.capture, T_mount))
    column = effect_rows(rows, measurement, (), term)[..., 5].ravel()
    landmarks = rows.landmarks.reshape(rows.residual.size, -1)
    left = column - landmarks @ np.linalg.lstsq(landmarks, column, rcond=None)[0]
    assert np.abs(left).max() < 1e-6 * np.abs(column).max()


def test_a_hidden_joint_offset_is_named_and_found():
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = cell(2, views=40, offset=offset)
    before = run(session)
    found = before.diagnose()
    assert "joint_offset" in found.effects, found.sentence
    after = before.add("joint_offset")
    assert after.heldout_rms < 0.2 * before.heldout_rms
    values = dict(
        zip([p.name for p in after.measurement.parameters(after.terms[0].effect)], after.terms[0].values, strict=True)
    )
    for name, true in zip(("d2", "d3", "d5"), offset[[1, 2, 4]], strict=True):
        assert values[name] == pytest.approx(true, abs=2e-4)


@pytest.fixture
def few_effects(monkeypatch):
    """A small library: what is tested is the choice, not how long all of it takes."""
    for name in set(EFFECTS) - {"joint_offset", "joint_compliance", "gear_eccentricity", "gear_harmonic", "backlash"}:
        monkeypatch.delitem(EFFECTS, name)
    monkeypatch.setattr(candidates, "empirical_effects", lambda views: [])


def test_offsets_and_gravity_together_are_found_by_their_names(few_effects):
    # Gravity on the flange's mass turns joint 2 by what the flange reaches out: 2 µrad a millimetre.
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = cell(9, views=100, offset=offset, sag=2e-6, targets=TARGETS[:2])
    found, lines, _ = suggest(state_of(run(session)), 3)
    assert set(found.effects) == {"joint_offset", "joint_compliance"}, lines
    assert found.heldout_rms < 0.1


def stands(session, name):
    """Whether an effect would be named, and what it leaves at left-out ends of joints' ranges."""
    evidence = evidence_of_state(state_of(run(session)))
    own = rank([score(evidence, candidate_of(evidence, EFFECTS[name]))])[0][0]
    return certain(own), extrapolation(evidence, own.score)


def test_a_gear_error_of_a_joint_that_was_driven_everywhere_helps_at_left_out_ends_too():
    def gears(q):
        return 8e-4 * np.array([0, np.sin(2 * q[1] + 0.4), 0, 0, 0, 0])

    named, found = stands(cell(11, views=100, targets=TARGETS[:2], gears=gears)[0], "gear_harmonic")
    assert named and found.helps and found.share < 0.3


def test_gear_errors_fitted_to_noise_are_not_named():
    for seed in range(4):
        named, found = stands(cell(20 + seed, views=100, targets=TARGETS[:2])[0], "gear_harmonic")
        assert not (named and found.helps)


def test_gear_errors_that_imitate_another_error_are_told_by_left_out_ends():
    # Bumps in two joints' angles: among the measured poses two periods a turn explain a good part of them.
    refused = 0
    for seed in range(4):
        bumps = np.random.default_rng(seed).uniform(-1.2, 1.2, 6)

        def gears(q, bumps=bumps):
            return 1.5e-3 * np.array([0, *np.exp(-((q[1:3] - bumps[1:3]) ** 2) / 0.02), 0, 0, 0])

        named, found = stands(cell(20 + seed, views=200, targets=TARGETS[:2], gears=gears)[0], "gear_harmonic")
        assert named
        refused += not found.helps
    # Of bumps near the middle two periods a turn may be a fair picture.
    assert refused >= 3


def test_an_effect_that_another_made_idle_is_dropped():
    session, *_ = cell(12, views=100, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), targets=TARGETS[:2])
    state = state_of(run(session, effects=["gear_eccentricity", "joint_offset"]))
    name, reason = eliminated_effect(state, {"gear_eccentricity", "joint_offset"})
    assert name == "gear_eccentricity", reason
    assert eliminated_effect(state_of(run(session, effects=["joint_offset"])), {"joint_offset"}) is None


def test_an_honest_cell_is_adequate():
    session, *_ = cell(5, views=40)
    found = run(session).diagnose()
    assert found.verdict == "adequate", found.sentence


def test_a_swapped_label_and_a_broken_joint_reading_are_taken_out_and_listed():
    session, T_mount, *_ = cell(4, views=40)
    views = list(session.views)
    s = views[7].sighting
    views[7] = replace(views[7], sighting=replace(s, points=s.points[[1, 0, 2, 3]]))
    views[20] = replace(views[20], joints=views[20].joints + 0.01, T_base_flange=flange(views[20].joints + 0.01))
    found = run(replace(session, views=tuple(views)))
    assert {o.view for o in found.outliers} == {7, 20}
    assert not any(o.view == 7 and o.target in ("t2", "t3") for o in found.outliers)
    angle, distance = off(found.T_mount, T_mount)
    assert angle < 1e-4 and distance < 0.3
    assert any("v7" in note and "v20" in note for note in found.notes)


def test_a_probe_is_placed_and_turned():
    session, T_mount, places, turn = cell(6, views=60, probe=True)
    found = run(session)
    assert np.abs(found.fused.points[0] - places[0]).max() < 0.1
    assert Rotation.from_matrix(found.labelled.landmarks.orientation.T @ turn).magnitude() < 1e-4


def written(folder, session, kind="points"):
    """The session as a folder of files."""
    folder.mkdir()
    rows = ",\n".join("{ " + ", ".join(f"{k} = {v}" for k, v in row.items()) + " }" for row in ROWS)
    (folder / "session.toml").write_text(
        f'format = "stitch-session/1"\nname = "{folder.name}"\nlength_unit = "mm"\nmount = "{session.mount}"\n'
        f'[scanner]\nnoise = 0.01\n[robot]\ndh = "standard"\njoints = [\n{rows}\n]\n'
    )
    header = "view," + ",".join(f"j{i + 1}_deg" for i in range(6))
    lines = [f"{v.name}," + ",".join(f"{x:.10f}" for x in np.degrees(v.joints)) for v in session.views]
    (folder / "views.csv").write_text("\n".join([header, *lines]) + "\n")
    if kind == "points":
        lines = [f"{v.name},{t},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f}" for v in session.views
                 for t, p in zip(v.sighting.targets, v.sighting.points, strict=True)]  # fmt: skip
        (folder / "points.csv").write_text("\n".join(["view,target,x,y,z", *lines]) + "\n")
    else:
        lines = []
        for v in session.views:
            numbers = [*v.sighting.points[0], *Rotation.from_matrix(v.sighting.rotation).as_quat()]
            lines.append(f"{v.name}," + ",".join(f"{x:.10f}" for x in numbers))
        (folder / "frames.csv").write_text("\n".join(["view,x,y,z,qx,qy,qz,qw", *lines]) + "\n")
    return folder


@pytest.mark.parametrize("kind", ["points", "frames"])
def test_every_command_works(kind, tmp_path, capsys, monkeypatch, few_effects):
    monkeypatch.chdir(tmp_path)
    session, *_ = cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), probe=kind == "frames")
    folder, out = str(written(tmp_path / "s", session, kind)), str(tmp_path / "r")

    def stitch(*arguments):
        with pytest.raises(SystemExit) as stop:
            main(list(arguments))
        assert not stop.value.code, capsys.readouterr().err
        return capsys.readouterr().out

    assert json.loads(stitch("check", folder, "--json"))["sessions"][0]["targets"] == (4 if kind == "points" else 1)
    first = json.loads(stitch("run", folder, "-o", out, "--json"))
    assert first["targets"] and first["rms_of"].startswith("3D")
    stitch("compare", out)
    assert json.loads(stitch("diagnose", out, "--json"))["effects"]
    stitch("next", out)
    second = json.loads(stitch("add", out, "joint_offset", "--json"))
    assert second["heldout_rms"] < first["heldout_rms"]
    # The model of one run judges other poses of the rig without fitting anything.
    other, *_ = cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), probe=kind == "frames")
    evaluate = json.loads(
        stitch("run", str(written(tmp_path / "o", other, kind)), "--hand-eye", out, "-o", str(tmp_path / "q"), "--json")
    )
    assert (
        evaluate["hand_eye"] == second["hand_eye"]
        and evaluate["targets"][0]["position"] == second["targets"][0]["position"]
    )
    assert evaluate["targets"][0]["sigma"] == second["targets"][0]["sigma"]
    assert evaluate["residual_rms"] == pytest.approx(second["residual_rms"], rel=0.05)
    stitch("drop", out, "joint_offset")
    stitch("add", out, "--suggested", "--no-recording")
    assert "joint_offset" in json.loads((tmp_path / "r" / "result.json").read_text())["effects"]
    stitch("report", out, "--no-diagnosis")
    assert "Targets" in (tmp_path / "r" / "report.html").read_text()


def test_calibrate_robot_writes_rows_and_urdf_of_the_same_arm(tmp_path, capsys, few_effects):
    session, *_ = cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]))
    folder = written(tmp_path / "s", session)
    with pytest.raises(SystemExit) as stop:
        main(["calibrate", "robot", str(folder), "-o", str(tmp_path / "out"), "--json"])
    assert not stop.value.code
    document = json.loads(capsys.readouterr().out)
    assert document["kind"] == "robot" and len(document["robot"]) == 6 and document["next"]
    assert ElementTree.parse(tmp_path / "out" / "robot.urdf").getroot().tag == "robot"
    robot = robot_from_dh("arm", "standard", document["robot"], None, np.array([0, 0, -9.81]), "mm")
    urdf = robot_from_urdf(tmp_path / "out" / "robot.urdf", "base_link", "flange", "mm", np.array([0, 0, -9.81]), None)
    joints = np.random.default_rng(0).uniform(-3, 3, (50, 6))
    np.testing.assert_allclose(forward(urdf, joints), forward(robot, joints), atol=1e-6)  # mm: 1e-9 m


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_rows_and_urdf_place_the_flange_as_the_chain_does(convention, tmp_path):
    session, *_ = cell(7, views=30)
    rng = np.random.default_rng(3)
    nominal = robot_from_dh("arm", convention, ROWS, None, np.array([0, 0, -9.81]), "mm")
    views = tuple(replace(v, T_base_flange=forward(nominal, v.joints)) for v in session.views)
    session = replace(session, robot=nominal, views=views)
    found = run(session)
    terms = [Term(EFFECTS[name], rng.normal(size=len(found.measurement.parameters(EFFECTS[name]))) * size)
             for name, size in (("joint_offset", 1e-3), ("link_geometry", 1e-3))]  # fmt: skip
    arm = calibrated(replace(found, terms=tuple(terms))).robot
    (tmp_path / "a.urdf").write_text(to_urdf(arm))
    urdf = robot_from_urdf(tmp_path / "a.urdf", "base_link", "flange", "mm", np.array([0, 0, -9.81]), None)
    rows = robot_from_dh("arm", convention, dh_rows(arm), None, np.array([0, 0, -9.81]), "mm")
    own = corrected(found.measurement, terms, found.T_mount)
    T_base_flange = np.linalg.inv(own.T_reference_mount)
    for robot in (urdf, rows):
        np.testing.assert_allclose(
            forward(robot, found.measurement.views.joints), T_base_flange, atol=1e-6
        )  # mm: 1e-9 m


BROKEN = [
    ("view,target,x,y\nv0,a,1,2\n", "no column 'z'"),
    ("view,target,x,y,z\nv0,a,1,2,3\nv0,a,1,2,3\n", "line 3"),
    ("view,target,x,y,z\nnobody,a,1,2,3\n", "line 2"),
    ("view,target,x,y,z\nv0,a,1,two,3\n", "y is 'two'"),
    ("view,target,x,y,z,sigma\nv0,a,1,2,3,-1\n", "sigma is -1"),
    ("view,target,x,y,z\nv0,,1,2,3\n", "target is empty"),
    ("view,target,x,y,z\n", "no rows"),
]


@pytest.mark.parametrize(("text", "told"), BROKEN)
def test_broken_points_are_refused_in_one_line(text, told, tmp_path):
    session, *_ = cell(0, views=3)
    folder = written(tmp_path / "s", session)
    (folder / "points.csv").write_text(text)
    with pytest.raises(InputError, match=told) as error:
        load_session(folder)
    assert "\n" not in str(error.value)


def test_nominal_targets_pull_by_their_sigma(tmp_path):
    session, _, places, _ = cell(8, views=6, noise=0.05)
    folder = written(tmp_path / "s", session)
    T = pose(np.random.default_rng(1), 100)
    drawn = (places - T[:3, 3]) @ T[:3, :3]
    lines = [f"t{i},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},0.0001" for i, p in enumerate(drawn)]
    alone = run(load_session(folder)).fused.points
    (folder / "targets.csv").write_text("\n".join(["target,x,y,z,sigma", *lines]) + "\n")
    found = run(load_session(folder)).fused.points

    def shape(points):
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    assert np.abs(shape(found) - shape(places)).max() < 1e-3
    assert np.abs(shape(alone) - shape(places)).max() > 1e-2


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_growth_is_found_wherever_the_part_is_held(mount):
    """No session says which point of a part stands still; the flange and the robot's base need not be near it."""
    still = TARGETS[0] + [80.0, -40.0, -90.0] + (0 if mount == "eye_to_hand" else np.array([450.0, 100.0, 200.0]))
    session, *_ = cell(4, mount=mount, grown=(2e-4, still))
    found = run(session)
    assert diagnose(state_of(found)).effects == ("part_growth",)
    found = run(session, effects=["part_growth"])
    values, sigmas = found.terms[0].values, found.sigmas[0]
    true = 2e-4 * np.append(1.0, found.measurement.target_views[0].origin - still)
    assert (sigmas < [1e-5, 2e-3, 2e-3, 2e-3]).all()  # mm: a quarter of the motion of the middle
    assert (np.abs(values - true) < 4 * sigmas).all()


def test_hand_eye_is_pushed_by_what_is_too_small_to_be_seen():
    """Offsets of the smallest detectable size, put into the same measurements joint by joint."""
    session, *_ = cell(5)
    found = run(session)
    suspect = next(s for s in diagnose(state_of(found)).candidates if s.name == "joint_offset")
    sizes = [min(suspect.detectable.get(f"d{i + 1}", np.inf), 1e-3) for i in range(6)]
    middle = np.mean([v.sighting.points.mean(axis=0) for v in session.views], axis=0)
    pushed = []
    for size, own in zip(sizes, np.eye(6), strict=True):
        T = np.linalg.inv(found.T_mount) @ run(cell(5, offset=size * own)[0]).T_mount
        pushed.append(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle))
    seen = [np.isfinite(suspect.detectable.get(f"d{i + 1}", np.inf)) for i in range(6)]
    assert suspect.hand_eye == pytest.approx(np.max(np.array(pushed)[seen]), rel=0.2)


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_a_view_that_shows_nothing_only_says_where_the_arm_was(mount):
    session, T_mount, *_ = cell(6, mount=mount, grown=(0.0, 0.0))
    blank = replace(session, views=tuple(replace(v, sighting=None) if k in (0, 7) else v
                                         for k, v in enumerate(session.views)))  # fmt: skip
    angle, distance = off(run(blank).T_mount, T_mount)
    assert angle < 1e-3 and distance < 1.0


def test_views_not_taken_yet_come_after_those_that_were():
    """Temperatures count from the session's first view, an event before them has happened, a scan at rest has no delay."""
    session, *_ = cell(2, views=9, grown=(0.0, 0.0))
    speeds = {f"j{i + 1}_velocity_deg_s": 5.0 for i in range(6)}
    session = replace(session, views=tuple(replace(v, covariates=v.covariates | speeds) for v in session.views))
    measurement = measurement_of(session, capture(session))
    later = candidate_measurement(measurement, measurement.views.joints[:3] + 0.1).views
    warmth = [v.covariates["part_temperature_c"] for v in session.views]
    np.testing.assert_allclose(later.since_first("part_temperature_c"), warmth[-1] - warmth[0])
    assert EFFECTS["part_slip"].function(later, xi=np.ones(6), v=8.0).all()
    assert not (EFFECTS["latency"].function(later.joints, later, dt=1.0) - later.joints).any()


def test_real_tracker_on_even_poses_judges_the_odd_ones(shared_data):
    session = load_session(shared_data / "irb120-tracker")
    even, odd = (replace(session, views=session.views[k::2]) for k in (0, 1))
    fitted = run(even)
    assert 0.90 < run(odd, model_of(fitted)).residual_rms < 0.97


def test_slopes_of_shifts_are_linear_in_small_steps():
    session, T_mount, *_ = cell(1, views=4)
    measurement = measurement_of(session, capture(session))
    term = Term(EFFECTS["range_scale"], np.zeros(1))
    poses = measurement.capture.poses(T_mount)
    moved = shift_targets(measurement, [replace(term, values=np.array([1e-4]))], poses)
    np.testing.assert_allclose(moved, 1e-4 * target_shifts(measurement, (), term, poses)[0], rtol=1e-3)
