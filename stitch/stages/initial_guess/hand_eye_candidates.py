"""Hand-eyes that were tried, and which of them are the same answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.asking import NeighbourQueries, neighbour_queries
from stitch.observations.surfaces.match import sample_points
from stitch.stages.initial_guess.centroids import scanner_centre
from stitch.system.threads import parallel

# Points of a view that are asked for their nearest neighbours while a hand-eye is searched.
SEARCH_SAMPLES = 120
# Two candidates are the same answer if they place the part within this share of its size.
_SAME_SHARE = 0.03


@dataclass(frozen=True)
class HandEyeCandidate:
    """One hand-eye that was tried: its origin and how well all views fall together."""

    source: str
    T_mount: Array  # (4, 4) after closing in
    score: float  # length_unit, lower is better
    reached: int = 1  # starts that ended here


def view_consistency(captures: Sequence[Capture], T_mount: Array, limit: float) -> float:
    """Root mean square distance of points to every other view, truncated at `limit`.

    Views that fail to meet count with the limit, so falling apart cannot pay.
    """
    squares: list[float] = []
    for c in captures:
        poses = c.poses(T_mount)
        picked = [sample_points(scan, SEARCH_SAMPLES) for scan in c.scans]
        every = neighbour_queries(c.scans, poses, picked)

        def mean_squares(w: int, every: NeighbourQueries = every) -> list[float]:
            parts = [(v, slice(None)) for v in range(len(every.scans)) if v != w and len(every.index[v])]
            if not parts:
                return []
            _, points, normals = every.gather(parts)
            distance, _, facing = every.search(w, points, normals, limit)
            by_view = np.split(np.where(facing, distance, limit) ** 2, np.cumsum(every.counts(parts))[:-1])
            return [float(np.mean(own)) for own in by_view]

        squares += chain.from_iterable(parallel(mean_squares, range(len(c.scans))))
    return float(np.sqrt(np.mean(squares)))


def distinct_hand_eyes(
    captures: Sequence[Capture], tried: Sequence[HandEyeCandidate], size: float
) -> list[HandEyeCandidate]:
    """Distinct answers, best first; each keeps its best hand-eye and the name of its first start."""
    groups: list[list[HandEyeCandidate]] = []
    for candidate in tried:
        for group in groups:
            if same_hand_eye(captures, size, candidate.T_mount, group[0].T_mount):
                group.append(candidate)
                break
        else:
            groups.append([candidate])
    best = [
        replace(min(group, key=lambda c: c.score), source=group[0].source, reached=sum(c.reached for c in group))
        for group in groups
    ]
    return sorted(best, key=lambda c: c.score)


def same_hand_eye(captures: Sequence[Capture], size: float, T_a: Array, T_b: Array) -> bool:
    """True if two hand-eyes place a part of this size (length_unit) alike: by its largest displacement."""
    centre = scanner_centre(captures)
    corners = centre + size / 2 * np.vstack([np.eye(3), -np.eye(3)])
    off = np.linalg.norm(frames.transform(T_a, corners) - frames.transform(T_b, corners), axis=1)
    return bool(off.max() < _SAME_SHARE * size)
