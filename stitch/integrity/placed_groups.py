"""Groups of views that link each other but not the others, placed as one scan each: they share what displaces them.

Of such a group each view alone may show too little of the others, or close in a wrong place; all of it closes in one.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pykdtree.kdtree import KDTree

from stitch import frames
from stitch.frames import Array
from stitch.integrity.linkage import Linkage
from stitch.integrity.placing import (
    Placement,
    ReferenceSurface,
    evaluate_placement,
    place_scan,
    starts_about,
    surface_of,
)
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.match import sample_points

# Points of each view that stand for it in its group.
_GROUP_PROBES = 600
# What shows less than this share of the surface cannot be seen to belong there.
FEW_SHARED = 0.1


def place_groups(capture: Capture, poses: Array, linked: Linkage, limits: tuple[float, float]) -> dict[int, Placement]:
    """Where the views of groups outside the core belong, each group moved as a whole; the core grows with them.

    Args:
        poses: (V, 4, 4) T_reference_scanner at which the views of each group fit together.
        limits: distance from the surface that still lies on it, length_unit, and the closure needed.
    """
    (tolerance, needed), size = limits, part_size([capture])
    core, placed = list(linked.core), dict[int, Placement]()
    for group in (part for part in linked.components[1:] if len(part) > 1):
        surface = surface_of(capture.scans, poses, core, tolerance)
        scan = _merge_scans(capture.scans, poses, group)
        found = place_scan(scan, surface, starts_about(np.eye(4), scan, size), size)
        closed = [p for p in found if _group_closes(scan, p.T, surface, needed)]
        if not closed:
            continue
        # A part may look alike from several sides: of the places in which the group closes, the nearest.
        T = min(closed, key=lambda p: _rms_displacement(scan, p.T)).T
        placed |= {v: evaluate_placement(capture.scans[v], T @ poses[v], surface) for v in group}
        core += group
        poses = np.array([T @ pose if v in group else pose for v, pose in enumerate(poses)])
    return placed


def _merge_scans(scans: Sequence[Scan], poses: Array, group: Sequence[int]) -> Scan:
    """Some points of all views of a group as one scan in the reference frame."""
    picked = {v: sample_points(scans[v], _GROUP_PROBES) for v in group}
    points = np.concatenate([frames.transform(poses[v], scans[v].points[picked[v]]) for v in group])
    return replace(
        scans[group[0]],
        points=points,
        normals=np.concatenate([frames.rotate(poses[v], scans[v].normals[picked[v]]) for v in group]),
        usable=np.ones(len(points), bool),
        area=np.concatenate([scans[v].area[picked[v]] for v in group]),
        confidence=np.concatenate([scans[v].confidence[picked[v]] for v in group]),
        tree=KDTree(points, leafsize=16),
    )


def _group_closes(scan: Scan, T: Array, surface: ReferenceSurface, needed: float) -> bool:
    """True if enough of what faces the surface lies on it.

    Halves of a session may show the two sides of a thin wall: there what is near and faces the other way says nothing.
    """
    residual, _, meets = surface.meets(T[None], scan.points, scan.normals, surface.near)
    on = meets & (np.abs(residual) < surface.tolerance)
    return bool(meets.mean() > FEW_SHARED and on.sum() > needed * meets.sum())


def _rms_displacement(scan: Scan, T: Array) -> float:
    """How far a motion (4, 4) carries the points of a scan, rms."""
    return float(np.sqrt(np.mean(np.sum((frames.transform(T, scan.points) - scan.points) ** 2, axis=1))))
