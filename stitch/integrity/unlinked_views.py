"""Views outside the largest component, tried wide: where on the surface of the linked ones they belong, if anywhere."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.linkage import HOLDING, Linkage
from stitch.integrity.placed_groups import FEW_SHARED, place_groups
from stitch.integrity.placing import (
    Placement,
    evaluate_placement,
    place_scan,
    shows_no_surface,
    starts_about,
    starts_anywhere,
    surface_of,
)
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.free_poses import UnconstrainedPoses

# A placement is right if at least this share of what linked views have on the others' surface lies on it. Right ones
# have 0.9 to 1 of it, scans of other parts up to 0.35, scaled by 2.5 % up to 0.7.
_ACCEPTED_CLOSURE = 0.8
# A placement at some row's very pose is believed sooner: by chance none lies there. Other parts still do not reach it.
_CLOSURE_AT_ROW = 0.75
CLOSE_SHARE = 0.03  # of the part's size
_NEAR_GATE = 0.2


def needed_closure(capture: Capture, poses: Array, linked: Linkage, tolerance: float) -> float:
    """Share of a scan on the surface of the others at which it counts as placed."""
    compared = linked.unlinked and len(linked.core) > 1
    return _ACCEPTED_CLOSURE * _usual_closure(capture, poses, linked.core, tolerance) if compared else _ACCEPTED_CLOSURE


def place_unlinked_views(
    capture: Capture,
    model_poses: Array,
    unconstrained: UnconstrainedPoses,
    linked: Linkage,
    limits: tuple[float, float],
) -> tuple[dict[int, Placement], list[int]]:
    """Where the views outside the core belong, and those that belong nowhere; the core grows as they are placed.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        limits: distance from the surface that still lies on it, length_unit, and the closure needed.
    """
    if not linked.unlinked or len(linked.core) < 2:
        return {}, list(linked.unlinked)
    (tolerance, needed), size, poses = limits, part_size([capture]), np.array(unconstrained.poses)
    placed = place_groups(capture, poses, linked, limits)
    for v, placement in placed.items():
        poses[v] = placement.T
    alone = [v for v in linked.unlinked if v not in placed]
    core, waiting = [*linked.core, *placed], alone
    while waiting:
        surface = surface_of(capture.scans, poses, core, tolerance)
        new = {}
        for v in waiting:
            scan = capture.scans[v]
            if shows_no_surface(scan):
                continue
            starts = [starts_about(model_poses[v], scan, size), model_poses, starts_anywhere(surface, scan)]
            found = place_scan(scan, surface, np.concatenate(starts), size)
            # A part clamped anew lies near: a wide gate would lead past it.
            found += place_scan(scan, surface, model_poses[v][None], _NEAR_GATE * size)
            shared = max(FEW_SHARED, HOLDING / scan.usable.sum())
            best = _likeliest_placement(scan, [p for p in found if p.near > shared], model_poses, (needed, size))
            if best is not None:
                new[v] = best
        if not new:
            break
        for v, placement in new.items():
            poses[v] = placement.T
        placed |= new
        core += list(new)
        waiting = [v for v in waiting if v not in new]
    unsure = {v for v in set(alone) & set(placed) if _placement_is_unsure(capture, linked, model_poses, v, placed[v])}
    return {v: at for v, at in placed.items() if v not in unsure}, sorted([*waiting, *unsure])


def _placement_is_unsure(capture: Capture, linked: Linkage, model_poses: Array, view: int, placed: Placement) -> bool:
    """True for a view of a group that was placed alone, and at no row's pose.

    What displaces the views of a group they share: where all of them together closed nowhere, each of them may still
    close where the part looks alike.
    """
    in_group = any(view in group and len(group) > 1 for group in linked.components[1:])
    far = _distances_from_rows(capture.scans[view], [placed], model_poses)[0] > CLOSE_SHARE * part_size([capture])
    return in_group and far


def _likeliest_placement(
    scan: Scan, found: Sequence[Placement], model_poses: Array, limits: tuple[float, float]
) -> Placement | None:
    """Of the placements that close the one nearest to any row's pose: a part may look alike from several sides."""
    needed, size = limits
    away = _distances_from_rows(scan, found, model_poses)
    limit = [needed * (_CLOSURE_AT_ROW if a < CLOSE_SHARE * size else 1.0) for a in away]
    closed = [i for i, p in enumerate(found) if p.closure > limit[i]]
    return found[min(closed, key=lambda i: away[i])] if closed else None


def _distances_from_rows(scan: Scan, found: Sequence[Placement], model_poses: Array) -> list[float]:
    """How far each placement is from the nearest row's pose, rms of the points."""
    points = scan.points[::50]
    rows = frames.transform(model_poses, points)
    return [float(np.sqrt(((rows - frames.transform(p.T, points)) ** 2).sum(axis=2).mean(axis=1)).min()) for p in found]


def _usual_closure(capture: Capture, poses: Array, core: Sequence[int], tolerance: float) -> float:
    """Median closure of linked views on the surface of the other ones."""
    some = core[:: max(len(core) // 6, 1)]
    closures = [
        evaluate_placement(
            capture.scans[v], poses[v], surface_of(capture.scans, poses, [w for w in core if w != v], tolerance)
        ).closure
        for v in some
    ]
    return float(np.median(closures))
