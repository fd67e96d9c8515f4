"""One factor on the robot's lengths: views in a world of chance, and clouds of another size than the poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.integrity.pose_tests import length_problem
from tests.integrity.direct_views import direct_views

# Of the poses, rad and in units of their spread.
TURN, SHIFT = 1e-3, 0.02
DRAWS, STATED = 100, 1e-4


def verdict(seed, views, factor=1.0, scatter=1.0):
    """What is said of views that overlaps show but for a motion of them all; scans `factor` times as large."""
    rng = np.random.default_rng([views, seed])
    T = frames.make(Rotation.random(views, rng=rng).as_matrix(), rng.normal(size=(views, 3)))
    twists = rng.standard_normal((views, 6)) * np.repeat([TURN, SHIFT], 3) * scatter
    twists[:, 3:] += (factor - 1) * T[:, :3, 3]
    seen, mounts = null_space(np.tile(np.eye(6), views)).T, frames.adjoint(T)
    model = direct_views(np.zeros(6 * views), seen)
    reduced = replace(
        model.reduced,
        z=seen @ twists.ravel(),
        hand_eye=seen @ mounts.reshape(-1, 6),
        noise=1e-8 * np.eye(len(seen)),
    )
    return length_problem(replace(model, reduced=reduced, mount_jacobians=mounts), T)


@pytest.mark.parametrize("views", [3, 4])
def test_few_poses_show_no_factor_by_chance(views):
    """What 999 of 1,000 repetitions stay below."""
    alarms = sum(verdict(seed, views) is not None for seed in range(DRAWS))
    assert alarms <= stats.binom.isf(1e-3, DRAWS, STATED)


def test_a_factor_is_named_with_its_size():
    said = verdict(0, 4, 1.1, scatter=1e-3).fix
    assert float(said.split("clouds are ")[1].split()[0]) == pytest.approx(1.1, abs=4e-3 * SHIFT)
