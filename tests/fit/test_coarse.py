"""A hand-eye from nothing: what the motions show is found, the same in every run, and the rest is never a number.

Cells with external axes, stated wrongly or not at all, against the truth of a second kinematics.
"""

import os
import subprocess
import sys
import textwrap
import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stitch
from data_synth.cells.axis_cell import axis_cell, write_cell
from data_synth.fixtures.blade_cells import captured_blade
from stitch.errors import InputError
from stitch.fit.coarse import centroid_hand_eyes, find_coarse_hand_eye
from stitch.fit.correct import correct
from stitch.model.model import hand_eye_lines
from stitch.numerics import frames
from stitch.observations.observability import hidden_translations, unknown_numbers, unobservable
from stitch.plugins.export.hand_eye_formats import HAND_EYE_FORMATS, hand_eye_of_run
from stitch.session.axis_poses import require_placed
from stitch.session.capture import Capture, build_capture
from stitch.session.scan import prepare_scan
from tests.fit.at_part import at_part
from tests.plugins.export.test_hand_eye_formats import ANYWHERE, COVARIANCE, bare_run

X = frames.make(Rotation.from_rotvec([0.08, -0.12, 0.75]).as_matrix(), np.array([62.0, -38.0, 95.0]))
VIEWS, NOISE = 8, 0.01
# Poses that are written with so many digits turn by this where they stand still, rad.
ROUNDED = 2e-5


def flange_poses(kind, rng):
    """T_base_flange (V, 4, 4) of a machine that looks at a part near the base's origin."""
    down = Rotation.from_rotvec([np.pi, 0, 0])
    turn = np.linspace(-0.6, 0.6, VIEWS)
    around_z = Rotation.from_rotvec(np.outer(turn, [0, 0, 1]))
    R, move = {
        "gantry": (Rotation.concatenate([down] * VIEWS), rng.uniform(-12, 12, (VIEWS, 3))),
        "turntable": (around_z * down, np.zeros((VIEWS, 3))),
        "scara": (around_z * down, rng.uniform(-12, 12, (VIEWS, 3))),
        # Three joints turn the flange about the base's z axis, and about one axis that turns with it.
        "still wrist": (
            around_z * Rotation.from_rotvec(np.outer(rng.permutation(turn) / 2, [0, 1, 0])) * down,
            rng.uniform(-12, 12, (VIEWS, 3)),
        ),
    }[kind]
    R = Rotation.from_rotvec(ROUNDED * rng.standard_normal((VIEWS, 3))) * R
    looks = R.apply((X @ [0, 0, 400, 1])[:3])
    return frames.make(R.as_matrix(), move - looks)


def plate_of(kind, seed=0):
    """The capture of a wavy plate, 120 mm long, seen from a machine's poses."""
    rng = np.random.default_rng(seed)
    T_base_flange = flange_poses(kind, rng)
    scans = []
    for v, T in enumerate(T_base_flange @ X):
        x, y = rng.uniform(-60, 60, (2, 1500))
        z = 6 * np.sin(x / 11) * np.cos(y / 15) + 0.002 * x**2 + NOISE * rng.standard_normal(1500)
        scans.append(prepare_scan(f"v{v}", frames.transform(frames.inverse(T), np.column_stack([x, y, z]))))
    return build_capture(kind, scans, T_base_flange, "eye_in_hand")


SEARCH = """
    import numpy as np
    from data_synth.fixtures.blade_cells import captured_blade
    from stitch.fit.coarse import feature_motions, find_coarse_hand_eye, sequence_motions
    _, capture = captured_blade(2, views=3, pixels=40)
    found = find_coarse_hand_eye([capture])
    T = np.stack([found.T_mount, *feature_motions(capture)[1], *sequence_motions(capture)[1]])
    print(found.source, " ".join(x.hex() for x in T.ravel().tolist()), sep="|")
"""


