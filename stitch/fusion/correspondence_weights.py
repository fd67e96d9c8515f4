"""Weighted variance of signed distances in two sign classes: the DPWVM-style fit of `register`.

The patent whose last step it is (source A: blade stitching by hand-eye correction) names DPWVM without a formula. What
is built here follows its published relatives and says of each part what is source and what is choice:

- *Objective*, source: variance-minimisation matching. With d the signed distances of two views, mean(d²) = Var(d) +
  mean(d)²; only Var(d) is made small, so that an offset common to all points of a view costs nothing. Choice: it costs
  nothing for a view that shows one (`shared_offsets`), and counts in full for all others. There an offset is the step
  that stitching has to close; set free for every view it would leave a third more error (docs/register.md).
- *Classes*, source: weighted plus-and-minus allowance variance minimisation. Distances above and below the middle are
  a plus and a minus class, each with a scale. Choice: the middle is the weighted median, so that both classes hold the
  same weight and exchange their places with the views; the cleaner class gives both their scale.
- *Weights*, `dpwvm_weights`: distance, sign class, density and incidence, found anew at every iteration.

Two methods stand beside it. `vmm_weights` is the family as it is published: a class has its own mean, its distances
weigh by how near they lie to it, and the sum of both variances is made small (`class_variances`). Nothing but the
robot's poses holds an offset of a view then. `plane_weights` is plane to plane (GICP) inside Tukey's biweight: of the
families compared in docs/register.md the best. Both of its factors are 1 where two views agree, and neither depends on
the order of the views.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA, mad_sigma, tukey
from stitch.numerics.frames import Array, Indices
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import Gram, robust_scale
from stitch.session.capture import Capture

# Variance along the normal over that across it (Segal, Haehnel & Thrun 2009).
_EPSILON = 1e-3
# A pair's own scale counts as if so many correspondences had shown the scale of all.
_POOLED = 200
# A class with fewer correspondences has no scale of its own.
_CLASS = 10
# Density: surface per point is believed up to these factors of its median in a pair.
_SPARSE = 2.0
# An offset is one of a view's whole surface where it stands out of chance by 5 sigma, and is 6 times the scatter of
# single distances. Stock of 0.3 mm on simulated blades showed 9 to 14 times the scatter; a scanner's own errors showed
# up to 4 on a shiny cone, and 0.6 in cells with a biased scanner.
_SURE, _LARGE = 25.0, 6.0
_ROUNDING = 1e-12


def dpwvm_weights(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Return weights (M,) per match: w = tukey((d − μ)/σ) · agreement · √(cos·cos') · density^ρ.

    - distance and sign class: μ is the weighted median of the pair's distances, σ that of the cleaner of the two
      classes d > μ and d < μ (`class_scale`). Source: exp(−(d−μ±)²/2σ±²); choice: Tukey's biweight and one middle,
      since about the mean of its own half perfect agreement counts less than half.
    - incidence: geometric mean of both cosines, and the agreement of both normals (Segal, Haehnel & Thrun 2009).
    - density: `density`, the surface that a correspondence stands for.

    All factors are the same whichever view comes first, and none changes if all d of a pair grow by one offset.
    """
    base = [incidence(m, capture, poses) * density(m, capture) for m in matches]
    middle = [weighted_median(m.residual, b) for m, b in zip(matches, base, strict=True)]
    centred = [m.residual - mu for m, mu in zip(matches, middle, strict=True)]
    scale = mad_sigma(np.concatenate(centred))
    return [b * tukey(e, class_scale(e, scale)) for b, e in zip(base, centred, strict=True)]


