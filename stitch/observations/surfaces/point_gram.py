"""What changes of the points themselves do to the sums over pairs, streamed: memory never grows with the points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices, Mask
from stitch.observations.surfaces.free_poses import FreePoses, answer
from stitch.observations.surfaces.match import Match
from stitch.observations.surfaces.target_pairs import by_pair
from stitch.statistics.robust import tukey
from stitch.system.threads import parallel

# Correspondences whose slopes are held at a time: a few megabytes a thread, whatever the session's size.
_BLOCK = 10_000


@dataclass(frozen=True)
class PointGram:
    """Sums over the correspondences of P pairs for K parameters of point effects, about the Gram's centre."""

    vector: Array  # (P, 6, K) Σ w Bᵀg
    residual: Array  # (P, K) Σ w g e
    square: Array  # (P, K, K) Σ w g gᵀ

    def of(self, keep: slice | Mask) -> "PointGram":
        """The sums of some of the parameters."""
        return PointGram(self.vector[:, :, keep], self.residual[:, keep], self.square[:, keep][:, :, keep])


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
