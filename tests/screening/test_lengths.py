"""One factor on the robot's lengths: views in a world of chance, and clouds of another size than the poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.screening.pose_tests import length_problem
from tests.screening.direct_views import direct_views

# Of the poses, rad and in units of their spread.
TURN, SHIFT = 1e-3, 0.02
DRAWS, STATED = 100, 1e-4


def seen_views(seed, views, factor=1.0, scatter=1.0, displaced=0.0):
    """Views that overlaps show but for a motion of them all, and their poses; scans `factor` times as large.

    Args:
        displaced: how many times as far as poses scatter view 1 stands off.
    """
    rng = np.random.default_rng([views, seed])
    T = frames.make(Rotation.random(views, rng=rng).as_matrix(), rng.normal(size=(views, 3)))
    twists = rng.standard_normal((views, 6)) * np.repeat([TURN, SHIFT], 3) * scatter
    twists[1] += rng.standard_normal(6) * np.repeat([TURN, SHIFT], 3) * displaced
    twists[:, 3:] += (factor - 1) * T[:, :3, 3]
    seen, mounts = null_space(np.tile(np.eye(6), views)).T, frames.adjoint(T)
    model = direct_views(np.zeros(6 * views), seen)
    reduced = replace(
        model.reduced,
        z=seen @ twists.ravel(),
        hand_eye=seen @ mounts.reshape(-1, 6),
        noise=1e-8 * np.eye(len(seen)),
    )
    return replace(model, reduced=reduced, mount_jacobians=mounts), T


@pytest.mark.parametrize("views", [3, 4])
def test_few_poses_show_no_factor_by_chance(views):
    """What 999 of 1,000 repetitions stay below."""
    alarms = sum(length_problem(*seen_views(seed, views)) is not None for seed in range(DRAWS))
    assert alarms <= stats.binom.isf(1e-3, DRAWS, STATED)


def test_a_factor_is_named_with_its_size():
    said = length_problem(*seen_views(0, 4, 1.1, scatter=1e-3)).fix
    assert float(said.split("clouds are ")[1].split()[0]) == pytest.approx(1.1, abs=4e-3 * SHIFT)


def test_a_factor_stands_in_the_place_of_a_view_that_took_it_upon_itself():
    """Of four views the other three fit any factor."""
    for seed in range(5):
        model, T = seen_views(seed, 4, 10.0)
        assert "clouds are 10 times as large" in length_problem(model, T, model.columns([1])).fix


def test_a_view_that_is_off_is_no_factor():
    for seed in range(5):
        model, T = seen_views(seed, 4, displaced=200)
        assert length_problem(model, T, model.columns([1])) is None
