"""Panel cell: closed forms, finite differences and the simulated cell; truth is built here or by the simulator."""

import json
import math
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.panel import LAYOUT, LEGS, adjust_panel, calibrated, correct_shape, measured_job, pose_error
from data_synth.cells import hexapod, panel_job
from data_synth.cells.panel import PanelCell, Sizes
from data_synth.fixtures.edits import replace_text
from data_synth.shell import Laminate, Shell
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.cells.panel import read_panel_job, solve_panel_job
from stitch.plugins.cells.panel_model import (
    ClampLayout,
    ControlPoints,
    RobotModel,
    adjust_pose,
    calibrate_robot,
    clamp_contacts,
    errors_along_motion,
    find_leg_offset,
    follow,
    leg_jacobian,
    preposition,
    rigid_fit,
    shape_step,
    true_flanges,
)
from tests.command_line import ended

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "panel"


def pose(a, b, c, *t):
    return frames.make(Rotation.from_euler("ZYX", [a, b, c], degrees=True).as_matrix(), np.array(t, float))


def test_layout_keeps_its_chords_heights_and_edges():
    """Distances between the pads are the stated ones; every pad lies on the cylinder; the frames look to its axis."""
    c = clamp_contacts(LAYOUT)
    axis_distance = np.hypot(c.pads[..., 1], c.pads[..., 2] + LAYOUT.radius)
    assert np.allclose(axis_distance, LAYOUT.radius, atol=1e-9)
    for first, second, third in c.pads:
        assert math.dist(first, second) == pytest.approx(LAYOUT.clamp_width)
        assert math.dist((first + second) / 2, third) == pytest.approx(LAYOUT.clamp_height)
    across = sorted(c.pads[:3, :2].reshape(-1, 3).tolist(), key=lambda p: p[1])
    assert math.dist(across[1], across[2]) == pytest.approx(LAYOUT.spacing)
    assert np.abs(c.pads[..., 0]).max() == pytest.approx(LAYOUT.length / 2 - LAYOUT.edge)
    to_axis = -np.column_stack([c.T_panel_contact[:, 1, 3], c.T_panel_contact[:, 2, 3] + LAYOUT.radius])
    to_axis /= np.linalg.norm(to_axis, axis=1, keepdims=True)
    # The clamps' planes lean by θ along the axis and not at all across it.
    assert np.einsum("ni,ni->n", c.T_panel_contact[:, 1:3, 2], to_axis) == pytest.approx(np.full(6, np.cos(c.tilt)))


def test_layout_that_cannot_be_is_refused():
    with pytest.raises(InputError, match="edge and clamp_height"):
        clamp_contacts(ClampLayout(2960, 360, 290, 360, 1300, 3100, 3))


def test_preposition_closes_the_chain():
    base, contact = np.array([pose(10, 2, 3, 4, 5, 6)]), np.array([pose(-20, 5, 1, 0, 1, 150)])
    panel, at = pose(0, 0, 180, 10, 20, 1500), np.array([pose(3, 4, 5, 600, 300, -30)])
    assert np.allclose(base @ preposition(base, panel, at, contact) @ contact, panel @ at)


def test_slaves_keep_the_clamps_together_and_the_panel_reaches_its_target():
    rng = np.random.default_rng(0)
    base, flange, contact = (frames.exp(rng.normal(size=(4, 6)) * np.repeat([0.4, 500], 3)) for _ in range(3))
    panel, target = pose(1, 2, 3, 10, 20, 30), pose(2, 2, 1, 15, 12, 33)
    moved = adjust_pose(base, flange, 1, panel, target)
    for i in range(4):
        held = np.linalg.inv(panel) @ base[i] @ flange[i] @ contact[i]
        assert np.allclose(target @ held, base[i] @ moved[i] @ contact[i], atol=1e-9)
    assert np.allclose(follow(base, flange, 2, flange[2]), flange)


