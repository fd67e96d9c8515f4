"""Tables of poses of which one part was written in another way than the rest: two programs made them, or two people."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from stitch.frames import Array, Mask
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.motion_fit import FEWEST, ROTATION, rotation_angles
from stitch.integrity.relative_scans import RelativeScans

# Mistakes that turn each pose by itself.
_OF_ONE_ROW = ("inverse", "quaternion", "euler", "degrees")


def hypotheses_by_table_part(
    tried: Sequence[Hypothesis], motions: RelativeScans, names: Sequence[str]
) -> Iterator[Hypothesis]:
    """The stated poses, up to some row or from it on with a mistake undone that turns them.

    Args:
        tried: hypotheses, the first of which is the poses as stated.
        names: of the views.
    """
    v, w = np.array(motions.pairs).T
    sides = [
        side
        for side in _table_parts(len(names))
        if min((side[v] & side[w]).sum(), (~side[v] & ~side[w]).sum()) >= FEWEST
    ]
    stated, seen = tried[0].T_reference_mount[:, :3, :3], rotation_angles(motions.T)
    for h in tried[1:]:
        if h.kind not in _OF_ONE_ROW or not sides:
            continue
        R = np.array([stated, h.T_reference_mount[:, :3, :3]])
        if np.abs(R[1] - R[0]).max() < ROTATION:
            continue
        near = np.array([[_motions_of_same_angle(R[a][v], R[b][w], seen) for b in (0, 1)] for a in (0, 1)])
        agree = [near[side[v].astype(int), side[w].astype(int), np.arange(len(v))].mean() for side in sides]
        # Both sides of one row may turn alike under a reading, and only the hand-eye tells which was read so.
        for side in (own for own, share in zip(sides, agree, strict=True) if share == max(agree)):
            rows = tuple(int(row) for row in np.flatnonzero(side))
            T = np.where(side[:, None, None], h.T_base_flange, tried[0].T_base_flange)
            fix = f"from {names[rows[0]]} to {names[rows[-1]]} alone {h.fix}"
            yield replace(h, T_base_flange=T, fix=fix, rows=rows)


def _table_parts(views: int) -> Iterator[Mask]:
    """(V,) bool of the rows up to each one, and from each one on."""
    for k in range(1, views):
        yield np.arange(views) < k
        yield np.arange(views) >= k


def _motions_of_same_angle(R_v: Array, R_w: Array, seen: Array) -> Mask:
    """(M,) motions between rotations (M, 3, 3) that turn as far as the scanner did."""
    cosine = (np.einsum("mij,mij->m", R_v, R_w) - 1) / 2
    return np.asarray(np.abs(np.arccos(np.clip(cosine, -1, 1)) - seen) < ROTATION)
