"""Normal equations over view pairs.

Every pair (v, w) sees e = e₀ + B(δ_v − δ_w) with B = [m × n, n], m the midpoint and n the mean
normal: the symmetric point-to-plane distance under left twists δ of the two poses in the reference
frame. Taking one midpoint for both sides keeps the common motion of all views exactly free. A
correction of the hand-eye ξ (right perturbation, scanner frame) moves view v by Ad(T_v) ξ, so the
hand-eye fit, the per-view fit and their statistics all read the same 6x6 Gram matrices: memory is
O(pairs), never O(points x parameters).

Labelled points are pairs of views too, beside those of overlapping surfaces. A target seen by several views with
weights w = 1/σ² has its place eliminated (Schur complement). What is left is

    Σ_v w_v |x_v − x̄|² = Σ_{v<w} (w_v w_w / Σw) |x_v − x_w|²,

so every two views that see it form a pair with e = (x_v − x_w) + L(δ_v − δ_w), a 3-vector, and L = [−[x̄ − c]×, 1]
at the mean x̄ for all of them: the common motion of all views stays exactly free, as between surfaces. Their sums
follow those of the surfaces in one Gram. Without one of n views the pairs that remain keep their weights, a share 1/n
below those of a new elimination: as little as surfaces change theirs.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import mad_sigma, tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import Match, Searched, match_pairs, sample_points
from stitch.observations.surfaces.partners import find_partners, more_points
from stitch.session.capture import Capture, Sightings
from stitch.session.scan import Scan, centroid
from stitch.system.values import Value, take_rows

# Queries per view for the final normal equations and statistics.
FINE_SAMPLES = 3000
# Queries of all views together where they answer one question, a hand-eye or a scale.
_TOTAL_SAMPLES = 20_000
# Partners lie within the neighbour spacing plus 4 sigma of the surface distance.
_GATE_SPACINGS = 1.5
_GATE_SIGMAS = 4.0
# Which pairs overlap is not asked again before a view has moved, or the gate opened, by so much of the gate. The pairs
# of a gate hold those of a smaller one: asked again where they may be too many.
_SAME_PAIRS = 0.3
_SMALLER_GATE = 0.1
# Residuals beyond 4 robust sigmas are not surface distances; for normal errors that cuts 0.006 %.
RMS_GATE = 4.0
# Directions of H weaker than this share of the strongest (as displacements) carry no evidence: what
# little they have comes from the noise of the normals. Gap seen on real parts: 3e-4 (noise on a
# sphere and a cone) against 5e-3 (their weakest true directions). Labelled points have no such bias: what they
# see is known by their sigma, as long as the lever is not noise itself: a three-hundredth of the part's.
NEAR_NULL = 1e-3
_NULL = 1e-5
_ROUNDING = 1e-12
_PAIR_FIELDS = ("pairs", "matrix", "vector", "square", "weight", "count", "raw_square", "labelled")


@dataclass(frozen=True, eq=False)
class Overlaps(Value):
    """Correspondences of all overlapping pairs, and common targets, with the normal equations of both.

    Example:
        >>> len(run.overlaps.pairs), run.overlaps.gate > 0  # length_unit
        (10, True)
    """

    pairs: list[tuple[int, int]]
    matches: list[Match]
    gram: "Gram"
    gate: float
    targets: "TargetPairs | None" = None
    probed: tuple[Array, float] | None = None  # poses (V, 4, 4) and gate under which the pairs were found
    searched: Searched | None = None  # nearest points, for the next iteration; None: it searches all anew
    strides: Indices | None = None  # (V,) every t-th point of a view is searched in a partner; None: `match_pairs` says


def collect_overlaps(
    capture: Capture,
    poses: Array,
    gate: float,
    samples: Sequence[Indices] | None = None,
    before: Overlaps | None = None,
) -> Overlaps:
    """Return the correspondences of all overlapping pairs of views, and of common targets, with their normal equations.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        gate: largest distance between corresponding points, length_unit.
        samples: per view the numbers of the points that are searched in other views; None: `FINE_SAMPLES` of each.
        before: of an earlier iteration. Its pairs, and the nearest points that cannot have changed, are used again
            while the views have moved little; None: all is searched.

    Raises:
        NoResultError: no two views overlap.
    """
    if samples is None:
        samples = [sample_points(scan, FINE_SAMPLES) for scan in capture.scans]
    if before is not None and before.probed is not None and _pairs_still_valid(before, poses, gate):
        pairs, strides = before.pairs, before.strides
        probed, searched = before.probed, before.searched
    else:
        pairs, strides = find_partners(capture.scans, poses, gate, at_most=max(map(len, samples)))
        probed, searched = (np.array(poses), gate), None
    if strides is not None:
        samples = more_points(capture.scans, samples, strides)
    matches, searched = match_pairs(capture.scans, poses, pairs, gate, samples, searched, strides)
    if not matches:
        raise NoResultError(
            f"{capture.name}: no two views overlap under this hand-eye; check mount, pose convention "
            "and scanner.pose, or leave scanner.pose out to have it searched"
        )
    surfaces = sum_matches(matches, len(capture.scans))
    targets = None if capture.sightings is None else target_pairs(capture.sightings, poses)
    g = append_targets(surfaces, targets, capture.noise_factor)
    return Overlaps(pairs, matches, g, gate, targets, probed, searched, strides)


def _pairs_still_valid(before: Overlaps, poses: Array, gate: float) -> bool:
    """Return whether the pairs of `before` still hold: views and gate have changed by less than `_SAME_PAIRS` gates.

    Both are counted since the pairs were searched. A gate below `_SMALLER_GATE` of that one needs a new search, since
    too many pairs would be kept.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        gate: largest distance between corresponding points, length_unit.
    """
    assert before.probed is not None
    probed_poses, probed_gate = before.probed
    if gate < _SMALLER_GATE * probed_gate:
        return False
    twists = frames.twists_about(before.gram.centre, probed_poses, poses)
    moved = np.linalg.norm(twists[:, 3:], axis=1) + before.gram.lever * np.linalg.norm(twists[:, :3], axis=1)
    return bool(max(moved.max(), gate - probed_gate) < _SAME_PAIRS * min(gate, probed_gate))


def carry_overlaps(capture: Capture, before: Overlaps, start: Array, poses: Array) -> Overlaps:
    """Return the overlaps with the same correspondences after a small motion of the views, without a search.

    The residual e of a correspondence becomes e + B (δ_v − δ_w), to first order in the left twists δ of its views.

    Args:
        before: overlaps at `start`.
        start: (V, 4, 4) T_reference_scanner under which the points were matched.
        poses: (V, 4, 4) T_reference_scanner after the motion.
    """
    centre = before.gram.centre
    twists = frames.twists_about(centre, start, poses)
    matches = []
    for m in before.matches:
        change = frames.plane_rows(m.middle - centre, m.normal) @ (twists[m.v] - twists[m.w])
        matches.append(replace(m, residual=m.residual + change))
    targets = None if capture.sightings is None else target_pairs(capture.sightings, poses)
    g = append_targets(sum_matches(matches, len(capture.scans)), targets, capture.noise_factor)
    return replace(before, matches=matches, gram=g, targets=targets)


def common_samples(scans: Sequence[Scan], most: int) -> list[Indices]:
    """Return per view the numbers of the points that are searched in others: at most `_TOTAL_SAMPLES` in all views.

    For estimates of few numbers from all views together, as a hand-eye: of many views each needs fewer points.

    Args:
        most: largest number of points of one view.
    """
    return [sample_points(scan, min(most, _TOTAL_SAMPLES // len(scans))) for scan in scans]


def next_gate(overlaps: Overlaps, capture: Capture) -> float:
    """Return the largest distance, length_unit, that partners may have: from the spacing and the residuals' sigma."""
    return _GATE_SPACINGS * capture.spacing + _GATE_SIGMAS * overlaps.gram.scale


