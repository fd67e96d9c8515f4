"""Weights of the correspondences in `register`, by method, and offsets of whole surfaces that cost nothing there.

A correspondence has a signed distance d along the normal, positive where the first view's point lies outside.

`dpwvm`: the weighted variance of the distances is made small, in two classes by their sign. A patent on stitching
blades by hand-eye correction calls its last step DPWVM and gives no formula. Two published methods are its relatives;
what follows them, and where it departs from them, is this:

- *Variance-minimisation matching.* mean(d²) = Var(d) + mean(d)²; only Var(d) is made small there, so that an offset
  common to all points of a view costs nothing. Here it costs nothing for a view that shows one (`shared_offsets`), and
  counts in full for all others: their offset is the step that stitching has to close. Set free for every view it would
  leave a third more error (docs/register.md).
- *Weighted plus-and-minus allowance variance minimisation.* Distances above and below the middle are a plus and a minus
  class, each with a scale. Here the middle is the weighted median, so that both classes hold the same weight and
  exchange their places with the views; the cleaner class gives both their scale.

`vmm` is that family as published: a class has its own mean, its distances weigh by how near they lie to it, and the sum
of both variances is made small (`class_variances`). Nothing but the robot's poses holds an offset of a view then.

`gicp` is plane to plane inside Tukey's biweight: of the methods compared in docs/register.md the best. Both factors of
its weights are 1 where two views agree, and neither depends on the order of the views.
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
    """Return the weights (M,) of each match: tukey(e/σ) · incidence · density, e a distance less the pair's median.

    The median is weighted by incidence and density. σ is the scale of the cleaner of the two classes e > 0 and e < 0
    (`class_scale`). The published weight exp(−(d − μ±)²/2σ±²), about the mean of each class, would give perfect
    agreement less than half: hence Tukey's biweight about one middle.

    All factors are the same whichever view comes first, and none changes if all distances of a pair grow alike.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    base = [incidence(m, capture, poses) * density(m, capture) for m in matches]
    centred = [m.residual - weighted_median(m.residual, w) for m, w in zip(matches, base, strict=True)]
    # A pair of few correspondences leans on the scale of all of them.
    common_scale = mad_sigma(np.concatenate(centred))
    return [w * tukey(e, class_scale(e, common_scale)) for w, e in zip(base, centred, strict=True)]