@cache
def searched(threads: int, cores: int, run: int) -> tuple[str, np.ndarray]:
    """What a process of its own finds: source, and hand-eye with all scan motions."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | {name: str(threads) for name in names}
    limit = f"import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{cores}])\n"
    done = subprocess.run(
        [sys.executable, "-c", limit + textwrap.dedent(SEARCH)],
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    source, numbers = done.stdout.strip().split("|")
    return source, np.array([float.fromhex(x) for x in numbers.split()])


def turning_only(capture: Capture, T_mount: np.ndarray) -> Capture:
    """The same scans on a flange that only turns about its z axis."""
    turns = frames.exp(np.array([[0, 0, np.radians(20 * i), 0, 0, 0] for i in range(len(capture.scans))]))
    flange = capture.T_reference_mount[0]
    return replace(capture, T_reference_mount=turns @ flange)


@pytest.mark.parametrize("mount", ["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
def test_a_hand_eye_is_found_from_nothing(mount):
    measured, capture = captured_blade(5, views=8, mount=mount, pixels=60)
    found = find_coarse_hand_eye([capture])
    assert found.runner_up_ratio > 1.1
    fine = correct([capture], found.T_mount, found.gate).hand_eye
    xi = frames.log(frames.inverse(measured.T_mount) @ fine.T_mount)
    _, J = at_part(capture, fine.T_mount)
    assert np.linalg.norm(J @ xi) < 0.1


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be set aside here")
def test_a_hand_eye_from_nothing_is_the_same_again_and_on_other_threads():
    once, again, other = searched(2, 8, 0), searched(2, 8, 1), searched(1, 1, 0)
    assert again[0] == once[0] and np.array_equal(again[1], once[1])
    # Positions are hundreds of mm: 1e-9 of them and of rotations.
    assert other[0] == once[0]
    np.testing.assert_allclose(other[1], once[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "unknown", "shifts"),
    [
        ("gantry", ("x", "y", "z"), 3),
        ("scara", ("z",), 1),
        ("turntable", ("x", "y", "z", "rx", "ry", "rz"), 1),
        ("still wrist", (), 0),
    ],
)
def test_what_a_machine_leaves_open_is_named_and_stays_near_the_part(kind, unknown, shifts):
    capture = plate_of(kind)
    assert hidden_translations([capture], X).shape == (3, shifts)
    found = unknown_numbers([capture], X)
    assert set(unknown) <= set(found) and bool(found) == bool(unknown)
    if kind in ("gantry", "scara"):
        assert found == unknown
    for T in centroid_hand_eyes([capture])[:3]:
        assert np.linalg.norm(T[:3, 3]) < 2e3


@pytest.mark.parametrize("kind", ["gantry", "scara"])
def test_what_is_known_is_found_and_the_rest_stays_where_it_was(kind):
    capture = plate_of(kind)
    start = X @ frames.exp(np.array([0.01, -0.008, 0.012, 0, 0, 0]))
    fit = correct([capture], start, 10.0).hand_eye
    off = frames.log(frames.inverse(X) @ fit.T_mount)
    assert np.linalg.norm(off[:3]) < 1e-3
    hidden = X[:3, :3] @ hidden_translations([capture], X)
    np.testing.assert_allclose(hidden.T @ (fit.T_mount[:3, 3] - start[:3, 3]), 0.0, atol=0.05)
    # Neither the search nor the fit knows it better than the weak prior of one working distance.
    along = hidden.T @ X[:3, :3]
    assert (np.diag(along @ fit.covariance[3:, 3:] @ along.T) > 100.0**2).all()


def test_open_numbers_are_not_printed():
    lines = hand_eye_lines(X, np.eye(6) * 1e-6, "eye_in_hand", "mm", unknown=("x", "rz"))
    assert "x not known, y -38" in lines[1] and lines[2].endswith("z not known mrad")
    assert "x 62 as stated" in hand_eye_lines(X, np.eye(6), "eye_in_hand", "mm", unknown=("x",), stated=True)[1]


def test_every_format_refuses_open_numbers_unless_they_are_stated(tmp_path):
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE, hand_eye_unknown=["x", "y"], hand_eye_stated=False)
    with pytest.raises(InputError, match="do not show x, y of the hand-eye; to fix: "):
        hand_eye_of_run(run)
    run = bare_run(tmp_path / "t", ANYWHERE, COVARIANCE, hand_eye_unknown=["x", "y"], hand_eye_stated=True)
    for write in HAND_EYE_FORMATS.values():
        assert "As stated in session.toml, not measured: x, y" in write(hand_eye_of_run(run))


def test_turning_the_last_joint_alone_hides_two_directions():
    measured, capture = captured_blade(6, views=10, tilt=0.0)
    # Views that turn about exactly one axis of the flange.
    phrases = unobservable([turning_only(capture, measured.T_mount)], measured.T_mount)
    assert len(phrases) == 2
    assert phrases[0] == "translation along the axis about which all views were turned"
    assert phrases[1] == "rotation about the axis about which all views were turned"


def test_all_directions_are_seen_by_a_tilting_set():
    measured, capture = captured_blade(7, views=8)
    assert unobservable([capture], measured.T_mount) == ()


def test_what_motions_cannot_show_takes_memory_with_their_number_and_not_with_its_square():
    measured, capture = captured_blade(7, views=8)
    again = 500
    many = replace(capture, T_reference_mount=np.tile(capture.T_reference_mount, (again, 1, 1)))
    tracemalloc.start()
    try:
        assert unobservable([many], measured.T_mount) == ()
        assert tracemalloc.get_traced_memory()[1] < 10e3 * again * 8
    finally:
        tracemalloc.stop()


def run_of(folder, kind, seed, *, known, hidden=None, **size):
    """The run of a cell whose axes are stated a millimetre and a milliradian off, or not at all."""
    cell = axis_cell(kind, seed, hidden, **size)
    tables = []
    for axis in cell.axes:
        direction, point = cell.stated(axis)
        across = np.linalg.svd(direction[None])[2][1]
        table = {"direction": (direction + 1e-3 * across).tolist()}
        tables.append(table | ({"point": (point + across).tolist()} if axis.kind == "rotary" else {}) if known else {})
    write_cell(folder / "s", cell, tables)
    return cell, stitch.run(stitch.load_session(folder / "s"))


def require_true(cell, run):
    for axis, place in zip(cell.axes, run.axes, strict=True):
        direction, point = cell.stated(axis)
        assert np.linalg.norm(place.direction - direction) < 3 * np.linalg.norm(place.direction_sigma)
        if place.point is not None:
            assert np.linalg.norm(np.cross(direction, place.point - point)) < 3 * np.linalg.norm(place.point_sigma)
    if cell.T_base_flange is not None:
        off = frames.log(frames.inverse(cell.T_mount) @ run.T_mount)
        chi2 = off @ np.linalg.solve(run.mount_covariance, off)
        assert chi2 < 22.5  # 0.1 % of six degrees of freedom


def test_a_turntable_alone_is_placed_and_read_again(tmp_path):
    cell, run = run_of(tmp_path, "turntable", 31, known=True, views=10, pixels=60)
    require_true(cell, run)
    assert run.session.reference_frame == "table" and "z" in run.unknown
    folder = run.save(tmp_path / "run", recording=False)
    again = stitch.load_run(folder)
    assert np.allclose(again.axes[0].point, run.axes[0].point, atol=1e-9)
    assert np.allclose(again.axes[0].point_sigma, run.axes[0].point_sigma, rtol=1e-6)
    assert np.allclose(again.fit.poses_model, run.fit.poses_model, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["table-arm", "rail-arm", "tilt-turn"])
@pytest.mark.parametrize("known", [True, False])
def test_axes_are_found_beside_the_hand_eye(tmp_path, kind, known):
    require_true(*run_of(tmp_path, kind, 32, known=known))


@pytest.mark.slow
def test_a_wobbling_table_is_named_and_added(tmp_path):
    _, run = run_of(tmp_path, "table-arm", 33, known=True, hidden={"axis_wobble": 1.0})
    assert stitch.diagnose(run).effects == ("axis_wobble",)
    assert stitch.add(run, "axis_wobble").heldout_rms < 0.95 * run.heldout_rms


def test_what_does_not_fit_axes_asks_for_their_place(tmp_path):
    cell = axis_cell("table-arm", 5, views=3, pixels=20)
    write_cell(tmp_path / "s", cell, [{}], cell.T_mount)
    with pytest.raises(stitch.InputError, match="nobody says where axis table stands; to fix: `stitch run` finds it"):
        require_placed(stitch.load_session(tmp_path / "s"))