def pooled_rms(overlaps: Sequence[Overlaps]) -> float:
    """Return the rms distance, length_unit, of the correspondences of all captures, inside the robust gate."""
    square = sum(o.gram.raw_square.sum() for o in overlaps)
    return float(np.sqrt(square / max(sum(o.gram.count.sum() for o in overlaps), 1)))


@dataclass(frozen=True)
class VisibleDirections:
    """The n directions of the views' twists that overlaps and targets see: twists are scale · vectors · z."""

    values: Array  # (n,) eigenvalues of the scaled H
    vectors: Array  # (6V, n) its eigenvectors
    scale: Array  # (6V,) rotations count as displacements at the correspondences' lever
    of_surfaces: Array  # (6V, k) orthonormal basis of what surfaces alone see


@dataclass(frozen=True)
class Gram:
    """Sums over the correspondences of P pairs of V views, about `centre`."""

    views: int
    pairs: Array  # (P, 2) int
    matrix: Array  # (P, 6, 6) Σ w BᵀB
    vector: Array  # (P, 6) Σ w Bᵀe
    square: Array  # (P,) Σ w e²
    weight: Array  # (P,) Σ w; 0 for labelled points
    count: Array  # (P,) correspondences inside the robust gate; 0 for labelled points
    raw_square: Array  # (P,) Σ e² inside the robust gate
    scale: float  # robust sigma of e
    centre: Array  # (3,)
    labelled: Mask  # (P,) pairs of labelled points (`target_pairs`), in the surfaces' unit of variance

    @property
    def rms(self) -> float:
        """Root mean square of e inside the robust gate, length_unit."""
        return float(np.sqrt(self.raw_square.sum() / max(self.count.sum(), 1)))

    @property
    def lever(self) -> float:
        """Rms distance, length_unit, by which a radian about `centre` moves correspondences along their normals."""
        total = self.matrix.sum(axis=0)
        return float(np.sqrt(np.trace(total[:3, :3]) / max(np.trace(total[3:, 3:]), 1e-300)))

    @property
    def displacement_factors(self) -> Array:
        """(6,) factors that make of a twist about the centre displacements, length_unit: rotations times the lever."""
        return np.array([max(self.lever, 1e-300)] * 3 + [1.0] * 3)

    @cached_property
    def visible(self) -> VisibleDirections:
        """Directions of the views' twists that overlaps and common targets see: eigenvectors of H, found once.

        Twists are scaled to displacements. Directions whose eigenvalue is below `NEAR_NULL` of the largest are not seen
        by surfaces. Targets add directions of their own; within the sum H is diagonalised again.
        """
        scale = np.tile(1 / self.displacement_factors, self.views)
        values, vectors = np.linalg.eigh(assemble(self, ~self.labelled)[0] * scale[:, None] * scale)
        is_seen = values > NEAR_NULL * values[-1]
        values, by_surfaces = values[is_seen], vectors[:, is_seen]
        if not self.labelled.any():
            return VisibleDirections(values, by_surfaces, scale, by_surfaces)
        H_targets = assemble(self, self.labelled)[0] * scale[:, None] * scale
        basis = np.hstack([by_surfaces, _target_only_directions(H_targets, by_surfaces)])
        H = (by_surfaces * values) @ by_surfaces.T + H_targets
        values, within = np.linalg.eigh(basis.T @ H @ basis)
        # Targets of a huge sigma leave eigenvalues that are rounding, of either sign.
        is_seen = values > _ROUNDING * values[-1]
        return VisibleDirections(values[is_seen], basis @ within[:, is_seen], scale, by_surfaces)

    def only(self, keep: Mask) -> "Gram":
        """Return the sums of some of the pairs, by a mask (P,)."""
        return take_rows(self, keep, *_PAIR_FIELDS)

    @property
    def variance(self) -> float:
        """Weighted mean of e² between surfaces, length_unit²."""
        return float(self.square[~self.labelled].sum() / max(self.weight.sum(), 1e-300))