def vmm_weights(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Return the weights (M,) of each match: exp(−(d − μ±)²/2σ±²) · incidence · density, for two classes of distances.

    The classes are d ≥ 0 and d < 0, μ± the weighted mean of a class and σ± its robust sigma, as published. Perfect
    agreement counts less than half then, since the mean of a half-normal lies at 0.8 σ.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    weights = []
    for m in matches:
        w = incidence(m, capture, poses) * density(m, capture)
        for of_class in _sign_classes(m):
            off = m.residual[of_class] - w[of_class] @ m.residual[of_class] / w[of_class].sum()
            w[of_class] *= np.exp(-0.5 * (off / max(mad_sigma(off), _ROUNDING)) ** 2)
        weights.append(w)
    return weights


def class_variances(g: Gram, matches: Sequence[Match], weights: Sequence[Array]) -> Gram:
    """Return the sums over pairs with Var₊ + Var₋ of the distances in place of their squares.

    Var₊ and Var₋ are the weighted variances of the distances d ≥ 0 and d < 0: rows and distances count less their
    class's mean. Both classes have equal weight, together that of the pair.

    Args:
        g: the sums, of which pairs, centre and scale stay.
        weights: (M,) per match.
    """
    matrix, vector, square = np.zeros_like(g.matrix), np.zeros_like(g.vector), np.zeros_like(g.square)
    for i, (m, w) in enumerate(zip(matches, weights, strict=True)):
        rows = frames.plane_rows(m.middle - g.centre, m.normal)
        classes = _sign_classes(m)
        for of_class in classes:
            total = w[of_class].sum()
            B = rows[of_class] - w[of_class] @ rows[of_class] / total
            e = m.residual[of_class] - w[of_class] @ m.residual[of_class] / total
            weight = w[of_class] * w.sum() / (len(classes) * total)
            matrix[i] += (B * weight[:, None]).T @ B
            vector[i] += (B * weight[:, None]).T @ e
            square[i] += weight @ e**2
    return replace(g, matrix=matrix, vector=vector, square=square)


def _sign_classes(m: Match) -> list[Indices]:
    """Return the indices of the distances d ≥ 0, and of those d < 0; one list where all have one sign."""
    classes = (np.flatnonzero(m.residual >= 0), np.flatnonzero(m.residual < 0))
    return [indices for indices in classes if len(indices)]


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
        scale: robust sigma over all pairs; it counts like that of `_POOLED` further correspondences.
    """
    medians = [float(np.median(side)) for side in (e[e > 0], -e[e < 0]) if len(side) >= _CLASS]
    if not medians:
        return scale
    cleaner = MAD_TO_SIGMA * min(medians)
    return float(np.sqrt((len(e) * cleaner**2 + _POOLED * scale**2) / (len(e) + _POOLED)))


class OffsetSums:
    """Sums over the correspondences by which offsets of the views' surfaces enter the normal equations.

    The surface of view v stands off by a_v along its normals, so that a pair sees e + B(δ_v − δ_w) − (a_v − a_w), with
    twists δ of the views. Of a scan that had stock on a part of it, a acts there alone.
    """

    def __init__(self, g: Gram, matches: Sequence[Match], weights: Sequence[Array], capture: Capture) -> None:
        """Sum over the correspondences of all pairs.

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
            rows = frames.plane_rows(m.middle - g.centre, m.normal)
            # By view of the pair, the change of each distance by a unit of its offset, less its sign.
            changes = {m.v: acts(capture, m.v, m.index_v), m.w: -acts(capture, m.w, m.index_w)}
            for view, change in changes.items():
                pull = (w * change) @ rows
                self.vector[view] += (w * change) @ m.residual
                self.coupling[m.v, :, view] += pull
                self.coupling[m.w, :, view] -= pull
                for other, of_other in changes.items():
                    self.matrix[other, view] += w @ (of_other * change)
            self.square[i] = float(w @ m.residual**2) - float(w @ m.residual) ** 2 / max(float(w.sum()), 1e-300)


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
    coupling = sums.coupling.reshape(len(H), -1) / variance
    matrix, vector = sums.matrix / variance, sums.vector / variance
    # Of the offsets alone, the twists eliminated.
    information = matrix - coupling.T @ np.linalg.solve(H, coupling)
    gradient = vector - coupling.T @ np.linalg.solve(H, b)
    free = shared_offsets(information, gradient, _LARGE * scale, sums.known)
    if not free:
        return H, b, {}
    H, b, sizes = eliminate(H, b, coupling[:, free], matrix[np.ix_(free, free)], vector[free])
    return H, b, {v: float(size) for v, size in zip(free, sizes, strict=True) if v not in sums.known}


def eliminate(H: Array, b: Array, coupling: Array, matrix: Array, vector: Array) -> tuple[Array, Array, Array]:
    """Return the normal equations with F offsets at their best for every twist, and their sizes at no twist."""
    solved = np.linalg.solve(matrix, np.column_stack([coupling.T, vector]))
    return H - coupling @ solved[:, :-1], b - coupling @ solved[:, -1], np.asarray(solved[:, -1], float)


def shared_offsets(information: Array, vector: Array, least: float, known: Sequence[int] = ()) -> list[int]:
    """Return the views whose whole surface is offset, the most significant first; never all of them.

    In turn the view with the largest χ² = c²/A of its offset is freed, and the others are tested with it free. It ends
    where no χ² is above `_SURE` with an offset |c/A| above `least`. An offset common to all views shows nowhere.

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
        is_offset = (chi2 > _SURE) & (np.abs(c) > least * size)
        due = [v for v in known if v not in free and A[v, v] > blind]
        is_offset[due] = True
        chi2[due] = np.inf
        if not is_offset.any():
            break
        best = int(np.argmax(np.where(is_offset, chi2, 0.0)))
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