def vmm_weights(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Return weights (M,) per match of two classes, d ≥ 0 and d < 0: w = exp(−(d − μ±)²/2σ±²) · incidence · density.

    As published for allowances: μ± is the weighted mean of a class and σ± its robust sigma. Perfect agreement counts
    less than half then, since the mean of a half-normal lies at 0.8 σ.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    weights = []
    for m in matches:
        w = incidence(m, capture, poses) * density(m, capture)
        for side in _sides(m):
            off = m.residual[side] - w[side] @ m.residual[side] / w[side].sum()
            w[side] *= np.exp(-0.5 * (off / max(mad_sigma(off), _ROUNDING)) ** 2)
        weights.append(w)
    return weights


def class_variances(g: Gram, matches: Sequence[Match], weights: Sequence[Array]) -> Gram:
    """Return the sums over pairs with Var₊ + Var₋ of the distances in place of their squares.

    Var₊ and Var₋ are the weighted variances of the distances d ≥ 0 and d < 0: rows and distances count less their
    class's mean. Both classes have equal weight, together that of the pair.

    Args:
        weights: (M,) per match.
    """
    matrix, vector, square = np.zeros_like(g.matrix), np.zeros_like(g.vector), np.zeros_like(g.square)
    for i, (m, w) in enumerate(zip(matches, weights, strict=True)):
        rows = frames.plane_rows(m.middle - g.centre, m.normal)
        sides = _sides(m)
        for side in sides:
            of_class = w[side] * w.sum() / (len(sides) * w[side].sum())
            B = rows[side] - w[side] @ rows[side] / w[side].sum()
            e = m.residual[side] - w[side] @ m.residual[side] / w[side].sum()
            matrix[i] += (B * of_class[:, None]).T @ B
            vector[i] += (B * of_class[:, None]).T @ e
            square[i] += of_class @ e**2
    return replace(g, matrix=matrix, vector=vector, square=square)


def _sides(m: Match) -> list[Indices]:
    """Return the distances of the plus and of the minus class, where there are any."""
    sides = (np.flatnonzero(m.residual >= 0), np.flatnonzero(m.residual < 0))
    return [side for side in sides if len(side)]


def incidence(m: Match, capture: Capture, poses: Array) -> Array:
    """Return (M,) how squarely both views look at one and the same plane: √(cos·cos') times the normals' agreement."""
    return np.sqrt(m.weight) * agreement(m, capture, poses)


def density(m: Match, capture: Capture) -> Array:
    """Return the weight (M,) by density: the root of the surface per correspondence over its median, between ½ and 2.

    The surface is the geometric mean of those of both points. Crowded points share their errors; the root is a choice,
    halfway between an equal weight per point and one per surface.
    """
    area = np.sqrt(capture.scans[m.v].area[m.index_v] * capture.scans[m.w].area[m.index_w])
    return np.clip(np.sqrt(area / np.median(area)), 1 / _SPARSE, _SPARSE)


def weighted_median(d: Array, weight: Array) -> float:
    """Return where values (M,) part into two classes of the same weight, between neighbours by interpolation."""
    order = np.argsort(d)
    upto = np.cumsum(weight[order]) - weight[order] / 2
    return float(np.interp(weight.sum() / 2, upto, d[order]))


def class_scale(e: Array, scale: float) -> float:
    """Return the smaller of the robust sigmas of the positive and the negative distances, pooled with `scale`.

    Flying points, flash and the far side of a thin edge all stand on one side; the other side shows the scatter. A
    class of fewer than `_CLASS` is left out.

    Args:
        e: (M,) distances of a pair, less their median, length_unit.
        scale: robust sigma over all pairs; it counts like `_POOLED` further correspondences.
    """
    # Sorted, each class is one stretch, and its median the middle of it.
    e = np.sort(e)
    above, below = len(e) - np.searchsorted(e, 0.0, side="right"), np.searchsorted(e, 0.0)
    middles = [
        abs(e[[first + (count - 1) // 2, first + count // 2]].mean())
        for first, count in ((len(e) - above, above), (0, below))
        if count >= _CLASS
    ]
    if not middles:
        return scale
    cleaner = MAD_TO_SIGMA * float(min(middles))
    return float(np.sqrt((len(e) * cleaner**2 + _POOLED * scale**2) / (len(e) + _POOLED)))


class OffsetSums:
    """Sums over the correspondences by which offsets of the views' surfaces enter the normal equations.

    The surface of view v stands off by a_v along its normals, so that a pair sees e + B(δ_v − δ_w) − (a_v − a_w). Of a
    scan that had stock on a part of it, a acts there alone.
    """

    def __init__(self, g: Gram, matches: Sequence[Match], weights: Sequence[Array], capture: Capture) -> None:
        """Sum over the correspondences of all pairs what offsets a_v need in the normal equations beside twists δ_v.

        A distance is e + B(δ_v − δ_w) − (a_v − a_w); a and δ of V views are unknown.

        Args:
            g: sums over the pairs for the twists alone.
            weights: (M,) per match.
        """
        views = g.views
        self.coupling = np.zeros((views, 6, views))  # Σ ±w Bᵀ, twists against offsets, less their sign
        self.matrix = np.zeros((views, views))  # Σ ±w
        self.vector = np.zeros(views)  # Σ ±w e
        self.square = np.zeros(len(matches))  # (P,) Σ w (e − ē)²: a pair's weighted variance, times its weight
        self.known = [v for v, scan in enumerate(capture.scans) if scan.stock is not None]
        for i, (m, w) in enumerate(zip(matches, weights, strict=True)):
            weight, first = float(w.sum()), float(w @ m.residual)
            rows = frames.plane_rows(m.middle - g.centre, m.normal)
            sides = {m.v: acts(capture, m.v, m.index_v), m.w: -acts(capture, m.w, m.index_w)}
            for b, of_b in sides.items():
                pull = (w * of_b) @ rows
                self.vector[b] += (w * of_b) @ m.residual
                self.coupling[m.v, :, b] += pull
                self.coupling[m.w, :, b] -= pull
                for a, of_a in sides.items():
                    self.matrix[a, b] += w @ (of_a * of_b)
            self.square[i] = float(w @ m.residual**2) - first**2 / max(weight, 1e-300)


def acts(capture: Capture, view: int, index: Indices) -> Array:
    """Return (M,) 1 for points of a view on which its offset acts, 0 for others."""
    stock = capture.scans[view].stock
    return np.ones(len(index)) if stock is None else stock.points[index].astype(float)


def with_offsets(
    H: Array, b: Array, sums: OffsetSums, variance: float, scale: float
) -> tuple[Array, Array, dict[int, float]]:
    """Return normal equations H, b of the twists with significant offsets of views eliminated, and these by view.

    An eliminated offset (Schur complement) costs nothing: of that view's distances only the weighted variance counts.
    Offsets of views known to have stock are eliminated too, but not returned. Without any, H and b are unchanged.

    Args:
        H, b: (6V, 6V) and (6V,) of the twists with the prior of the robot, over the variance.
        sums: of the same correspondences.
        variance: of a correspondence's distance, length_unit², by which the sums are divided.
        scale: robust sigma of the distances, length_unit.
    """
    C, D, e = sums.coupling.reshape(len(H), -1) / variance, sums.matrix / variance, sums.vector / variance
    information = D - C.T @ np.linalg.solve(H, C)
    free = shared_offsets(information, e - C.T @ np.linalg.solve(H, b), _LARGE * scale, sums.known)
    if not free:
        return H, b, {}
    H, b, sizes = eliminate(H, b, C[:, free], D[np.ix_(free, free)], e[free])
    found = zip(free, map(float, sizes), strict=True)
    return H, b, {v: size for v, size in found if v not in sums.known}


def eliminate(H: Array, b: Array, coupling: Array, matrix: Array, vector: Array) -> tuple[Array, Array, Array]:
    """Return the normal equations with F offsets at their best for every twist, and their sizes at no twist."""
    solved = np.linalg.solve(matrix, np.column_stack([coupling.T, vector]))
    return H - coupling @ solved[:, :-1], b - coupling @ solved[:, -1], np.asarray(solved[:, -1], float)


def shared_offsets(information: Array, vector: Array, least: float, known: Sequence[int] = ()) -> list[int]:
    """Return the views whose whole surface is offset, the most significant first; never all of them.

    In turn the view with the largest χ² = c²/A of its offset is freed, and the others are tested with it free. It ends
    where no χ² is above `_SURE` with an offset |c/A| of at least `least`. An offset common to all views shows nowhere.

    Args:
        information: A (V, V) of the offsets, the twists eliminated.
        vector: c (V,) gradient at no offset.
        least: smallest offset that counts, length_unit.
        known: views known to have stock: they are freed whatever their χ².
    """
    free: list[int] = []
    A, c = information.copy(), vector.copy()
    blind = 1e-9 * max(float(np.diag(A).max()), 1e-300)
    while len(free) < len(A) - 1:
        size = np.maximum(np.diag(A), blind)
        chi2 = np.where(np.isin(np.arange(len(A)), free), 0.0, c**2 / size)
        shown = (chi2 > _SURE) & (np.abs(c) > least * size)
        due = [v for v in known if v not in free and A[v, v] > blind]
        shown[due] = True
        chi2[due] = np.inf
        if not shown.any():
            break
        best = int(np.argmax(np.where(shown, chi2, 0.0)))
        free.append(best)
        column = A[:, best] / size[best]
        A, c = A - np.outer(column, A[best]), c - column * c[best]
    return free


def plane_weights(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Return weights (M,) per match: agreement of the normals times the biweight of the distance.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    scale = robust_scale(matches)
    return [agreement(m, capture, poses) * tukey(m.residual, scale) for m in matches]


def agreement(m: Match, capture: Capture, poses: Array) -> Array:
    """Return the weight (M,) of correspondences whose normals differ by θ: 1/(cos²(θ/2) + sin²(θ/2)/ε), 1 at θ = 0.

    It is the inverse of nᵀ(C_v + C_w)n, with n the mean normal and C a point's covariance: ε along its normal, 1 across
    (Segal, Haehnel & Thrun 2009). Points of different planes, as the two sides of a thin edge, count little even where
    their distance is small.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    T_w_v = frames.inverse(poses[m.w]) @ poses[m.v]
    normals = frames.rotate(T_w_v, capture.scans[m.v].normals.take(m.index_v, axis=0))
    cosine = np.einsum("ij,ij->i", normals, capture.scans[m.w].normals.take(m.index_w, axis=0))
    sine2 = np.clip(1 - cosine, 0.0, 2.0) / 2
    return 1 / (1 - sine2 + sine2 / _EPSILON)
