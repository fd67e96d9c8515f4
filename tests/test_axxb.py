"""Closed-form hand-eye solvers against truth and against OpenCV."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.calibrate.axxb import SOLVERS, axis_spread
from stitch.errors import NoResultError


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


@pytest.mark.parametrize("name", SOLVERS)
def test_exact_without_noise(name):
    for seed in range(20):
        X, _, _, A, B = motions(seed)
        error = frames.log(frames.inverse(X) @ SOLVERS[name](A, B))
        assert np.abs(error[:3]).max() < 1e-8
        assert np.abs(error[3:]).max() < 1e-5


@pytest.mark.parametrize(
    ("name", "flag"),
    [("Tsai-Lenz", "TSAI"), ("Park-Martin", "PARK"), ("Horaud-Dornaika", "HORAUD"), ("Andreff", "ANDREFF"),
     ("Daniilidis", "DANIILIDIS")],
)  # fmt: skip
def test_error_under_noise_is_that_of_opencv(name, flag):
    """Not the same numbers (OpenCV pairs all views), but no worse than 1.5 times, over 40 cells."""
    cv2 = pytest.importorskip("cv2")
    ours, theirs = [], []
    for seed in range(40):
        X, flange, target, _, _ = motions(seed, noise=1.0)
        i, j = np.triu_indices(len(flange), 1)
        A, B = frames.inverse(flange[i]) @ flange[j], target[i] @ frames.inverse(target[j])
        R, t = cv2.calibrateHandEye(
            flange[:, :3, :3], flange[:, :3, 3], target[:, :3, :3], target[:, :3, 3],
            method=getattr(cv2, f"CALIB_HAND_EYE_{flag}"),
        )  # fmt: skip
        for T, errors in ((SOLVERS[name](A, B), ours), (frames.make(R, t.ravel()), theirs)):
            errors.append(np.linalg.norm(frames.log(frames.inverse(X) @ T) * [300, 300, 300, 1, 1, 1]))
    assert np.median(ours) < 1.5 * np.median(theirs)


@pytest.mark.parametrize("name", SOLVERS)
def test_parallel_axes_are_refused_with_the_reason(name):
    turns = [frames.exp(np.array([0, 0, a, 0, 0, 0.0])) for a in (0.3, 0.6, 1.0)]
    with pytest.raises(NoResultError, match="one axis"):
        SOLVERS[name](np.array(turns), np.array(turns))


def test_pure_translation_is_refused():
    moves = frames.exp(np.array([[0, 0, 0, 10, 0, 0.0], [0, 0, 0, 0, 10, 0]]))
    assert np.all(axis_spread(moves) == 0)
    with pytest.raises(NoResultError, match="translate"):
        SOLVERS["Park-Martin"](moves, moves)
