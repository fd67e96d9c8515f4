"""Groups of views to leave out: neighbours in time, and neighbours in pose.

Leaving out random views would leave their neighbours in, which share their error.
"""

import warnings

import numpy as np
from scipy.cluster.vq import kmeans2

from stitch import frames
from stitch.frames import Array, Indices

_GROUPS = 5
# Below this many views every view is a group of its own.
_FEW = 10
# Enough places for a spread among them, enough views in each to lose it without loss of rank.
_PLACES, _VIEWS_PER_PLACE = 25, 6


def grouped_folds(T_reference_mount: Array, lever: float) -> list[Indices]:
    """Index arrays of the views to leave out together; every view is left out twice where there are enough.

    Args:
        T_reference_mount: (V, 4, 4) in the order of time.
        lever: length that makes a radian of orientation comparable with a distance.
    """
    count = len(T_reference_mount)
    if count < _FEW:
        return [np.array([v]) for v in range(count)]
    by_time = np.array_split(np.arange(count), _GROUPS)
    # A region that holds most views would leave too little to fit.
    return [f for f in [*by_time, *_regions(T_reference_mount, lever, _GROUPS)] if 0 < len(f) <= count // 2]


def places(T_reference_mount: Array, lever: float) -> list[Indices]:
    """Index arrays of views near each other, every view in one: what a model does not know errs alike in one place."""
    count = len(T_reference_mount)
    if count < _PLACES * _VIEWS_PER_PLACE:
        return [np.array([v]) for v in range(count)]
    return [f for f in _regions(T_reference_mount, lever, _PLACES) if len(f)]


def _regions(T_reference_mount: Array, lever: float, groups: int) -> list[Indices]:
    twists = frames.log(frames.inverse(T_reference_mount[:1]) @ T_reference_mount) * np.repeat([lever, 1.0], 3)
    with warnings.catch_warnings():
        # An empty group is no harm: it is left out by the callers.
        warnings.simplefilter("ignore", UserWarning)
        _, label = kmeans2(twists, groups, minit="++", seed=0)
    return [np.flatnonzero(label == k) for k in range(groups)]
