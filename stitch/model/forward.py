"""Effects taken out again: poses and points as they truly were."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pykdtree.kdtree import KDTree

from stitch import frames
from stitch.effects.arm import Links
from stitch.frames import Array, Indices
from stitch.measurement import robot as kinematics
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement, Term
from stitch.measurement.scan import Scan
from stitch.measurement.views import ScanView


def placed(measurement: Measurement, terms: Sequence[Term]) -> tuple[Array, Array]:
    """(V, 4, 4) what stands left of the hand-eye and right of it under effects of robot, mount and part."""
    views = measurement.views
    joints = views.joints
    count, n = joints.shape
    links = Links(np.ones(count), *np.zeros((3, n)))
    mount, part = np.zeros((2, count, 6))
    moved = False
    for term in terms:
        arguments = measurement.arguments(term.effect, term.values)
        if term.effect.place == "robot":
            # The function adds to what it is given; what it reads of the pose are the reported angles.
            joints, moved = term.effect.function(joints, views, **arguments), True
        elif term.effect.place == "links":
            links, moved = term.effect.function(links, views, **arguments), True
        elif term.effect.place == "mount":
            mount = mount + term.effect.function(views, **arguments)
        elif term.effect.place == "part":
            part = part + term.effect.function(views, **arguments)
    T_base_flange = measurement.T_base_flange
    if moved and measurement.robot is not None:
        true = kinematics.forward_with_errors(measurement.robot, joints, links.scale, links.da, links.dd, links.dalpha)
        # A reported pose that differs from the nominal kinematics (a calibrated controller) keeps its difference.
        T_base_flange = T_base_flange @ frames.inverse(kinematics.forward(measurement.robot, views.joints)) @ true
    left = frames.inverse(T_base_flange) if measurement.eye_to_hand else T_base_flange
    return np.asarray(frames.exp(-part) @ left), np.asarray(frames.exp(mount))


def shift(measurement: Measurement, terms: Sequence[Term], v: int, pose: Array, index: Indices | slice) -> Array:
    """(N, 3) what must be added to the scanned points of view v, scanner frame, to undo sensor and part effects.

    Args:
        pose: (4, 4) T_reference_scanner of the view.
    """
    view = measurement.scan_views[v]
    view = replace(view, cosine=view.cosine[index],
                   intensity=None if view.intensity is None else view.intensity[index])  # fmt: skip
    return undone(measurement, terms, measurement.capture.scans[v].points[index], view, pose)


def undone(measurement: Measurement, terms: Sequence[Term], points: Array, view: ScanView, pose: Array) -> Array:
    """(N, 3) what must be added to measured points (N, 3) of one view to undo sensor and part effects."""
    true = points
    for term in (t for t in terms if t.effect.place == "sensor"):
        # Corrections are thousandths of the range: one fixed-point step leaves millionths.
        first = true - (term.effect.function(true, view, **measurement.arguments(term.effect, term.values)) - true)
        true = true - (term.effect.function(first, view, **measurement.arguments(term.effect, term.values)) - first)
    for term in (t for t in terms if t.effect.place == "shape"):
        placed_points = frames.transform(pose, true)
        arguments = measurement.arguments(term.effect, term.values)
        moved = term.effect.function(placed_points, view, **arguments) - placed_points
        true = true - frames.rotate(frames.inverse(pose), moved)
    return np.asarray(true - points)


def shift_targets(measurement: Measurement, terms: Sequence[Term], poses: Array) -> Array:
    """(V, S, 3) the same as `shift` for the labelled points of all views; zero in empty slots."""
    sightings = measurement.capture.sightings
    assert sightings is not None
    if not any(term.effect.place in ("sensor", "shape") for term in terms):
        return np.zeros(sightings.points.shape)
    # An empty slot borrows a point: its own zero has no ray.
    first = sightings.points[np.arange(len(poses)), (sightings.target >= 0).argmax(axis=1)]
    filled = np.where((sightings.target >= 0)[..., None], sightings.points, first[:, None])
    blank = ~(sightings.target >= 0).any(axis=1)
    filled[blank] = filled[~blank].mean(axis=0)
    moved = [undone(measurement, terms, filled[v], view, poses[v]) for v, view in enumerate(measurement.target_views)]
    return np.where((sightings.target >= 0)[..., None], np.array(moved), 0.0)


def corrected(measurement: Measurement, terms: Sequence[Term], T_mount: Array) -> Capture:
    """The capture as it would be without the effects in `terms`."""
    left, right = placed(measurement, terms)
    capture = replace(measurement.capture, T_reference_mount=left, T_behind_mount=right)
    if any(term.effect.place in ("sensor", "shape") for term in terms):
        poses = capture.poses(T_mount)
        scans = [
            _moved(scan, shift(measurement, terms, v, poses[v], slice(None))) for v, scan in enumerate(capture.scans)
        ]
        capture = replace(capture, scans=tuple(scans))
        if capture.sightings is not None:
            points = capture.sightings.points + shift_targets(measurement, terms, poses)
            capture = replace(capture, sightings=replace(capture.sightings, points=points))
    return capture


def _moved(scan: Scan, by: Array) -> Scan:
    """Points moved by micrometres: normals, edges and spacing stay, the tree must follow."""
    points = scan.points + by
    return replace(scan, points=points, tree=KDTree(points, leafsize=16))