def _target_only_directions(H: Array, vectors: Array) -> Array:
    """Return an orthonormal basis (6V, k) of the scaled twists that targets see and surfaces do not.

    Eigenvalues below `_NULL` of the largest count as not seen. They occur where a target is the centre of the ball that
    is the surface: both centres differ by noise only, and so does what a rotation of the ball does.

    Args:
        H: (6V, 6V) normal matrix of the targets, scaled.
        vectors: (6V, n) orthonormal basis of what surfaces see.
    """
    unseen = np.linalg.svd(vectors, full_matrices=True)[0][:, vectors.shape[1] :]
    if not unseen.shape[1]:
        return unseen
    values, within = np.linalg.eigh(unseen.T @ H @ unseen)
    return unseen @ within[:, values > _NULL * np.linalg.eigvalsh(H)[-1]]


def robust_scale(matches: Iterable[Match]) -> float:
    """Return the robust sigma, length_unit, of the residuals of all pairs about zero; NaN without pairs."""
    residuals = [m.residual for m in matches]
    return max(mad_sigma(np.concatenate(residuals)), _ROUNDING) if residuals else float("nan")


def sum_matches(matches: Sequence[Match], views: int) -> Gram:
    """Return the sums of `gram` over pairs of V views, about the mean of their centroids, at their robust sigma."""
    centre = np.mean([centroid(m.middle) for m in matches], axis=0)
    return gram(matches, views, centre, robust_scale(matches))


