"""Hand-eyes that were tried, and which of them are the same answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.asking import Asking, asking
from stitch.observations.surfaces.match import sample
from stitch.stages.initial_guess.centroids import scanner_centre
from stitch.system.threads import parallel

# Points of a view that are asked for their nearest neighbours while a hand-eye is searched.
SEARCH_SAMPLES = 120
# Two candidates are the same answer if they place the part within this share of its size.
_SAME_SHARE = 0.03


@dataclass(frozen=True)
class Candidate:
    """One hand-eye that was tried: its origin and how well all views fall together."""

    source: str
    T_mount: Array  # (4, 4) after closing in
    score: float  # length_unit, lower is better
    reached: int = 1  # starts that ended here


def consistency(captures: Sequence[Capture], T_mount: Array, limit: float) -> float:
    """Root mean square distance of points to every other view, truncated at `limit`.

    Views that fail to meet count with the limit, so falling apart cannot pay.
    """
    squares: list[float] = []
    for c in captures:
        poses = c.poses(T_mount)
        picked = [sample(scan, SEARCH_SAMPLES) for scan in c.scans]
        every = asking(c.scans, poses, picked)

        def mean_squares(w: int, every: Asking = every) -> list[float]:
            parts = [(v, slice(None)) for v in range(len(every.scans)) if v != w and len(every.index[v])]
            if not parts:
                return []
            _, points, normals = every.together(parts)
            distance, _, facing = every.search(w, points, normals, limit)
            by_view = np.split(np.where(facing, distance, limit) ** 2, np.cumsum(every.lengths(parts))[:-1])
            return [float(np.mean(own)) for own in by_view]

        squares += chain.from_iterable(parallel(mean_squares, range(len(c.scans))))
    return float(np.sqrt(np.mean(squares)))


def distinct(captures: Sequence[Capture], tried: Sequence[Candidate], size: float) -> list[Candidate]:
    """Distinct answers, best first; each keeps its best hand-eye and the name of its first start."""
    groups: list[list[Candidate]] = []
    for candidate in tried:
        for group in groups:
            if same_answer(captures, size, candidate.T_mount, group[0].T_mount):
                group.append(candidate)
                break
        else:
            groups.append([candidate])
    best = [
        replace(min(group, key=lambda c: c.score), source=group[0].source, reached=sum(c.reached for c in group))
        for group in groups
    ]
    return sorted(best, key=lambda c: c.score)


def same_answer(captures: Sequence[Capture], size: float, T_a: Array, T_b: Array) -> bool:
    """True if two hand-eyes place a part of this size (length_unit) alike: by its largest displacement."""
    centre = scanner_centre(captures)
    corners = centre + size / 2 * np.vstack([np.eye(3), -np.eye(3)])
    off = np.linalg.norm(frames.transform(T_a, corners) - frames.transform(T_b, corners), axis=1)
    return bool(off.max() < _SAME_SHARE * size)
