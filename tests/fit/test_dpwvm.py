"""The weighted variance of distances, against closed forms: planes with a common offset, two classes, order of views."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade
from stitch.fusion.correspondence_weights import (
    OffsetSums,
    class_scale,
    dpwvm_weights,
    eliminate,
    shared_offsets,
    weighted_median,
    with_offsets,
)
from stitch.fusion.register import DPWVM, GICP, register
from stitch.fusion.register import _Progress as Progress
from stitch.numerics import frames
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.observations.surfaces.matching import Match, sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps, gram

SCATTER = Repeatability(2e-4, 0.1, 1.0)
COUNT, VARIANCE = 400, 1e-4


def faces(normals, offset, t=(0.0, 0.0, 0.0)):
    """View 0 less view 1 on planes of these normals: view 0 stands off by `offset`, and moved by `t`."""
    rng = np.random.default_rng(1)
    normal = np.repeat(np.asarray(normals, float), COUNT, axis=0)
    middle = rng.normal(size=normal.shape) * 30
    # Symmetric noise that is the same on every face, so that closed forms are exact.
    noise = np.tile(np.repeat(rng.normal(scale=0.01, size=COUNT // 2), 2) * np.tile([1, -1], COUNT // 2), len(normals))
    residual = offset + normal @ np.asarray(t) + noise
    index = np.arange(len(residual))
    return Match(0, 1, middle, normal, residual, weight=np.ones(len(residual)), index_v=index, index_w=index)


def sums_of(match, moving=1e-1):
    """Normal equations (6, 6), (6,) of view 0, view 1 held, in units of a variance of 1e-4, and the sums of offsets.

    The prior leaves view 0 free to shift and hardly to turn.
    """
    weights = [np.ones(len(match.residual))]
    g = gram([match], 2, np.zeros(3), 0.01, weights)
    prior = np.diag([1e12] * 3 + [moving] * 3)
    return g.matrix[0] / VARIANCE + prior, g.vector[0] / VARIANCE, OffsetSums(g, [match], weights)


def both(H, b):
    """The same of two views, the second held."""
    held = 1e15 * np.eye(6)
    return np.block([[H, np.zeros((6, 6))], [np.zeros((6, 6)), held]]), np.append(b, np.zeros(6))


def test_two_planes_with_a_common_offset_have_the_closed_form_of_their_variance():
    """d₁ = a + n₁·t and d₂ = a + n₂·t of n planes have the variance ((n₁ − n₂)·t)²/4, least where that is nothing.

    Of planes 90° apart the fit takes back what of t lies along (1, −1)/√2; across it nothing moves, and the mean stays.
    """
    a, t = 0.3, np.array([0.07, -0.02, 0.0])
    H, b, sums = sums_of(faces([[1, 0, 0], [0, 1, 0]], a, t))
    C, D, e = sums.coupling[0][:, :1] / VARIANCE, sums.matrix[:1, :1] / VARIANCE, sums.vector[:1] / VARIANCE
    H, b, size = eliminate(H, b, C, D, e)
    along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    assert -np.linalg.solve(H, b)[3:] == pytest.approx(-(along @ t) * along, abs=1e-6)
    assert size == pytest.approx([a + (t[0] + t[1]) / 2], abs=1e-9)


def test_a_common_offset_costs_nothing():
    """Two planes: equations without the offset's share are the same for every offset, their least square too."""
    found = []
    for a in (0.0, 0.3, -5.0):
        H, b, sums = sums_of(faces([[1, 0, 0], [0, 1, 0]], a, (0.07, -0.02, 0.0)))
        C, D, e = sums.coupling[0][:, :1] / VARIANCE, sums.matrix[:1, :1] / VARIANCE, sums.vector[:1] / VARIANCE
        H, b, _ = eliminate(H, b, C, D, e)
        found.append((H, b, sums.square[0]))
    for H, b, square in found[1:]:
        assert pytest.approx(found[0][0]) == H
        assert pytest.approx(found[0][1], abs=1e-6) == b
        assert square == pytest.approx(found[0][2], rel=1e-9)


def test_an_offset_that_no_motion_imitates_is_freed_and_misleads_no_pose():
    """Five faces of a box 0.3 too large: the pose is that of the box without; under λ = 1 it shifts along the fifth."""
    box = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]
    t = np.array([0.02, -0.05, 0.04])
    for a in (0.0, 0.3):
        H, b, sums = sums_of(faces(box, a, t))
        sums.coupling[1] = 0.0  # the second view is held
        H, b, offsets = with_offsets(*both(H, b), sums, VARIANCE, 0.01)
        assert -np.linalg.solve(H, b)[3:6] == pytest.approx(-t, abs=1e-5)
        assert sum(abs(size) for size in offsets.values()) == pytest.approx(a if a == 0 else a + t[2] / 5, abs=1e-6)
    H, b, _ = sums_of(faces(box, 0.3, t))
    assert -np.linalg.solve(H, b)[5] == pytest.approx(-t[2] - 0.3, abs=1e-5)


@pytest.fixture(scope="module")
def cell():
    """A capture of five views and their model's poses, each off by 0.2 mrad and 0.1 mm a component."""
    measured, capture = captured_blade(3, views=5, pixels=80, repeatability=(0.0, 0.0))
    off = np.random.default_rng(0).normal(size=(5, 6)) * np.repeat([2e-4, 0.1], 3)
    return capture, frames.exp(off) @ measured.T_reference_scanner, measured.T_reference_scanner


