"""The weights of correspondences, against closed forms: planes with a common offset, two classes, order of views."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stitch.fusion.correspondence_weights import (
    OffsetSums,
    class_scale,
    class_variances,
    dpwvm_weights,
    eliminate,
    shared_offsets,
    weighted_median,
    with_offsets,
)
from stitch.numerics.distributions import tukey
from stitch.observations.surfaces.matching import Match, sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps, gram

COUNT, VARIANCE = 400, 1e-4
WITHOUT_STOCK = SimpleNamespace(scans=[SimpleNamespace(stock=None)] * 2)


def faces(normals, offset, t):
    """View 0 less view 1 on planes of these normals: view 0 stands off by `offset`, and moved by `t`."""
    rng = np.random.default_rng(1)
    normal = np.repeat(np.asarray(normals, float), COUNT, axis=0)
    middle = rng.normal(size=normal.shape) * 30
    # Symmetric noise that is the same on every face, so that closed forms are exact.
    noise = np.tile(np.repeat(rng.normal(scale=0.01, size=COUNT // 2), 2) * np.tile([1, -1], COUNT // 2), len(normals))
    residual = offset + normal @ np.asarray(t) + noise
    index = np.arange(len(residual))
    return Match(0, 1, middle, normal, residual, weight=np.ones(len(residual)), index_v=index, index_w=index)


def sums_of(match):
    """Normal equations (6, 6), (6,) of view 0, view 1 held, in units of a variance of 1e-4, and the sums of offsets.

    The prior leaves view 0 free to shift and hardly to turn.
    """
    weights = [np.ones(len(match.residual))]
    g = gram([match], 2, np.zeros(3), 0.01, weights)
    prior = np.diag([1e12] * 3 + [1e-1] * 3)
    return g.matrix[0] / VARIANCE + prior, g.vector[0] / VARIANCE, OffsetSums(g, [match], weights, WITHOUT_STOCK)


def both(H, b):
    """The same of two views, the second held."""
    held = 1e15 * np.eye(6)
    return np.block([[H, np.zeros((6, 6))], [np.zeros((6, 6)), held]]), np.append(b, np.zeros(6))


def of_two_planes(a, t):
    """Normal equations of view 0 on planes 90° apart without their common offset, its size, and their least square."""
    H, b, sums = sums_of(faces([[1, 0, 0], [0, 1, 0]], a, t))
    C, D, e = sums.coupling[0][:, :1] / VARIANCE, sums.matrix[:1, :1] / VARIANCE, sums.vector[:1] / VARIANCE
    return *eliminate(H, b, C, D, e), sums.square[0]


def test_two_planes_with_a_common_offset_have_the_closed_form_of_their_variance():
    """d₁ = a + n₁·t and d₂ = a + n₂·t of n planes have the variance ((n₁ − n₂)·t)²/4, least where that is nothing.

    Of planes 90° apart the fit takes back what of t lies along (1, −1)/√2; across it nothing moves, and the mean stays.
    """
    a, t = 0.3, np.array([0.07, -0.02, 0.0])
    H, b, size, _ = of_two_planes(a, t)
    along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    assert -np.linalg.solve(H, b)[3:] == pytest.approx(-(along @ t) * along, abs=1e-6)
    assert size == pytest.approx([a + (t[0] + t[1]) / 2], abs=1e-9)


def test_a_common_offset_costs_nothing():
    """Two planes: equations without the offset's share are the same for every offset, their least square too."""
    found = []
    for a in (0.0, 0.3, -5.0):
        H, b, _, square = of_two_planes(a, (0.07, -0.02, 0.0))
        found.append((H, b, square))
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


def test_weights_do_not_change_with_an_offset_nor_with_the_order_of_views(cell):
    capture, poses, _ = cell
    matches = collect_overlaps(capture, poses, 1.0, [sample_points(s, 1000) for s in capture.scans]).matches
    weights = np.concatenate(dpwvm_weights(matches, capture, poses))
    raised = [replace(m, residual=m.residual + 0.3 * (m.v == 0)) for m in matches]
    turned = [m.swapped() for m in matches]
    assert np.concatenate(dpwvm_weights(raised, capture, poses)) == pytest.approx(weights, abs=1e-9)
    assert np.concatenate(dpwvm_weights(turned, capture, poses)) == pytest.approx(weights, abs=1e-9)
    assert weights.max() > 0.5


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


def test_full_weight_at_agreement_and_none_beyond_the_limit():
    e = np.array([0.0, 4.685, -4.685, 9.0, 4.685 / 2, -4.685 / np.sqrt(2)])
    assert tukey(0.7 * e, 0.7) == pytest.approx([1, 0, 0, 0, 9 / 16, 1 / 4])


def test_classes_are_summed_as_the_variance_of_each():
    """Value and slope of N/2·(Var₊ + Var₋) of one pair, against NumPy's variance and central differences."""
    match = faces([[1, 0, 0], [0, 1, 0]], 0.002, (0.01, -0.02, 0.005))
    weight = np.random.default_rng(2).uniform(0.5, 1.0, len(match.residual))
    plus = match.residual >= 0

    def cost(shift):
        moved = match.residual + match.normal @ shift
        variances = [np.cov(moved[side], aweights=weight[side], ddof=0) for side in (plus, ~plus)]
        return weight.sum() / 2 * float(np.sum(variances))

    g = class_variances(gram([match], 2, np.zeros(3), 0.01, [weight]), [match], [weight])
    assert g.square[0] == pytest.approx(cost(np.zeros(3)))
    steps = 1e-5 * np.eye(3)
    slope = [(cost(step) - cost(-step)) / 2e-5 for step in steps]
    assert 2 * g.vector[0, 3:] == pytest.approx(slope, rel=1e-6)


def test_an_offset_on_a_part_of_a_scan_acts_there_alone():
    """A third of the points stands off: with it free the others say where the view is, as if there were only these."""
    match = faces([[1, 0, 0], [0, 1, 0], [0, 0, 1]], 0.0, (0.03, -0.01, 0.02))
    raised = np.arange(len(match.residual)) % 3 == 0
    scans = [SimpleNamespace(stock=SimpleNamespace(points=raised)), SimpleNamespace(stock=None)]
    known = replace(match, residual=match.residual + 0.3 * raised)
    weights = [np.ones(len(raised))]
    g = gram([known], 2, np.zeros(3), 0.01, weights)
    sums = OffsetSums(g, [known], weights, SimpleNamespace(scans=scans))
    assert sums.known == [0]
    H, b = both(g.matrix[0] / VARIANCE + np.diag([1e12] * 3 + [1e-1] * 3), g.vector[0] / VARIANCE)
    H, b, offsets = with_offsets(H, b, sums, VARIANCE, 0.01)
    assert np.linalg.solve(H, -b)[3:6] == pytest.approx([-0.03, 0.01, -0.02], abs=2e-3)
    assert offsets == {}
