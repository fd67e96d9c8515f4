"""Points that look all ways: normal-space sampling (Rusinkiewicz & Levoy 2001).

On a large smooth sheet the few points of its flanks alone hold it in its plane.
"""

import numpy as np

from stitch import frames
from stitch.cells.window.joined_scans import JoinedScans
from stitch.frames import Array, Indices

_SAMPLED_POINTS = 20_000
# Normals are sorted into cells of a quarter of their unit length: about 15°.
_DIRECTIONS = 4


def sample_normal_space(scan: JoinedScans, T_base_part: Array) -> Indices:
    """(n,) indices of at most 20,000 usable points, as many of each direction as there are to share out.

    Args:
        T_base_part: (4, 4) near where the part lies: directions count in its frame.
    """
    usable = np.flatnonzero(scan.usable)
    directions = np.round(frames.rotate(frames.inverse(T_base_part), scan.normals[usable]) * _DIRECTIONS)
    _, bucket, counts = np.unique(directions.astype(int), axis=0, return_inverse=True, return_counts=True)
    quota, bucket = _quota(counts), bucket.ravel()
    order = np.argsort(bucket, kind="stable")
    first = np.cumsum(counts) - counts
    picked = [order[f + np.linspace(0, c - 1, min(quota, c)).astype(int)] for f, c in zip(first, counts, strict=True)]
    chosen: Indices = usable[np.sort(np.concatenate(picked))] if picked else usable
    return chosen


def _quota(counts: Indices) -> int:
    """The largest share per direction that keeps the sum within _POINTS."""
    low, high = 1, _SAMPLED_POINTS
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if np.minimum(counts, middle).sum() <= _SAMPLED_POINTS else (low, middle - 1)
    return low
