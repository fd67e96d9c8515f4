"""Groups of views to leave out: neighbours in time, neighbours in pose, ends of a joint's range.

Leaving out random views would leave their neighbours in, which share their error.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices

_GROUPS = 5
# Below this many views every view is a group of its own.
_FEW = 10
# Enough places for a spread among them, enough views in each to lose it without loss of rank.
_PLACES, _VIEWS_PER_PLACE = 25, 6
# A fifth of the views at either end, if these are enough to tell their mean error from another.
_END, _VIEWS_PER_END = 0.2, 20


@dataclass(frozen=True)
class JointEnd:
    """The views at one end of a joint's range: a model fitted without them has to extrapolate to them."""

    joint: int  # counted from 0
    upper: bool  # the end of the largest angles; False: of the smallest
    views: Indices  # (K,)

    @property
    def name(self) -> str:
        """The end in words: the highest or lowest fifth of a joint, counted from 1."""
        return f"the {'highest' if self.upper else 'lowest'} fifth of joint {self.joint + 1}"


def grouped_folds(T_base_flange: Array, lever: float) -> list[Indices]:
    """Return folds for cross-validation: index arrays of the views that one fit leaves out together.

    Few views are left out one by one. Else there are `_GROUPS` folds of neighbours in time and as many of neighbours in
    pose, so that each view is left out twice; folds of more than half of the views are dropped.

    Args:
        T_base_flange: (V, 4, 4) in the order of time.
        lever: length, length_unit, at which a rotation by 1 rad counts as far as a shift by that length.
    """
    count = len(T_base_flange)
    if count < _FEW:
        return [np.array([v]) for v in range(count)]
    by_time = np.array_split(np.arange(count), _GROUPS)
    # A region that holds most views would leave too little to fit.
    return [f for f in [*by_time, *_regions(T_base_flange, lever, _GROUPS)] if 0 < len(f) <= count // 2]


def halves_of(T_base_flange: Array, lever: float) -> list[tuple[Indices, Indices]]:
    """Return three ways to split V views in halves: by time, along the main direction of their poses, alternately.

    Args:
        T_base_flange: (V, 4, 4) in the order of time.
        lever: length, length_unit, at which a rotation by 1 rad counts as far as a shift by that length.

    Returns:
        Three pairs of sorted indices of views.
    """
    views = np.arange(len(T_base_flange))
    twists = _pose_offsets(T_base_flange, lever)
    # Along the direction in which the poses differ most.
    along = np.linalg.svd(twists - twists.mean(axis=0), full_matrices=False)[0][:, 0]
    orders = views, np.argsort(along, kind="stable"), np.argsort(views % 2, kind="stable")
    halves = [np.array_split(order, 2) for order in orders]
    return [(np.sort(first), np.sort(second)) for first, second in halves]


def view_clusters(T_base_flange: Array, lever: float) -> list[Indices]:
    """Return index arrays of views with neighbouring poses, each view in exactly one: errors are alike in one place.

    Few views, below `_PLACES`·`_VIEWS_PER_PLACE`, are one group each.

    Args:
        T_base_flange: (V, 4, 4).
        lever: length, length_unit, at which a rotation by 1 rad counts as far as a shift by that length.
    """
    count = len(T_base_flange)
    if count < _PLACES * _VIEWS_PER_PLACE:
        return [np.array([v]) for v in range(count)]
    return [f for f in _regions(T_base_flange, lever, _PLACES) if len(f)]


def joint_ends(joints: Array, observed: Indices) -> list[JointEnd]:
    """Return for each joint the views in the lowest and in the highest fifth of its angles.

    An end is left out where it holds fewer than `_VIEWS_PER_END` views, or more than half of them, as of a joint that
    stands still.

    Args:
        joints: (V, n) rad.
        observed: (K,) indices of the views that have observations; the others belong to no end.
    """
    out = []
    angles = joints[observed]
    for joint, (q, low, high) in enumerate(zip(angles.T, *np.quantile(angles, [_END, 1 - _END], axis=0), strict=True)):
        for upper, views in ((False, observed[q <= low]), (True, observed[q >= high])):
            # Where many views share one angle, an end may be most of them.
            if _VIEWS_PER_END <= len(views) <= len(observed) // 2:
                out.append(JointEnd(joint, upper, views))
    return out


def _pose_offsets(T_base_flange: Array, lever: float) -> Array:
    """Return twists (V, 6) of the flange from its first pose, as lengths: the same wherever the base's frame lies."""
    return frames.log(frames.inverse(T_base_flange[:1]) @ T_base_flange) * np.repeat([lever, 1.0], 3)


def _regions(T_base_flange: Array, lever: float, groups: int) -> list[Indices]:
    """Return `groups` index arrays of views whose poses lie near each other, by k-means; some may be empty.

    Args:
        T_base_flange: (V, 4, 4).
        lever: length, length_unit, at which a rotation by 1 rad counts as far as a shift by that length.
    """
    twists = _pose_offsets(T_base_flange, lever)
    # Poses that repeat count once, in the order of their first visit: of fewer places than groups k-means would find
    # none to begin the last group with.
    _, first, pose = np.unique(twists, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    with warnings.catch_warnings():
        # An empty group is no harm: it is left out by the callers.
        warnings.simplefilter("ignore", UserWarning)
        from scipy.cluster.vq import kmeans2

        _, label = kmeans2(twists[first[order]], min(groups, len(first)), minit="++", seed=0)
    # Back from poses in the order of their first visit, over sorted poses, to views.
    of_view = label[np.argsort(order)][pose]
    return [np.flatnonzero(of_view == k) for k in range(groups)]
