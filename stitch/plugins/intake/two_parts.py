"""Two parts, or one that changed its shape: two groups of scans that show the same surface at two places.

The poses fit, since the scans of either group lie on each other; what one group shows the other shows elsewhere.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.observations.surfaces.matching import sample_points
from stitch.plugins.intake.convention_choice import ConventionScore
from stitch.plugins.intake.refusals import Refusal
from stitch.screening.linkage import CONTRADICTS, linkage_of_pairs, points_in_place
from stitch.session.capture import Capture, part_size

# Views of a group.
_FEWEST_VIEWS = 3
# Two scans lie on each other where half of the points of either, on average, lie within this share of the part's size
# of the other; elsewhere is farther than so many times this, within reach.
_ON, _NEAR, _CLOSE, _REACH = 0.5, 0.01, 3.0, 0.1
# Points of a scan that are asked, and scans before and behind it in the list that they are held against.
_ASKED, _NEIGHBOURS = 300, 4

Groups = tuple[tuple[int, ...], tuple[int, ...], float]


def groups_apart(capture: Capture, best: ConventionScore) -> Groups | None:
    """Return two groups of views that lie on each other within each alone, or None.

    With them, of what either shows about the other's surface, the share that it shows elsewhere.
    """
    used = best.interpretation.pairing.used
    poses = best.interpretation.hypothesis(0).T_reference_mount @ best.T_mount
    pairs = [(v, w) for v in used for w in used if v != w and abs(v - w) <= _NEIGHBOURS]
    near, reach = part_size([capture]) * np.array([_NEAR, _REACH])
    on, elsewhere = np.zeros((2, len(poses), len(poses)))
    for v, w in pairs if len(used) >= 2 * _FEWEST_VIEWS else ():
        asked = sample_points(capture.scans[v], _ASKED)
        T = frames.inverse(poses[w]) @ poses[v]
        points = frames.transform(T, capture.scans[v].points[asked])
        normals = frames.rotate(T, capture.scans[v].normals[asked])
        there, close, about = (
            points_in_place(capture.scans[w], points, normals, away) for away in (near, _CLOSE * near, reach)
        )
        on[v, w] = there.mean()
        elsewhere[v, w] = (about & ~close).sum() / max(about.sum(), 1)
    linked = linkage_of_pairs(len(poses), [(v, w) for v, w in pairs if on[v, w] + on[w, v] >= 2 * _ON])
    first, second = (*linked.components, ())[:2]
    between = [max(elsewhere[v, w], elsewhere[w, v]) for v, w in pairs if v in first and w in second]
    return (first, second, float(np.median(between))) if len(second) >= _FEWEST_VIEWS and between else None


def require_one_part(clouds: Sequence[Path], groups: Groups, best: ConventionScore, kept: Sequence[int]) -> None:
    """Refuse scans of two groups that show the same surface at two places.

    Args:
        clouds: of the folder, in the order of their names.
        best: poses that fit.
        kept: numbers of the views among the clouds.

    Raises:
        InputError: names the scans of either group.
    """
    *sides, share = groups
    if share < CONTRADICTS:
        return
    first, second = (", ".join(clouds[kept[i]].name for i in side) for side in sides)
    told = (
        f"{clouds[0].parent}: two parts, or one that changed its shape: {first} lie on each other, and so do {second}; "
        f"{share:.0%} of the surface that either group shows of the other's it shows elsewhere"
    )
    later = np.isin(np.arange(len(kept)), sides[1])
    raise Refusal(told, *best.interpretation.pairing.one_session_each(kept, len(clouds), later))
