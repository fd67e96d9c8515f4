"""What the register's weights promise: 1 where views agree, the same whichever view comes first, by published formulas."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade
from stitch.fusion.register import GICP, register
from stitch.numerics import frames
from stitch.numerics.distributions import tukey
from stitch.observations.surfaces.hand_eye_fit import Repeatability

SCATTER = Repeatability(2e-4, 0.1, 1.0)


@pytest.fixture(scope="module")
def cell():
    """A capture of five views and their model's poses, each off by 0.2 mrad and 0.1 mm a component."""
    measured, capture = captured_blade(3, views=5, pixels=80, repeatability=(0.0, 0.0))
    off = np.random.default_rng(0).normal(size=(5, 6)) * np.repeat([2e-4, 0.1], 3)
    return capture, frames.exp(off) @ measured.T_reference_scanner


def test_full_weight_at_agreement_and_none_beyond_the_limit():
    e = np.array([0.0, 4.685, -4.685, 9.0, 4.685 / 2, -4.685 / np.sqrt(2)])
    assert tukey(0.7 * e, 0.7) == pytest.approx([1, 0, 0, 0, 9 / 16, 1 / 4])


def test_the_order_of_the_views_changes_nothing(cell):
    capture, poses = cell
    forth = register(capture, poses, SCATTER, 5.0, method=GICP).poses
    turned = replace(
        capture,
        scans=capture.scans[::-1],
        T_reference_mount=capture.T_reference_mount[::-1],
        T_reference_flange=capture.T_reference_flange[::-1],
    )
    back = register(turned, poses[::-1], SCATTER, 5.0, method=GICP).poses[::-1]
    assert np.abs(forth - back).max() < 1e-6


def test_the_weights_are_gicps_inside_tukeys(cell):
    """Both formulas written out as in Segal et al. (2009) and Beaton & Tukey (1974), handed in, give the same poses."""
    capture, poses = cell

    def formula(matches, capture, poses):
        middle = np.median(np.abs(np.concatenate([m.residual for m in matches])))
        return [plane_to_plane(m, capture, poses) * biweight(m.residual / (1.4826 * middle)) for m in matches]

    own = register(capture, poses, SCATTER, 5.0, method=GICP)
    handed = register(capture, poses, SCATTER, 5.0, method=replace(GICP, weigh=formula))
    assert np.abs(own.poses - handed.poses).max() < 1e-9


def biweight(u):
    return np.where(np.abs(u) < 4.685, (1 - (u / 4.685) ** 2) ** 2, 0.0)


def plane_to_plane(m, capture, poses):
    """2ε over nᵀ(C_v + C_w)n, C = R diag(ε, 1, 1) Rᵀ with the point's normal as first axis."""
    total = 0.0
    for view, index in ((m.v, m.index_v), (m.w, m.index_w)):
        own = capture.scans[view].normals[index] @ poses[view][:3, :3].T
        C = np.eye(3) - (1 - 1e-3) * own[:, :, None] * own[:, None, :]
        total = total + np.einsum("ni,nij,nj->n", m.normal, C, m.normal)
    return 2e-3 / total


def test_other_weights_are_taken(cell):
    """One pair alone counts: views outside it stay where the robot put them."""
    capture, poses = cell

    def only_first(matches, capture, poses):
        return [m.weight * ((m.v, m.w) == (0, 1)) for m in matches]

    found = register(capture, poses, SCATTER, 5.0, method=replace(GICP, weigh=only_first))
    moved = frames.log(found.poses @ frames.inverse(poses))
    assert np.abs(moved[2:]).max() < 1e-12
    assert np.abs(moved[:2, 3:]).max() > 1e-2
