"""Base and tool from a tracker and its probe: closed form, refinement, document."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.hand_eye import shah
from stitch.plugins.metrology.calibrate.tracker import calibrate_tracker, refine_axzb, tracker_document
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended

HEADER = "view,x,y,z,qx,qy,qz,qw"


def table(poses, header=HEADER, extra=""):
    rows = [header]
    for k, (T, q) in enumerate(zip(poses, frames.to_quaternion(poses), strict=True)):
        rows.append(f"v{k}," + ",".join(f"{x:.12g}" for x in (*T[:3, 3], *q)) + extra)
    return "\n".join(rows) + "\n"


def session(folder, mount, seed=0, count=40, noise=1.0, turn=None):
    """A frames session with known sensor pose, and the true hand-eye."""
    rng = np.random.default_rng(seed)
    sensor, other = (frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, s, 3)) for s in (900, 80))
    R = Rotation.random(count, rng=rng) if turn is None else Rotation.from_rotvec(rng.uniform(-1, 1, (count, 1)) * turn)
    T = frames.make(R.as_matrix(), rng.normal(0, 400, (count, 3)) + np.array([900, 0, 600]))
    if mount == "eye_to_hand":
        hand_eye, measured = sensor, frames.inverse(sensor) @ T @ other
    else:
        hand_eye, measured = other, frames.inverse(T @ other) @ sensor
    measured = measured @ frames.exp(rng.normal(0, 1, (count, 6)) * noise * np.array([1e-4] * 3 + [0.05] * 3))
    folder.mkdir()
    (folder / "session.toml").write_text(
        f'format = "stitch-session/1"\nname = "f"\nlength_unit = "mm"\nmount = "{mount}"\n[scanner]\nnoise = 0.05\n'
    )
    (folder / "views.csv").write_text(table(T))
    (folder / "frames.csv").write_text(table(measured))
    return hand_eye


def test_real_tracker(shared_data):
    """1,495 poses of a UR10: base and tool alone leave 1.03 mm in the position of views left out."""
    loaded = load_session(shared_data / "ur10-tmac")
    document = tracker_document(calibrate_tracker(loaded), loaded)
    assert document["heldout_position_error"]["mean"] == pytest.approx(1.03, abs=0.005)
    assert document["views"] == 1495
    assert any("times the sensor's noise" in note for note in document["notes"])
    # The probe sits on the flange's axis, by two ways of solving.
    assert max(c["translation"] for c in document["closed_forms"].values()) < 1.0


@pytest.mark.parametrize("mount", ["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
def test_error_is_that_of_the_covariance(mount, tmp_path):
    squares = []
    for seed in range(20):
        truth = session(tmp_path / f"s{seed}", mount, seed)
        loaded = load_session(tmp_path / f"s{seed}")
        document = tracker_document(calibrate_tracker(loaded), loaded)
        xi = frames.log(frames.inverse(np.array(document["hand_eye"])) @ truth)
        squares.append(xi @ np.linalg.solve(np.array(document["hand_eye_covariance"]), xi))
    assert 3.5 < np.mean(squares) < 8.5


@pytest.mark.parametrize("as_json", [True, False])
def test_command(as_json, tmp_path):
    truth = session(tmp_path / "s", "eye_to_hand")
    out = ended("calibrate", "tracker", tmp_path / "s", *(["--json"] if as_json else []))
    if as_json:
        assert np.abs(np.array(json.loads(out.out)["hand_eye"]) - truth).max() < 0.5
    else:
        assert out.err == "" and "T_base_scanner" in out.out


def test_poses_turned_about_one_axis_are_refused(tmp_path):
    session(tmp_path / "s", "eye_to_hand", turn=np.array([0, 0, 1.0]))
    with pytest.raises(NoResultError, match="one axis"):
        calibrate_tracker(load_session(tmp_path / "s"))


def test_frames_of_other_views_are_refused(tmp_path):
    session(tmp_path / "s", "eye_to_hand")
    file = tmp_path / "s" / "frames.csv"
    head, *rows = file.read_text().splitlines()
    names = [row.split(",", 1)[0] for row in rows]
    file.write_text("\n".join([head, *(f"{n},{r.split(',', 1)[1]}" for n, r in zip(names, rows[::-1], strict=True))]))
    with pytest.raises(NoResultError, match="do not fit together"):
        calibrate_tracker(load_session(tmp_path / "s"))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.replace("qw", "w", 1), r"line 1: no column 'qw'"),
        (lambda t: t.replace("v3,", "v2,"), r"line 5: view v2 stands on line 4 already"),
        (lambda t: t.replace("v3,", "w3,"), r"line 5: view 'w3' is not in views.csv"),
        (lambda t: t.replace("v3,", "v3,nan,"), r"line 5: 9 cells, the header has 8"),
        (lambda t: HEADER + "\n", r"no poses"),
        (lambda t: t.splitlines()[0] + "\nv0,1,2,3,0,0,0,2\n", r"length 2.0000, not a rotation"),
        (lambda t: t.splitlines()[0] + "\nv0,1,2,x,0,0,0,1\n", r"z is 'x'; write a finite number"),
    ],
)
def test_bad_frames_name_line_and_mend(spoil, message, tmp_path):
    session(tmp_path / "s", "eye_to_hand", count=6)
    file = tmp_path / "s" / "frames.csv"
    file.write_text(spoil(file.read_text()))
    with pytest.raises(InputError, match=message):
        calibrate_tracker(load_session(tmp_path / "s"))


NOISE = np.array([1e-3] * 3 + [0.2] * 3)
SCALE = np.array([300, 300, 300, 1, 1, 1])


def cell(seed, count=12, noise=0.0):
    """X, Z, A, B of a random cell; B carries the noise."""
    rng = np.random.default_rng(seed)
    X, Z = (frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, s, 3)) for s in (100, 1000))
    A = frames.make(Rotation.random(count, rng=rng).as_matrix(), rng.normal(0, 400, (count, 3)))
    B = frames.inverse(Z) @ A @ X @ frames.exp(rng.normal(0, 1, (count, 6)) * noise * NOISE)
    return X, Z, A, B


def error(truth, found):
    return float(np.linalg.norm(frames.log(frames.inverse(truth) @ found) * SCALE))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_two_hundred_cells_no_worse_than_opencv():
    cv2 = pytest.importorskip("cv2")
    ours, theirs, closed = [], {"SHAH": [], "LI": []}, []
    for seed in range(200):
        X, Z, A, B = cell(seed, noise=1.0)
        x, z = refine_axzb(A, B).transforms
        ours.append([error(X, x), error(Z, z)])
        closed.append([error(T, t) for T, t in zip((X, Z), shah(A, B), strict=True)])
        inside = frames.inverse(A)
        for name, errors in theirs.items():
            # OpenCV: A_cv X_cv = Z_cv B_cv with A_cv = T_cam_world, X_cv = T_world_base, B_cv = T_gripper_base.
            R1, t1, R2, t2 = cv2.calibrateRobotWorldHandEye(
                frames.inverse(B)[:, :3, :3], frames.inverse(B)[:, :3, 3], inside[:, :3, :3], inside[:, :3, 3],
                method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}"),
            )  # fmt: skip
            world_base, camera_gripper = frames.make(R1, t1.ravel()), frames.make(R2, t2.ravel())
            errors.append([error(X, frames.inverse(camera_gripper)), error(Z, frames.inverse(world_base))])
    for k in range(2):
        best = min(rms(np.array(e)[:, k]) for e in theirs.values())
        assert rms(np.array(ours)[:, k]) <= best
        assert rms(np.array(closed)[:, k]) <= rms(np.array(theirs["SHAH"])[:, k])


@pytest.mark.parametrize("robust", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_covariance_predicts_the_error(robust):
    """Mean squared Mahalanobis distance over cells: 12 if the covariance is the error's."""
    squares = []
    for seed in range(60):
        X, Z, A, B = cell(seed, count=30, noise=1.0)
        fit = refine_axzb(A, B, robust=robust)
        xi = np.concatenate([frames.log(frames.inverse(t) @ f) for t, f in zip((X, Z), fit.transforms, strict=True)])
        squares.append(-xi @ np.linalg.solve(fit.covariance, -xi))
    assert 0.75 * 12 < np.mean(squares) < 1.3 * 12


