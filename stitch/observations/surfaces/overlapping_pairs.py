"""Which views overlap."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.bounding_box import bounding_box, box_corners
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.asking import neighbour_queries
from stitch.observations.surfaces.match import sample_points
from stitch.system.threads import parallel

# Queries that decide whether two views overlap, and the share that must find a partner.
_PROBES = 250
_MINIMUM_OVERLAP = 0.04


def overlapping_pairs(
    scans: Sequence[Scan], poses: Array, gate: float, at_most: int = _PROBES
) -> list[tuple[int, int]]:
    """Pairs (v < w) of which at least 4 % of the probed points meet; poses T_reference_scanner.

    Args:
        at_most: points of a view that are probed; more than 250 tell nothing new.
    """
    every = neighbour_queries(scans, poses, [sample_points(scan, min(at_most, _PROBES)) for scan in scans])

    def meeting(of_view: tuple[int, list[int]]) -> list[int]:
        """Of the views that ask one view, those of which enough points find a partner."""
        w, views = of_view
        parts = [(v, slice(None)) for v in views if len(every.index[v])]
        if not parts:
            return []
        _, points, normals = every.gather(parts)
        agree = np.split(every.search(w, points, normals, gate)[2], np.cumsum(every.counts(parts))[:-1])
        return [v for (v, _), own in zip(parts, agree, strict=True) if np.mean(own) >= _MINIMUM_OVERLAP]

    def met(pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
        """Of pairs (asking, asked) those that meet."""
        asked = defaultdict[int, list[int]](list)
        for v, w in pairs:
            asked[w].append(v)
        return {(v, w) for w, views in zip(asked, parallel(meeting, asked.items()), strict=True) for v in views}

    near = near_pairs(scans, poses, gate)
    found = met(near)
    found |= {(v, w) for w, v in met([(w, v) for v, w in near if (v, w) not in found])}
    return [pair for pair in near if pair in found]


def near_pairs(scans: Sequence[Scan], poses: Array, gate: float) -> list[tuple[int, int]]:
    """Pairs (v < w) whose bounding boxes come within `gate`: no others can have partners."""
    placed = [frames.transform(T, box_corners(bounding_box(scan.points))) for scan, T in zip(scans, poses, strict=True)]
    low, high = np.min(placed, axis=1), np.max(placed, axis=1)
    apart = (low[:, None] - high[None] > gate).any(axis=2)
    v, w = np.nonzero(np.triu(~(apart | apart.T), 1))
    return list(zip(v.tolist(), w.tolist(), strict=True))
