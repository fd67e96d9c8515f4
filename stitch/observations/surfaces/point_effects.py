"""How the views answer to parameters of effects: left twists of every view, as the overlaps would see them.

Effects of robot, mount and part move views as a whole. Effects of points change what the overlaps
measure; what they look like to the poses is H⁺BᵀWg, with g the change of the distance e per unit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement, Term
from stitch.model.jacobian import shifts, target_shifts, twists
from stitch.observations.surfaces.free_poses import FreePoses, answer
from stitch.observations.surfaces.gram import tukey
from stitch.observations.surfaces.match import Match
from stitch.observations.surfaces.target_pairs import by_pair
from stitch.system.threads import parallel

POINTS = ("sensor", "shape")
# Correspondences whose slopes are held at a time: a few megabytes a thread, whatever the session's size.
_BLOCK = 10_000


@dataclass(frozen=True)
class PointGram:
    """Sums over the correspondences of P pairs for K parameters of point effects, about the Gram's centre."""

    vector: Array  # (P, 6, K) Σ w Bᵀg
    residual: Array  # (P, K) Σ w g e
    square: Array  # (P, K, K) Σ w g gᵀ


def pose_twists(measurement: Measurement, terms: Sequence[Term], term: Term, T_mount: Array, freed: FreePoses) -> Array:
    """(6V, P) of an effect of robot, links, mount or part."""
    found = twists(measurement, terms, term, T_mount, freed.overlaps.gram.centre)
    return np.asarray(found.reshape(len(found), -1).T)


def point_gram(
    measurement: Measurement, terms: Sequence[Term], candidates: Sequence[Term], freed: FreePoses
) -> PointGram:
    """Sums over the correspondences for all parameters of the point effects in `candidates`."""

    def of_points(v: int, index: Indices) -> Array:
        return np.concatenate([shifts(measurement, terms, term, v, freed.poses[v], index) for term in candidates])

    def of_targets() -> Array:
        return np.concatenate([target_shifts(measurement, terms, term, freed.poses) for term in candidates])

    return streamed(freed, measurement.capture.noise_factor, of_points, of_targets)


def streamed(
    freed: FreePoses, noise_factor: float, of_points: Callable[[int, Indices], Array], of_targets: Callable[[], Array]
) -> PointGram:
    """Stream the pairs once, a block of rows at a time.

    Args:
        noise_factor: of the capture, by which labelled points count beside the surfaces.
        of_points: (K, N, 3) how far some points of view v move per unit, scanner frame.
        of_targets: (K, V, S, 3) the same for all labelled points.
    """
    g = freed.overlaps.gram

    def slopes(v: int, index: Indices, normal: Array) -> Array:
        """(N, K) how far points of view v move along normals (N, 3) of the reference frame, per unit."""
        own = frames.rotate(frames.inverse(freed.poses[v]), normal)
        return np.asarray(np.einsum("kni,ni->nk", of_points(v, index), own))

    def of_pair(m: Match) -> tuple[Array, Array, Array]:
        weight = m.weight * tukey(m.residual, g.scale)
        parts = []
        for start in range(0, len(m.residual), _BLOCK):
            at = slice(start, start + _BLOCK)
            normal = m.normal[at]
            change = slopes(m.v, m.index_v[at], normal) - slopes(m.w, m.index_w[at], normal)
            weighted = change * weight[at, None]
            B = np.concatenate([np.cross(m.middle[at] - g.centre, normal), normal], axis=1)
            parts.append((B.T @ weighted, weighted.T @ m.residual[at], weighted.T @ change))
        vector, residual, square = (sum(p) for p in zip(*parts, strict=True))
        return vector, residual, square

    sums = [*parallel(of_pair, freed.overlaps.matches), *_of_targets(freed, noise_factor, of_targets)]
    return PointGram(*(np.array([s[i] for s in sums]) for i in range(3)))


def _of_targets(freed: FreePoses, noise_factor: float, of_targets: Callable[[], Array]) -> list[tuple[Array, ...]]:
    """The same sums for every pair of views with common targets: the change of x_v − x_w is a vector."""
    targets, g = freed.overlaps.targets, freed.overlaps.gram
    if targets is None:
        return []
    moved = np.moveaxis(frames.rotate(freed.poses, of_targets()), 0, -1)  # (V, S, 3, K)
    (v, w), (slot_v, slot_w) = targets.views.T, targets.slots.T
    change = moved[v, slot_v] - moved[w, slot_w]
    weighted = change * (noise_factor * g.variance * targets.information)[:, None, None]
    vector = by_pair(targets, np.einsum("nia,nik->nak", targets.lever(g.centre), weighted))[1]
    residual = by_pair(targets, np.einsum("ni,nik->nk", targets.apart, weighted))[1]
    square = by_pair(targets, np.einsum("nik,nil->nkl", change, weighted))[1]
    return list(zip(vector, residual, square, strict=True))


def seen_twists(points: PointGram, freed: FreePoses) -> Array:
    """(6V, K) H⁺BᵀWg: what point effects do to poses that overlaps and targets alone determine."""
    return answer(freed.overlaps.gram, points.vector)


def all_columns(
    measurement: Measurement, terms: Sequence[Term], candidates: Sequence[Term], T_mount: Array, freed: FreePoses
) -> tuple[list[Array], PointGram | None, list[slice | None]]:
    """Per candidate (6V, P); the point effects' sums, and where each candidate's columns are in them."""
    points = [c for c in candidates if c.effect.place in POINTS]
    sums = point_gram(measurement, terms, points, freed) if points else None
    seen = seen_twists(sums, freed) if sums else None
    columns, where, at = [], list[slice | None](), 0
    for candidate in candidates:
        if candidate.effect.place in POINTS:
            assert seen is not None
            own = slice(at, at + len(candidate.values))
            columns.append(seen[:, own])
            where.append(own)
            at = own.stop
        else:
            columns.append(pose_twists(measurement, terms, candidate, T_mount, freed))
            where.append(None)
    return columns, sums, where