def test_weights_do_not_change_with_an_offset_nor_with_the_order_of_views(cell):
    capture, poses, _ = cell
    matches = collect_overlaps(capture, poses, 1.0, [sample_points(s, 1000) for s in capture.scans]).matches
    weights = np.concatenate(dpwvm_weights(matches, capture, poses))
    raised = [replace(m, residual=m.residual + 0.3 * (m.v == 0)) for m in matches]
    turned = [m.swapped() for m in matches]
    assert np.concatenate(dpwvm_weights(raised, capture, poses)) == pytest.approx(weights, abs=1e-9)
    assert np.concatenate(dpwvm_weights(turned, capture, poses)) == pytest.approx(weights, abs=1e-9)
    assert weights.max() > 0.5


def test_poses_do_not_change_with_the_order_of_views(cell):
    capture, poses, _ = cell
    turned = replace(
        capture,
        scans=capture.scans[::-1],
        T_reference_mount=capture.T_reference_mount[::-1],
        T_reference_flange=capture.T_reference_flange[::-1],
    )
    forth = register(capture, poses, SCATTER, 5.0, method=DPWVM)
    back = register(turned, poses[::-1], SCATTER, 5.0, method=DPWVM)
    assert np.abs(forth.poses - back.poses[::-1]).max() < 1e-9


def test_both_classes_hold_the_same_weight():
    rng = np.random.default_rng(2)
    d, w = rng.gamma(1.0, size=5001), rng.uniform(0.1, 2.0, 5001)
    middle = weighted_median(d, w)
    assert w[d > middle].sum() == pytest.approx(w[d < middle].sum(), abs=w.max())
    assert weighted_median(-d, w) == pytest.approx(-middle, abs=1e-12)
    assert weighted_median(d, np.ones_like(d)) == pytest.approx(np.median(d), abs=1e-12)


def test_the_cleaner_class_gives_the_scale():
    """Half of the plus class flies: the minus class still has the scale of the noise, from either side."""
    rng = np.random.default_rng(3)
    e = rng.normal(scale=0.02, size=20_000)
    flying = np.where((e > 0) & (rng.random(e.size) < 0.5), e + 0.2, e)
    assert class_scale(flying, 0.02) == pytest.approx(0.02, rel=0.03)
    assert class_scale(-flying, 0.02) == pytest.approx(class_scale(flying, 0.02), rel=1e-12)


def test_an_offset_is_free_only_where_it_is_sure_and_large():
    A, c = np.diag([4.0, 1.0, 1.0]), np.array([-40.0, 20.0, 4.0])  # χ² 400, 400, 16; sizes 10, 20, 4
    assert shared_offsets(A, c, 1.0) == [0, 1]
    assert shared_offsets(A, c, 15.0) == [1]
    assert shared_offsets(A, c, 30.0) == []


def test_stock_of_one_view_is_found_and_moves_no_pose():
    """One view's points stand 0.3 mm out of the part along their normals: plane to plane moves it, variance does not."""
    measured, capture = captured_blade(3, views=12, pixels=100)
    poses = measured.T_reference_scanner
    scans = list(capture.scans)
    scans[2] = replace(scans[2], points=scans[2].points + 0.3 * scans[2].normals)
    raised = replace(capture, scans=tuple(scans))
    clean = register(capture, poses, SCATTER, 2.0, method=DPWVM)
    variance = register(raised, poses, SCATTER, 2.0, method=DPWVM)
    plane = register(raised, poses, SCATTER, 2.0, method=GICP)
    assert clean.offsets == {}
    assert variance.offsets == pytest.approx({2: 0.3}, abs=0.01)

    def apart(found):
        """Displacement of view 2 against the others from the clean fit, at the part."""
        to_centre = frames.make(np.eye(3), -clean.overlaps.gram.centre)
        xi = frames.log(to_centre @ found.poses @ frames.inverse(to_centre @ clean.poses))[:, 3:]
        return np.linalg.norm(xi[2] - np.delete(xi, 2, axis=0).mean(axis=0))

    assert apart(variance) < 0.3 * apart(plane)


def test_register_ends_where_neither_rms_nor_step_falls_and_says_so(cell):
    """Within a gate far below the points' spacing partners change for ever, and the views swing."""
    capture, poses, _ = cell
    assert capture.spacing > 2.0
    swinging = register(capture, poses, SCATTER, 0.7)
    assert len(swinging.history) < 25
    assert "fell any further" in swinging.note
    assert len(swinging.note.split()) <= 25
    assert register(capture, poses, SCATTER, 2.0).note == ""


def test_progress_counts_iterations_without_a_fall(cell):
    capture, poses, _ = cell
    g = collect_overlaps(capture, poses, 1.0, [sample_points(s, 300) for s in capture.scans]).gram
    progress, step = Progress(), np.ones((5, 6))
    assert progress.made(g, step, 1.0)
    assert not progress.made(g, step, 1.0)
    assert progress.stalled == 1
    assert progress.made(g, 0.9 * step, 1.0)
    assert progress.made(g, step, 0.5)  # a tighter gate begins anew
    assert progress.stalled == 0
