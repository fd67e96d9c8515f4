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
    """Return the sums of Var₊ + Var₋ of every pair in place of its squares: rows and distances less their class's mean.

    Both classes count alike, and together as much as the pair's weight.
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
    """Return (M,) √ of the geometric mean of both surfaces per point over its median, between ½ and 2.

    Crowded points share their errors, so that a place counts less than in proportion to its points (choice: the root,
    halfway between a weight per point and a weight per surface).
    """
    area = np.sqrt(capture.scans[m.v].area[m.index_v] * capture.scans[m.w].area[m.index_w])
    return np.clip(np.sqrt(area / np.median(area)), 1 / _SPARSE, _SPARSE)


def weighted_median(d: Array, weight: Array) -> float:
    """Return where values (M,) part into two classes of the same weight, between neighbours by interpolation."""
    order = np.argsort(d)
    upto = np.cumsum(weight[order]) - weight[order] / 2
    return float(np.interp(weight.sum() / 2, upto, d[order]))


def class_scale(e: Array, scale: float) -> float:
    """Return the robust sigma of the cleaner class of distances (M,) about their middle, drawn to `scale` of all pairs.

    Flying points, flash and the far side of a thin edge all stand on one side; the other side shows the scatter.
    """
    # In one order the middles of both classes are at hand.
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
        """Sum the correspondences of all pairs of V views, each view with an offset along the normal beside its twist.

        Args:
            weights: (M,) of each match.
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
    """Return normal equations (6V, 6V) and (6V,) in which the offsets that views show cost nothing, and these offsets.

    Those of views of which it is known cost nothing either, and are not among them.

    An offset that is eliminated (Schur complement) leaves the weighted variance of that view's distances, λ = 0; the
    rest keep λ = 1. They are the same equations if no view shows one.

    Args:
        H, b: of the twists, with the prior of the robot, in units of variance.
        variance: of a correspondence's distance, by which `sums` are divided.
        scale: robust sigma of the distances.
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
    """Return the views whose surface stands off as a whole, the surest first; never all of them.

    One after the other the view with the largest χ² = c²/A of its offset, those before it set free, until χ² < 25 or
    the offset −c/A is smaller than `least`. One offset of all views is none: A is blind to it.

    Args:
        information: A (V, V) of the offsets, the twists eliminated.
        vector: c (V,) gradient at no offset.
        least: size below which an offset is left to the poses.
        known: views that are known to have stood off: they are free whatever is left of it.
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
    """Return the (M,) weight of two planes whose normals part by θ: 1/(cos² + sin²/ε) of θ/2.

    The inverse of nᵀ(C_v + C_w)n, with n the mean normal and C variances ε along a point's normal and 1 across it, over
    its value at θ = 0. What is not the same plane, as the two sides of a thin edge or points that fly behind a
    silhouette, counts little even where the distance happens to be small.
    """
    T_w_v = frames.inverse(poses[m.w]) @ poses[m.v]
    normals = frames.rotate(T_w_v, capture.scans[m.v].normals.take(m.index_v, axis=0))
    cosine = np.einsum("ij,ij->i", normals, capture.scans[m.w].normals.take(m.index_w, axis=0))
    sine2 = np.clip(1 - cosine, 0.0, 2.0) / 2
    return 1 / (1 - sine2 + sine2 / _EPSILON)
