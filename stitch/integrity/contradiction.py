"""Which scans show a surface where others show it elsewhere, facing the same way: it cannot be in two places.

Partners beyond the gate are no partners, so that such a scan keeps its few that fit and seems to fit well, and the
stitched cloud gets a second surface beside the first. What is torn in itself, because the part moved during the scan or
two scans are in one file, fits with one half and contradicts with the other.
"""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.shown import PointVisibility, classify_visibility
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.match import sample_points
from stitch.observations.surfaces.overlapping_pairs import near_pairs
from stitch.statistics.tails import binomial_tail

# Points of a scan that are asked, in so many other scans each (with more they take turns), and how far from their
# surface, as a share of the part's size.
_CONTRADICTION_PROBES, _VIEWS_COMPARED, _SEARCH_REACH = 500, 20, 0.1
# A scan contradicts the others if this share of what they show of it stands elsewhere; one that was put where it fits
# best, and still does by the second, is torn.
CONTRADICTS, STILL_CONTRADICTS = 0.2, 0.05
# The chance of as many where the share is no larger: of a scan seen from its edge others show few points.
_CONTRADICTION_CHANCE = 1e-4


def find_contradicting_views(
    scans: Sequence[Scan],
    poses: Array,
    tolerance: float,
    size: float,
    share: float = CONTRADICTS,
    groups: Sequence[Sequence[int]] = (),
) -> tuple[int, ...]:
    """Views that contradict the others, most of all first; each is asked without those before it.

    Args:
        poses: (V, 4, 4) T_reference_scanner at which the views fit best.
        tolerance: distance along the normal that is the same place, length_unit.
        size: of the part, length_unit.
        share: of what others show of a view that stands elsewhere.
        groups: views that link each other: only within one is each asked, since groups may stand apart. Empty: all are.
    """
    said = _point_visibility(scans, poses, tolerance, _SEARCH_REACH * size)
    for group in groups:
        for v in group:
            said[v] = {w: shown for w, shown in said[v].items() if w in group}
    out = list[int]()
    while True:
        shares = [0.0 if v in out else _contradicted_share(own, out, share) for v, own in enumerate(said)]
        worst = int(np.argmax(shares))
        if not shares[worst]:
            return tuple(out)
        out.append(worst)


def _contradicted_share(own: dict[int, PointVisibility], without: Sequence[int], least: float) -> float:
    """Of the points that other views show too, the share that all of these show elsewhere; 0 up to the least one."""
    others = [shown for w, shown in own.items() if w not in without]
    if not others:
        return 0.0
    best = np.max(others, axis=0)
    elsewhere, asked = int(np.sum(best == 1)), int(np.sum(best > 0))
    return elsewhere / asked if binomial_tail(elsewhere - 1, asked, least) < _CONTRADICTION_CHANCE else 0.0


def _point_visibility(
    scans: Sequence[Scan], poses: Array, tolerance: float, reach: float
) -> list[dict[int, PointVisibility]]:
    """Per view and other view what that shows of each asked point (n,)."""
    near: list[list[int]] = [[] for _ in scans]
    for v, w in near_pairs(scans, poses, reach):
        near[v].append(w)
        near[w].append(v)
    out = []
    for v, scan in enumerate(scans):
        index, turns = sample_points(scan, _CONTRADICTION_PROBES), -(-len(near[v]) // _VIEWS_COMPARED)
        shown = {w: np.zeros(len(index), np.int8) for w in near[v]}
        for k, w in enumerate(near[v]):
            asked, T_w_v = slice(k % turns, None, turns), frames.inverse(poses[w]) @ poses[v]
            points = frames.transform(T_w_v, scan.points[index[asked]])
            normals = frames.rotate(T_w_v, scan.normals[index[asked]])
            shown[w][asked] = classify_visibility(scans[w], points, normals, (tolerance, reach))
        out.append(shown)
    return out