def test_rigid_fit_covariance_is_the_spread_of_draws():
    """400 draws: a standard deviation is known to 3.5 %; five times that is allowed."""
    rng = np.random.default_rng(3)
    nominal = rng.normal(size=(8, 3)) * [900, 600, 60]
    truth, sigma = pose(20, -5, 8, 100, 200, 300), rng.uniform(0.02, 0.06, 8)
    clean = nominal @ truth[:3, :3].T + truth[:3, 3]
    fits = [rigid_fit(nominal, clean + sigma[:, None] * rng.standard_normal((8, 3)), sigma) for _ in range(400)]
    centre = frames.make(np.eye(3), nominal.mean(axis=0))
    off = np.array([frames.log(np.linalg.inv(truth @ centre) @ f.T @ centre) for f in fits])
    assert off.std(axis=0) == pytest.approx(np.sqrt(np.diag(fits[0].covariance)), rel=0.18)
    with pytest.raises(NoResultError, match="one line"):
        rigid_fit(np.outer(np.arange(4.0), [1, 2, 3]), np.outer(np.arange(4.0), [1, 2, 3]), np.ones(4))


def test_global_model_is_within_its_sigmas():
    """Twelve unknowns of six robots: chi-square of 72, beyond 117 by a chance of 1e-3... and of the residuals too."""
    cell = PanelCell(5, Sizes(leg=0.0))
    p = []
    for i, reading in enumerate(measured_job(cell).calibration):
        model = calibrate_robot(reading)
        off = frames.log(np.linalg.inv(cell.T_world_base[i]) @ model.T_world_base)
        assert off @ np.linalg.solve(model.covariance[:6, :6], off) < 27.9  # chi-square of 6, chance 1e-4
        p.append(model.p_value)
    assert min(p) > 1e-4


def test_leg_jacobian_against_differences():
    T = pose(3, -4, 5, 20, -30, 780)
    columns = [
        (hexapod.lengths(T @ frames.exp(d)) - hexapod.lengths(T @ frames.exp(-d))) / 2e-5 for d in 1e-5 * np.eye(6)
    ]
    assert np.allclose(leg_jacobian(LEGS, T[None])[0], np.array(columns).T, atol=1e-5)


def test_true_flange_against_forward_kinematics():
    """Second order in 0.5 mm over legs of 800 mm: 0.5²/800·(some) stays below 1e-3 mm."""
    T = pose(3, -4, 5, 20, -30, 780)
    longer = hexapod.lengths(T) + 0.5 * np.eye(6)[3]
    real = hexapod.forward(longer, T)
    found = true_flanges(LEGS, T[None], [(4, 0.5)])[0]
    assert np.abs(real[:3, 3] - found[:3, 3]).max() < 2e-3
    assert frames.angle_between(real, found) < 5e-6


def test_joints_off_their_drawing_move_the_flange():
    """Legs set for joints where the drawing has them, and the flange where the true joints then hold it."""
    cell, T = PanelCell(1, Sizes(joint=0.05, leg=0.0)), pose(1, -2, 1, 10, 5, 765)
    cell.drive(np.tile(T, (6, 1, 1)))
    for i, real in enumerate(cell.T_base_flange):
        held = hexapod.lengths(real, cell.base_joints[i], cell.platform_joints[i])
        assert np.abs(held - hexapod.lengths(T)).max() < 1e-9
        assert 5e-3 < np.linalg.norm(real[:3, 3] - T[:3, 3]) < 0.5
    assert (PanelCell(1, Sizes(joint=0.05)).T_world_base == PanelCell(1).T_world_base).all()


def test_hidden_leg_offset_is_found_in_its_robot_only():
    hidden = np.zeros((6, 6))
    hidden[2, 3] = 0.5
    cell = PanelCell(11, leg_offsets=hidden)
    readings = measured_job(cell).calibration
    found = [find_leg_offset(r, calibrate_robot(r), LEGS, 36) for r in readings]
    assert [f.found for f in found] == [False, False, True, False, False, False]
    assert found[2].leg == 4
    assert abs(found[2].offset - 0.5) < 4 * found[2].sigma < 0.2


def toy_models(turn):
    """Two robots; only the second one's base direction is uncertain, by `turn` rad about each axis."""
    none = np.zeros((12, 12))
    some = none.copy()
    some[:3, :3] = turn**2 * np.eye(3)
    base, contact = (np.eye(4), pose(30, 0, 0, 2000, 0, 0)), frames.make(np.eye(3), [0, 0, 150.0])
    nothing = {"reflectors": np.zeros((3, 3)), "jacobian": np.zeros((0, 15)), "residuals": np.zeros(0), "redundancy": 1}
    robots = zip("MS", base, (none, some), strict=True)
    return [RobotModel(n, b, contact, covariance=c, **nothing) for n, b, c in robots]