def gram(
    matches: Sequence[Match], views: int, centre: Array, scale: float, weights: Sequence[Array] | None = None
) -> Gram:
    """Return per pair of views the sums Σ w BᵀB, Σ w Bᵀe, Σ w e², Σ w over its correspondences, with e and B.

    e is the signed distance of a correspondence, B its row [m × n, n] per left twist of a view about `centre`.

    Args:
        matches: one per pair of views.
        views: their number V.
        centre: (3,) reference frame.
        scale: robust sigma of e, length_unit, at which Tukey's weights fall and residuals are cut (`RMS_GATE`).
        weights: (M,) per match, instead of the match's own weights times Tukey's; None: these.
    """
    rows = []
    for i, m in enumerate(matches):
        e = m.residual
        weight = m.weight * tukey(e, scale) if weights is None else weights[i]
        B = frames.plane_rows(m.middle - centre, m.normal)
        weighted = B * weight[:, None]
        inside = np.abs(e) < RMS_GATE * scale
        rows.append(
            {
                "matrix": weighted.T @ B,
                "vector": weighted.T @ e,
                "square": float(weight @ e**2),
                "weight": float(weight.sum()),
                "count": int(inside.sum()),
                "raw_square": float((e[inside] ** 2).sum()),
            }
        )
    sums = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    pairs = np.array([(m.v, m.w) for m in matches])
    return Gram(views=views, pairs=pairs, scale=scale, centre=centre, labelled=np.zeros(len(pairs), bool), **sums)


def assemble(g: Gram, keep: Array | Mask | None = None) -> tuple[Array, Array]:
    """Return H (6V, 6V) and b (6V,) of the quadratic cost ½ δᵀHδ + bᵀδ in the left twists δ of all views.

    A pair (v, w) counts δ_v − δ_w: its matrix is added to the blocks vv and ww, and subtracted from vw and wv.

    Args:
        keep: (P,) bool, the pairs that count; None: all.
    """
    H = np.zeros((g.views, 6, g.views, 6))
    b = np.zeros((g.views, 6))
    for i, (v, w) in enumerate(g.pairs):
        if keep is not None and not keep[i]:
            continue
        H[v, :, v] += g.matrix[i]
        H[w, :, w] += g.matrix[i]
        H[v, :, w] -= g.matrix[i]
        H[w, :, v] -= g.matrix[i]
        b[v] += g.vector[i]
        b[w] -= g.vector[i]
    n = 6 * g.views
    return H.reshape(n, n), b.reshape(n)


def pair_squares(g: Gram, twists: Array) -> Array:
    """Return Σ w e² of every pair (P,) after the views moved by left twists (V, 6), without new correspondences."""
    difference = twists[g.pairs[:, 0]] - twists[g.pairs[:, 1]]
    linear = np.einsum("pi,pi->p", g.vector, difference)
    quadratic = np.einsum("pi,pij,pj->p", difference, g.matrix, difference)
    return g.square + 2 * linear + quadratic


