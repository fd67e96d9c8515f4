"""Folds of cross-validation: which views are left out together."""

import warnings

import numpy as np

from stitch.numerics.folds import grouped_folds, halves_of, joint_ends


def test_ends_of_joints_are_fifths_of_what_was_driven():
    rng = np.random.default_rng(0)
    joints = np.column_stack([rng.permutation(200), np.zeros(200)])
    seen = np.arange(0, 200, 2)
    low, high = joint_ends(joints, seen)  # none of the joint that stands still
    assert (low.joint, low.upper, high.upper) == (0, False, True)
    assert np.isin(low.views, seen).all() and 19 <= len(low.views) <= 21
    assert joints[low.views, 0].max() < np.quantile(joints[seen, 0], 0.21)
    assert joints[high.views, 0].min() > np.quantile(joints[seen, 0], 0.79)
    assert joint_ends(joints, seen[:60]) == []


def test_folds_leave_out_neighbours():
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = np.arange(20) % 5 * 100.0
    folds = grouped_folds(T, 100.0)
    assert sorted(np.concatenate(folds[:5])) == list(range(20))
    assert all(np.ptp(f) == 3 for f in folds[:5])  # four in a row by time
    assert all(len(set(T[f, 0, 3])) == 1 for f in folds[5:])  # one place each by pose


def test_poses_that_repeat_stay_together_and_nothing_is_printed():
    """Three stops, each visited seven times: fewer places than groups."""
    T = np.tile(np.eye(4), (21, 1, 1))
    T[:, 0, 3] = np.repeat([0.0, 300.0, 700.0], 7)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        folds = grouped_folds(T, 100.0)
    assert [sorted(f) for f in sorted(folds[5:], key=min)] == [[*range(7)], [*range(7, 14)], [*range(14, 21)]]


def test_halves_share_no_view_and_leave_out_none():
    T = np.tile(np.eye(4), (13, 1, 1))
    T[:, 0, 3] = np.random.default_rng(0).permutation(13) * 100.0
    in_time, by_place, alternately = halves_of(T, 100.0)
    for one, other in (in_time, by_place, alternately):
        assert sorted([*one, *other]) == list(range(13)) and abs(len(one) - len(other)) == 1
    assert in_time[0].max() < in_time[1].min()
    # One half lies beyond the other, whichever way round.
    x = [T[half, 0, 3] for half in by_place]
    assert x[0].max() < x[1].min() or x[1].max() < x[0].min()
    assert set(alternately[0] % 2) == {0} and set(alternately[1] % 2) == {1}