def test_scatter_and_heldout_are_those_of_the_noise():
    _, _, A, B = cell(4, count=400, noise=1.0)
    fit = refine_axzb(A, B)
    assert fit.sigma == pytest.approx((1e-3, 0.2), rel=0.1)
    assert rms(fit.heldout[:, 3:]) > rms(fit.residual[:, 3:])
    assert rms(fit.heldout[:, 3:]) == pytest.approx(0.2, rel=0.1)


def test_heldout_is_the_error_of_a_fit_without_the_view():
    _, _, A, B = cell(7, count=10, noise=1.0)
    fit = refine_axzb(A, B, sigma=(1e-3, 0.2))
    X, Z = refine_axzb(A[1:], B[1:], sigma=(1e-3, 0.2)).transforms
    left_out = frames.log(frames.inverse(A[0] @ X) @ Z @ B[0])
    assert fit.heldout[0] / NOISE == pytest.approx(left_out / NOISE, abs=0.02)


def test_robust_fit_ignores_gross_errors():
    X, Z, A, B = cell(2, count=40, noise=1.0)
    B[:4] = B[:4] @ frames.exp(np.array([0.05, 0, 0, 20, 0, 0]))
    x, z = refine_axzb(A, B, robust=True).transforms
    assert error(X, x) < 0.5 and error(Z, z) < 1.0
    assert error(X, x) < 0.2 * error(X, refine_axzb(A, B).transforms[0])


def test_weights_of_zero_remove_views():
    _, _, A, B = cell(9, count=12, noise=1.0)
    weights = np.array([0.0] * 3 + [1.0] * 9)
    X, _ = refine_axzb(A, B, (1e-3, 0.2), weights).transforms
    assert error(refine_axzb(A[3:], B[3:], (1e-3, 0.2)).transforms[0], X) < 1e-3
    assert error(shah(A[3:], B[3:])[0], shah(A, B, weights)[0]) < 1e-6
