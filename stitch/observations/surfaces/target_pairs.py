"""Labelled points as pairs of views, beside the pairs of overlapping surfaces.

A target seen by several views with weights w = 1/σ² has its place eliminated (Schur complement). What is left is

    Σ_v w_v |x_v − x̄|² = Σ_{v<w} (w_v w_w / Σw) |x_v − x_w|²,

so every two views that see it form a pair with e = (x_v − x_w) + L(δ_v − δ_w), a 3-vector, and L = [−[x̄ − c]×, 1]
at the mean x̄ for all of them: the common motion of all views stays exactly free, as between surfaces. Their sums
follow those of the surfaces in one Gram. Without one of n views the pairs that remain keep their weights, a share 1/n
below those of a new elimination: as little as surfaces change theirs.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.sightings import Sightings
from stitch.observations.surfaces.gram import Gram


@dataclass(frozen=True)
class TargetPairs:
    """N pairs of sightings, each of one target, in the reference frame."""

    views: Indices  # (N, 2) v < w
    slots: Indices  # (N, 2) of these views
    place: Array  # (N, 3) x̄, weighted mean of all views that see the target
    difference: Array  # (N, 3) x_v − x_w
    information: Array  # (N,) w_v w_w / Σw, 1/length²

    def lever(self, centre: Array) -> Array:
        """(N, 3, 6) what a left twist of a view about `centre` does to the target."""
        turn = -frames.skew(self.place - centre)
        return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=2)


def target_pairs(sightings: Sightings, poses: Array) -> TargetPairs | None:
    """All pairs of views that see a common target; None without any.

    Args:
        poses: T_reference_scanner (V, 4, 4).
    """
    views, slots = list[Indices](), list[Indices]()
    place, apart, information = list[Array](), list[Array](), list[Array]()
    placed = frames.transform(poses, sightings.points)
    for k in range(len(sightings.targets)):
        seen = np.argwhere(sightings.used & (sightings.target == k)).astype(np.int64)
        if len(seen) < 2:
            continue
        x, w = placed[seen[:, 0], seen[:, 1]], sightings.sigma[seen[:, 0], seen[:, 1]] ** -2.0
        a, b = np.array(list(combinations(range(len(seen)), 2))).T
        views.append(np.stack([seen[a, 0], seen[b, 0]], axis=1))
        slots.append(np.stack([seen[a, 1], seen[b, 1]], axis=1))
        place.append(np.broadcast_to(w @ x / w.sum(), (len(a), 3)))
        apart.append(x[a] - x[b])
        information.append(w[a] * w[b] / w.sum())
    if not views:
        return None
    of_pairs = [np.concatenate(parts) for parts in (place, apart, information)]
    return TargetPairs(np.concatenate(views), np.concatenate(slots), *of_pairs)


def append_targets(g: Gram, targets: TargetPairs | None, noise_factor: float) -> Gram:
    """The sums of the surfaces, followed by those of the labelled points in the same unit of variance.

    Args:
        noise_factor: what a distance between surfaces varies by is `noise_factor` times `g.variance`: its
            correspondences share points, normals and the scanner's own field.
    """
    if targets is None:
        return g
    lever = targets.lever(g.centre)
    weight = g.variance * noise_factor * targets.information
    weighted = lever * weight[:, None, None]
    pairs, matrix = sum_by_pair(targets, np.einsum("nia,nib->nab", weighted, lever))
    vector = sum_by_pair(targets, np.einsum("nia,ni->na", weighted, targets.difference))[1]
    square = sum_by_pair(targets, weight * np.einsum("ni,ni->n", targets.difference, targets.difference))[1]
    return g.append(pairs=pairs, matrix=matrix, vector=vector, square=square)


def sum_by_pair(targets: TargetPairs, rows: Array) -> tuple[Indices, Array]:
    """Pairs of views (P, 2), and rows (N, ...) summed over all targets that the two have in common, (P, ...)."""
    pairs, number = np.unique(targets.views, axis=0, return_inverse=True)
    out = np.zeros((len(pairs), *rows.shape[1:]))
    np.add.at(out, number.reshape(-1), rows)
    return pairs, out