@dataclass(frozen=True)
class TargetPairs:
    """N pairs of sightings, each of one target, in the reference frame."""

    views: Indices  # (N, 2) v < w
    slots: Indices  # (N, 2) of these views
    place: Array  # (N, 3) x̄, weighted mean of all views that see the target
    difference: Array  # (N, 3) x_v − x_w
    information: Array  # (N,) w_v w_w / Σw, 1/length²

    def lever(self, centre: Array) -> Array:
        """Return the motion (N, 3, 6) of each target per left twist of a view about `centre` (3,)."""
        turn = -frames.skew(self.place - centre)
        return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=2)


def target_pairs(sightings: Sightings, poses: Array) -> TargetPairs | None:
    """Return one row per target and pair of views that both see it; None where no two views see the same target.

    The n views that see a target make n(n − 1)/2 rows: eliminating its unknown place leaves exactly their differences,
    weighted by w_v w_w / Σw with w = 1/σ² (see the head of this file).

    Args:
        poses: T_reference_scanner (V, 4, 4).
    """
    parts = []
    placed = frames.transform(poses, sightings.points)
    for k in range(len(sightings.targets)):
        seen = np.argwhere(sightings.used & (sightings.target == k)).astype(np.int64)
        if len(seen) < 2:
            continue
        x = placed[seen[:, 0], seen[:, 1]]
        w = sightings.sigma[seen[:, 0], seen[:, 1]] ** -2.0
        a, b = np.array(list(combinations(range(len(seen)), 2))).T
        views = np.stack([seen[a, 0], seen[b, 0]], axis=1)
        slots = np.stack([seen[a, 1], seen[b, 1]], axis=1)
        place = np.broadcast_to(w @ x / w.sum(), (len(a), 3))
        parts.append((views, slots, place, x[a] - x[b], w[a] * w[b] / w.sum()))
    return TargetPairs(*(np.concatenate(column) for column in zip(*parts, strict=True))) if parts else None


def append_targets(g: Gram, targets: TargetPairs | None, noise_factor: float) -> Gram:
    """Return the sums of the surfaces' pairs, followed by those of pairs of views with common targets.

    Targets are weighted by 1/σ², surfaces by weights near 1. Targets are brought to the unit of the surfaces: times the
    variance of a distance between surfaces, `noise_factor` · `g.variance`.

    Args:
        g: sums of surfaces alone.
        targets: None: there are none, `g` is returned.
        noise_factor: variance between surfaces over that of independent distances. It exceeds 1, since correspondences
            share points, normals and the scanner's smooth errors.
    """
    if targets is None:
        return g
    lever = targets.lever(g.centre)
    weight = g.variance * noise_factor * targets.information
    weighted = lever * weight[:, None, None]
    pairs, matrix = sum_by_pair(targets, np.einsum("nia,nib->nab", weighted, lever))
    zeros = np.zeros(len(pairs))
    of_targets: dict[str, Any] = {
        "pairs": pairs,
        "matrix": matrix,
        "vector": sum_by_pair(targets, np.einsum("nia,ni->na", weighted, targets.difference))[1],
        "square": sum_by_pair(targets, weight * np.einsum("ni,ni->n", targets.difference, targets.difference))[1],
        "weight": zeros,
        "count": zeros.astype(int),
        "raw_square": zeros,
        "labelled": np.ones(len(pairs), bool),
    }
    joined: dict[str, Any] = {name: np.concatenate([getattr(g, name), of_targets[name]]) for name in _PAIR_FIELDS}
    return replace(g, **joined)


def sum_by_pair(targets: TargetPairs, rows: Array) -> tuple[Indices, Array]:
    """Return the different pairs of views (P, 2) of N rows, and per pair the sum of its rows (N, …): (P, …)."""
    pairs, number = np.unique(targets.views, axis=0, return_inverse=True)
    out = np.zeros((len(pairs), *rows.shape[1:]))
    np.add.at(out, number.reshape(-1), rows)
    return pairs, out