def test_drift_of_a_translation_is_turn_times_distance():
    """δR·d with δR a turn of σ about each axis: rms σ·d·√2, no change of direction."""
    flange = np.tile(frames.make(np.eye(3), [0, 0, 700.0]), (2, 1, 1))
    errors = errors_along_motion(toy_models(1e-4), flange, 0, np.array([0.0, 100.0]), turn=False)
    assert errors.position[:, 1, 1] == pytest.approx(np.full(3, 1e-4 * 100 * np.sqrt(2)))
    assert errors.position[:, 0].max() < 1e-9
    assert errors.angle.max() < 1e-12
    turned = errors_along_motion(toy_models(1e-4), flange, 0, np.radians([2.0]), turn=True)
    assert turned.angle[:, 0, 1] == pytest.approx(np.full(3, 1e-4 * np.radians(2.0) * np.sqrt(2)), rel=1e-3)
    # The clamp stands 2000 mm from the master: turning about z carries it 2000·sin 2° and errs with that.
    assert turned.position[2, 0, 1] > 1e-4 * 2000 * np.radians(2.0)


def shell(radius, cells=(12, 12)):
    return Shell(radius, 1000.0, 800.0, Laminate(stringer_area=0.0, stringer_inertia=0.0), cells)


def test_rigid_motions_of_the_shell_cost_nothing():
    """Energy of a turn of 1 mrad against that of a bend of the same size, which is not small."""
    s = shell(2960.0)
    x, arc = s._x, s._s
    points = np.column_stack([x, 2960 * np.sin(arc / 2960), 2960 * np.cos(arc / 2960)])
    field = np.cross([1e-3, -7e-4, 5e-4], points) + np.array([0.1, 0.2, 0.3])
    local = np.einsum("nij,ni->nj", s.axes(arc), field)
    bent = np.column_stack([0 * x, 0 * x, 1e-3 * arc**2 / 400])
    rigid, bend = (energy(s, f) for f in (local, bent))
    assert rigid < 1e-6 * bend


def energy(s, local):
    mass = (s._value.T.multiply(s._area)) @ s._value
    from scipy.sparse.linalg import spsolve

    q = np.concatenate([spsolve(mass.tocsc(), s._value.T @ (s._area * local[:, k])) for k in range(3)])
    return q @ s.stiffness @ q


def test_plate_strip_bends_as_a_beam():
    """A nearly flat shell on two lines, loaded by its weight: 5qL⁴/384EI·(beam), Poisson 0; supports at the very ends."""
    law = Laminate(poisson=0.0, stringer_area=0.0, stringer_inertia=0.0)
    s = Shell(1e7, 1000.0, 100.0, law, (16, 4))
    pads = np.array([[x, y] for x in (-500.0, 500.0) for y in (-50.0, -25.0, 0.0, 25.0, 50.0)])
    held = s.hold(pads, np.tile([1e-3, 1e-3, 1e6], (10, 1)))
    sag = s.at(np.array([[0.0, 0.0]])) @ held.sag(s.weight(np.array([0.0, 0.0, 9810.0])))
    load = law.density * law.thickness * 9810.0
    assert sag[2] == pytest.approx(5 * load * 1000.0**4 / (384 * law.modulus * law.thickness**3 / 12), rel=0.01)


def test_pose_after_one_adjustment_and_shape_within_three_iterations():
    """The source's own limits: 0.08 mm, 0.008°, 0.6 mm; measured against the true places of the targets."""
    cell, ready = calibrated(2)
    cell.lay()
    ready = adjust_panel(cell, ready)
    turned, moved = np.split(np.abs(pose_error(cell)), 2)
    assert moved.max() < 0.08 and turned.max() < 0.008

    cell.compliant = True
    control, clamp = panel_job.control_points()
    contact = clamp_contacts(LAYOUT).T_panel_contact
    deviations, _ = correct_shape(cell, ready)
    assert deviations[0].max() > 3 and len(deviations) <= 4
    world = np.linalg.inv(cell.target) @ np.vstack([cell.true_points(control).T, np.ones(18)])
    across = np.einsum("ki,ki->k", world[:3].T - control, contact[clamp][:, :3, 2])
    assert np.abs(across).max() < 0.6
    forced = np.linalg.norm(cell.forces()[:, 3:], axis=1).max()
    cell.compliant = False
    assert np.linalg.norm(cell.forces()[:, 3:], axis=1).max() > 3 * forced


