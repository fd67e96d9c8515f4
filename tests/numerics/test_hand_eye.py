"""Closed-form hand-eye solvers against truth and against OpenCV."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.hand_eye import AXXB_SOLVERS, axis_spread


def motions(seed: int, count: int = 8, noise: float = 0.0):
    """Random hand-eye, absolute flange and target poses, and the relative motions A, B."""
    rng = np.random.default_rng(seed)
    X = frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 100, 3))
    flange = frames.make(Rotation.random(count, rng=rng).as_matrix(), rng.normal(0, 400, (count, 3)))
    T_base_target = frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 500, 3))
    target = frames.inverse(flange @ X) @ T_base_target
    target = target @ frames.exp(rng.normal(0, 1, (count, 6)) * noise * np.array([1e-3] * 3 + [0.2] * 3))
    A = frames.inverse(flange[:-1]) @ flange[1:]
    B = target[:-1] @ frames.inverse(target[1:])
    return X, flange, target, A, B


@pytest.mark.parametrize("name", AXXB_SOLVERS)
def test_solvers_are_exact_without_noise(name):
    for seed in range(20):
        X, _, _, A, B = motions(seed)
        error = frames.log(frames.inverse(X) @ AXXB_SOLVERS[name](A, B))
        assert np.abs(error[:3]).max() < 1e-8
        assert np.abs(error[3:]).max() < 1e-5


@pytest.mark.parametrize("name", AXXB_SOLVERS)
def test_memory_grows_with_the_motions_and_not_with_their_square(name):
    *_, A, B = motions(0, count=2_001)
    tracemalloc.start()
    try:
        AXXB_SOLVERS[name](A, B)
        assert tracemalloc.get_traced_memory()[1] < 10e3 * len(A)
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "flag"),
    [("Park-Martin", "PARK"), ("Andreff", "ANDREFF")],
)
def test_error_under_noise_is_no_worse_than_that_of_opencv(name, flag):
    """Root mean square over 200 cells, all pairs of views on both sides."""
    cv2 = pytest.importorskip("cv2")
    ours, theirs = [], []
    for seed in range(200):
        X, flange, target, _, _ = motions(seed, noise=1.0)
        i, j = np.triu_indices(len(flange), 1)
        A, B = frames.inverse(flange[i]) @ flange[j], target[i] @ frames.inverse(target[j])
        R, t = cv2.calibrateHandEye(
            flange[:, :3, :3], flange[:, :3, 3], target[:, :3, :3], target[:, :3, 3],
            method=getattr(cv2, f"CALIB_HAND_EYE_{flag}"),
        )  # fmt: skip
        for T, errors in ((AXXB_SOLVERS[name](A, B), ours), (frames.make(R, t.ravel()), theirs)):
            errors.append(np.linalg.norm(frames.log(frames.inverse(X) @ T) * [300, 300, 300, 1, 1, 1]))
    assert np.mean(np.square(ours)) <= np.mean(np.square(theirs))


@pytest.mark.parametrize("name", AXXB_SOLVERS)
def test_parallel_axes_are_refused_with_the_reason(name):
    turns = [frames.exp(np.array([0, 0, a, 0, 0, 0.0])) for a in (0.3, 0.6, 1.0)]
    with pytest.raises(NoResultError, match="one axis"):
        AXXB_SOLVERS[name](np.array(turns), np.array(turns))


def test_pure_translation_is_refused():
    moves = frames.exp(np.array([[0, 0, 0, 10, 0, 0.0], [0, 0, 0, 0, 10, 0]]))
    assert np.all(axis_spread(moves) == 0)
    with pytest.raises(NoResultError, match="translate"):
        AXXB_SOLVERS["Park-Martin"](moves, moves)


def turned_by(angles, seed, shift=100.0, noise=0.0):
    """Motions by given angles about random axes, and a random hand-eye."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(len(angles), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    X = frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 100, 3))
    turns = Rotation.from_rotvec(np.asarray(angles)[:, None] * axes).as_matrix()
    A = frames.make(turns, rng.normal(0, shift, (len(angles), 3)) if shift else np.zeros((len(angles), 3)))
    B = frames.inverse(X) @ A @ X
    return X, A, B @ frames.exp(rng.normal(0, 1, (len(A), 6)) * noise * np.array([1e-3] * 3 + [0.2] * 3))


@pytest.mark.parametrize("shift", [0.0, 100.0])
@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-4, 0.02])
@pytest.mark.parametrize("name", AXXB_SOLVERS)
def test_solvers_are_exact_at_half_turns(name, off, shift):
    """The logarithm may go either way round at π; with and without translation of the flange."""
    for seed in range(10):
        X, A, B = turned_by([np.pi - off, np.pi - off / 3, np.pi - off / 7, np.pi - off / 5], seed, shift)
        error = frames.log(frames.inverse(X) @ AXXB_SOLVERS[name](A, B))
        assert np.abs(error[:3]).max() < 1e-6
        assert np.abs(error[3:]).max() < 1e-3


@pytest.mark.parametrize("name", AXXB_SOLVERS)
def test_half_turns_under_noise_cost_no_accuracy(name):
    """As good as with turns by 150°, where no logarithm is in doubt."""
    errors = {}
    for angle in (2.6, np.pi):
        errors[angle] = [
            np.linalg.norm(frames.log(frames.inverse(X) @ AXXB_SOLVERS[name](A, B))[:3])
            for X, A, B in (turned_by([angle] * 6, seed, noise=1.0) for seed in range(40))
        ]
    assert np.max(errors[np.pi]) < 0.02
    assert np.median(errors[np.pi]) < 1.5 * np.median(errors[2.6])


@pytest.mark.parametrize("name", AXXB_SOLVERS)
def test_a_hand_eye_that_is_a_half_turn_is_found_exactly(name):
    rng = np.random.default_rng(3)
    for axis in (*np.eye(3), *rng.normal(size=(5, 3))):
        _, A, _ = turned_by([0.5, 0.8, 1.2, 0.7], 1)
        turn = Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
        X = frames.make(turn, np.array([10.0, -20, 30]))
        error = frames.log(frames.inverse(X) @ AXXB_SOLVERS[name](A, frames.inverse(X) @ A @ X))
        assert np.abs(error[:3]).max() < 1e-7
        assert np.abs(error[3:]).max() < 1e-5


def test_two_half_turns_that_fit_two_hand_eyes_are_refused():
    """Half turns about two lines that meet: turning the scanner about their common normal changes nothing."""
    A = np.array(
        [frames.exp(np.array([np.pi, 0, 0, 0, 0, 0.0])), frames.exp(np.array([0, np.pi * 0.6, np.pi * 0.8, 0, 0, 0]))]
    )
    with pytest.raises(NoResultError, match="half turns"):
        AXXB_SOLVERS["Park-Martin"](A, A)
