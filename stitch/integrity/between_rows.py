"""Poses of half a step before or after the scans: each midway between its own row's and the previous or next one's.

A motion between scans is halved as a screw, and so the motions between poses that were stated follow from it; the
hand-eye under which they do puts every pose back by half a motion. Programs that interpolate turn evenly and move the
flange along a line: then its positions are found from the motions, since one of them tells all others.
"""

from collections.abc import Iterator

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.fitted_positions import fit_positions
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.motion_fit import FEWEST, fit_motions
from stitch.integrity.relative_scans import RelativeScans

_FIX = (
    "every pose stands half a row {} its scan: midway between the poses of this scan and the {} one, as if it had been "
    "interpolated to another time: pair scans and poses by their own times"
)
_WORDS = {1: ("after", "next"), -1: ("before", "previous")}


def poses_between_rows(stated: Hypothesis, motions: RelativeScans, length: float) -> Iterator[Hypothesis]:
    """The poses that these would be midway between.

    Args:
        length: what a motion may leave open, length_unit.
    """
    steps = {v: frames.log(motions.T[i]) for i, (v, w) in enumerate(motions.pairs) if w == v + 1}
    for ahead in (1, -1):
        # Half the motion from a row to its neighbour.
        half = {
            v: 0.5 * ahead * steps[min(v, v + ahead)]
            for v in range(len(stated.T_base_flange))
            if min(v, v + ahead) in steps
        }
        pairs = tuple((v, v + 1) for v in half if v + 1 in half and v in steps)
        if len(pairs) < FEWEST:
            continue
        seen = np.array([frames.exp(-half[v]) @ frames.exp(steps[v]) @ frames.exp(half[w]) for v, w in pairs])
        X = fit_motions(stated, RelativeScans(pairs, seen), length).T_mount
        used = tuple(sorted(half))
        T = np.array(stated.T_reference_mount)
        for v in used:
            T[v] = T[v] @ X @ frames.exp(-half[v]) @ frames.inverse(X)
        fix = _FIX.format(*_WORDS[ahead])
        turned = T if stated.mount == "eye_in_hand" else frames.inverse(T)
        along = _positions_along_lines(stated, turned, motions, (ahead, used), X)
        for poses in (turned, frames.make(turned[:, :3, :3], along)):
            yield Hypothesis("shifted", poses, stated.mount, fix, (), used)


def _positions_along_lines(
    stated: Hypothesis, turned: Array, motions: RelativeScans, rows: tuple[int, tuple[int, ...]], T_mount: Array
) -> Array:
    """(V, 3) positions of which those stated are the middles."""
    ahead, used = rows
    middle, views = stated.T_base_flange[:, :3, 3], len(turned)
    p, Q = np.zeros((views, 3)), np.tile(np.eye(3), (views, 1, 1))
    for v in range(1, views):
        p[v], Q[v] = 2 * middle[v - 1 if ahead > 0 else v] - p[v - 1], -Q[v - 1]
    return fit_positions(turned[:, :3, :3], (p, Q), stated.mount, motions, used, T_mount[:3, :3])