def test_shape_step_undoes_a_turned_clamp():
    """Points turned 2 mrad about the contact's x and lifted 1 mm: the step is the opposite, and nothing else moves."""
    contact = clamp_contacts(LAYOUT).T_panel_contact
    control, clamp = panel_job.control_points()
    wrong = np.array([2e-3, 0, 0, 0, 0, 1.0])
    pushed = contact @ frames.exp(wrong) @ np.linalg.inv(contact)
    moved = np.array([(pushed[c] @ [*p, 1])[:3] for p, c in zip(control, clamp, strict=True)])
    still = np.tile(np.eye(4), (6, 1, 1))
    step = shape_step(moved, ControlPoints(control, clamp, contact), still, still)
    assert step.twists == pytest.approx(np.tile(-wrong, (6, 1)), abs=3e-3)
    assert (step.twists[:, 2:5] == 0).all()


@pytest.fixture(scope="module")
def example(tmp_path_factory, stitch_command):
    """What the command says of the example, and the folder it filled."""
    folder = tmp_path_factory.mktemp("panel")
    return json.loads(stitch_command("panel", EXAMPLE / "job.toml", "--json", "-o", folder)), folder


def test_command_on_the_example(example):
    found, folder = example
    named = [name for name, o in found["leg_offsets"].items() if o["found"]]
    assert named == ["C"]
    assert found["leg_offsets"]["C"]["leg"] == 4
    assert found["leg_offsets"]["C"]["offset"] == pytest.approx(0.5, abs=4 * found["leg_offsets"]["C"]["sigma"])
    assert {f.name for f in folder.iterdir()} >= {"preposition.csv", "pose_move.csv", "shape_move.csv", "errors.png"}


def test_tracker_readings_in_its_own_frame_give_the_same(example, job, stitch_command):
    """Everything the tracker sees, turned into a frame of its own, with four reference points of the world."""
    folder = job.parent
    T = np.linalg.inv(pose(25, 3, -2, -3200, -1800, 1900))
    seen = ["seen_x seen_y seen_z"]
    tables = {"targets": seen, "control": seen, "calibration": ["x1 y1 z1", "x2 y2 z2", "x3 y3 z3"]}
    for name, columns in tables.items():
        lines = (folder / f"{name}.csv").read_text().splitlines()
        header, rows = lines[0].split(","), [line.split(",") for line in lines[1:]]
        for triple in columns:
            at = [header.index(c) for c in triple.split()]
            for row in rows:
                moved = T[:3, :3] @ [float(row[i]) for i in at] + T[:3, 3]
                for i, value in zip(at, moved, strict=True):
                    row[i] = f"{value:.9f}"
        (folder / f"{name}.csv").write_text("\n".join([lines[0], *(",".join(r) for r in rows)]))
    world = np.array([[0, 0, 0], [4000.0, 0, 0], [0, 3000.0, 0], [0, 0, 2000.0]])
    rows = [f"W{i},{','.join(f'{v:.9f}' for v in [*p, *(T[:3, :3] @ p + T[:3, 3])])}" for i, p in enumerate(world)]
    (folder / "world.csv").write_text("\n".join(["point,x,y,z,seen_x,seen_y,seen_z", *rows]))
    replace_text(job, "[files]", '[files]\nworld = "world.csv"')
    found = json.loads(stitch_command("panel", job, "--json"))
    assert found["pose"]["position_error"] == pytest.approx(example[0]["pose"]["position_error"], abs=1e-5)


def test_shape_of_the_example_is_judged_apart_from_its_pose(example):
    """The panel lies 8 mm off its target; its shape at the clamps is the simulator's, a few millimetres."""
    found, _ = example
    worst = max(found["shape"]["largest_deviation"].values())
    cell = PanelCell(7)
    control, _ = panel_job.control_points()
    xs = np.column_stack([control[:, 0], 2960 * np.arctan2(control[:, 1], control[:, 2] + 2960)])
    free = cell.free_shape(xs)
    assert 1.0 < worst < np.ptp(free)
    assert np.abs(found["pose"]["position_error"]).max() > 2


@pytest.fixture
def job(tmp_path):
    """The job of examples, of one's own."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "job")) / "job.toml"


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('master = "B"', 'master = "X"', "master is 'X'"),
        ("[tracker]", "[tracker]\nnoise = 1", "unknown key 'tracker.noise'"),
        ("radius = 2960.0", "radius = -1", "layout.radius is -1; to fix: write a number above zero"),
        ('calibration = "calibration.csv"', "", "files.calibration is missing"),
        ('"flanges.csv"', '"none.csv"', "none.csv: not found"),
    ],
)
def test_bad_job_is_refused_in_one_line(job, old, new, message):
    replace_text(job, old, new)
    error = ended("panel", job, code=2).err
    assert message in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        # The largest force of forces.csv is 2.1 N at E, the largest torque 0.4 N m.
        (
            "force_N = 2.0",
            r"the force at clamp E has changed by 2\.1 N, its limit is 2 N\. No robot is told to move; to fix",
        ),
        ("torque_Nm = 0.01", r"the torque at clamp [A-F] has changed by 0\.\d N m, its limit is 0\.01 N m"),
        ("force_N = 3.0\ntorque_Nm = 3.0", None),
    ],
)
def test_forces_beyond_their_limit_stop_all_robots(job, limits, message):
    job.write_text(f"{job.read_text()}\n[limits]\n{limits}\n")
    read = read_panel_job(job)
    if message is None:
        assert (read.force_limit, read.torque_limit) == (3.0, 3.0)
        return
    with pytest.raises(NoResultError, match=message):
        solve_panel_job(read)


def test_limits_without_forces_are_refused(job):
    lines = [line for line in job.read_text().splitlines() if not line.startswith("forces")]
    job.write_text("\n".join([*lines, "[limits]", "force_N = 5.0"]))
    with pytest.raises(InputError, match=r"\[limits\] goes with files\.forces; to fix"):
        read_panel_job(job)


# Stands for the machines: the panel is then exactly where its drawing puts it.
OBEDIENT = """
import csv, sys, tomllib
import numpy as np
from scipy.spatial.transform import Rotation
target = tomllib.load(open("job.toml", "rb"))["target"]
R = Rotation.from_euler("ZYX", [target[k] for k in ("a_deg", "b_deg", "c_deg")], degrees=True)
rows = list(csv.DictReader(open("control.csv")))
for row in rows:
    seen = R.apply([float(row[k]) for k in "xyz"]) + [target[k] for k in "xyz"]
    row |= dict(zip(("seen_x", "seen_y", "seen_z"), seen + float(sys.argv[2])))
with open("control.csv", "w", newline="") as stream:
    writer = csv.DictWriter(stream, rows[0])
    writer.writeheader()
    writer.writerows(rows)
assert len(list(csv.DictReader(open(sys.argv[1])))) == 6
"""


@pytest.fixture
def driven(job, monkeypatch):
    monkeypatch.chdir(job.parent)
    (job.parent / "machine.py").write_text(OBEDIENT)
    return partial(ended, "panel", "job.toml", "-o", "moves", "--json", "--drive")


def test_shape_is_corrected_until_it_is_within_the_tolerance(driven):
    told = driven(f"{sys.executable} machine.py moves/shape_move.csv 0")
    before, after = json.loads(told.out)["corrections"]["largest_deviation"]
    assert before > 1.0 and after < 1e-6


def test_a_machine_that_fails_ends_it(driven):
    said = " ".join(driven(f"{sys.executable} -c 1/0", code=1).err.split())
    assert "exit code 1, ZeroDivisionError: division by zero. The robots stand where it left them; to fix: " in said


@pytest.mark.slow
def test_a_panel_that_does_not_follow_ends_it(driven):
    said = " ".join(driven(f"{sys.executable} machine.py moves/shape_move.csv 1", code=1).err.split())
    assert "the shape is still" in said and "mm off after 10 corrections, 0.6 mm are allowed" in said


@pytest.mark.slow
def test_a_simulated_panel_gets_its_shape_by_one_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended("synth", "panel-robots", "cell", "--seed", 3)
    machine = f"{sys.executable} -m data_synth.cells.panel_job cell moves/shape_move.csv"
    assert "Shape control: 1 correction, " in ended("panel", "cell/job.toml", "-o", "moves", "--drive", machine).err
