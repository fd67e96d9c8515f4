"""What a model does to poses and points, and both without it: as they truly were."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pykdtree.kdtree import KDTree

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.imperfect_arm import Links, exact_links, forward_with_errors
from stitch.measurement.measurement import Measurement
from stitch.measurement.robot import forward
from stitch.measurement.scan import Scan
from stitch.measurement.views import ScanView
from stitch.model.model import Model
from stitch.model.term import Term


@dataclass(frozen=True)
class ChainErrors:
    """What effects of robot, mount and part do to the chain of frames of V views."""

    joints: Array  # (V, n) rad, as they truly were
    links: Links  # as they truly are
    mount: Array  # (V, 6) twist right of the hand-eye
    part: Array  # (V, 6) twist of the part in the reference frame


def chain_errors(measurement: Measurement, terms: Sequence[Term], base: ChainErrors | None = None) -> ChainErrors:
    """Collect what some effects do to the chain of frames, beside what others have done already."""
    views = measurement.views
    if base is None:
        right = exact_links(*views.joints.shape)
        base = ChainErrors(views.joints, right, np.zeros((views.count, 6)), np.zeros((views.count, 6)))
    joints, mount, part = base.joints, base.mount, base.part
    # A user's own effect may change the links that it is given in place.
    links = Links(*(own.copy() for own in vars(base.links).values()))
    for term in terms:
        function, arguments = term.effect.function, term.arguments
        # The function adds to what it is given; what it reads of the pose are the reported angles.
        if term.effect.place == "robot":
            joints = function(joints, views, **arguments)
        elif term.effect.place == "links":
            links = function(links, views, **arguments)
        elif term.effect.place == "mount":
            mount = mount + function(views, **arguments)
        elif term.effect.place == "part":
            part = part + function(views, **arguments)
    return ChainErrors(joints, links, mount, part)


def perturbed_frames(measurement: Measurement, terms: Sequence[Term]) -> tuple[Array, Array]:
    """(V, 4, 4) what stands left of the hand-eye and right of it under effects of robot, mount and part."""
    errors = chain_errors(measurement, terms)
    T_base_flange = measurement.T_base_flange
    if measurement.robot is not None and any(moves_arm(term) for term in terms):
        true = forward_with_errors(measurement.robot, errors.joints, errors.links)
        # A reported pose that differs from the nominal kinematics (a calibrated controller) keeps its difference.
        T_base_flange = T_base_flange @ frames.inverse(forward(measurement.robot, measurement.views.joints)) @ true
    left = frames.inverse(T_base_flange) if measurement.eye_to_hand else T_base_flange
    return np.asarray(frames.exp(-errors.part) @ left), np.asarray(frames.exp(errors.mount))


def moves_arm(term: Term) -> bool:
    """True for an effect of joints or links."""
    return term.effect.place in ("robot", "links")


def scan_correction(
    measurement: Measurement, terms: Sequence[Term], v: int, pose: Array, index: Indices | slice
) -> Array:
    """(N, 3) what must be added to the scanned points of view v, scanner frame, to undo sensor and part effects.

    Args:
        pose: (4, 4) T_reference_scanner of the view.
    """
    points, view = scan_points(measurement, v, index)
    return point_correction(terms, points, view, pose)


def scan_points(measurement: Measurement, v: int, index: Indices | slice) -> tuple[Array, ScanView]:
    """Some points (N, 3) of view v, scanner frame, and what effects may know of them."""
    view = measurement.scan_views[v]
    intensity = None if view.intensity is None else view.intensity[index]
    return measurement.capture.scans[v].points[index], replace(view, cosine=view.cosine[index], intensity=intensity)


def point_correction(terms: Sequence[Term], points: Array, view: ScanView, pose: Array, steps: int = 2) -> Array:
    """(N, 3) what must be added to measured points (N, 3) of one view to undo sensor and part effects.

    Args:
        steps: of fixed point. Corrections are thousandths of the range: the first leaves thousandths of them, which is
            enough for a slope, the second millionths.
    """
    true = points
    for term in (t for t in terms if t.effect.place == "sensor"):
        arguments, reported = term.arguments, true
        for _ in range(steps):
            true = reported - (term.effect.function(true, view, **arguments) - true)
    for term in (t for t in terms if t.effect.place == "shape"):
        in_reference = frames.transform(pose, true)
        moved = term.effect.function(in_reference, view, **term.arguments) - in_reference
        true = true - frames.rotate(frames.inverse(pose), moved)
    return np.asarray(true - points)


def target_correction(measurement: Measurement, terms: Sequence[Term], poses: Array) -> Array:
    """(V, S, 3) the same as `shift` for the labelled points of all views; zero in empty slots."""
    sightings = measurement.capture.sightings
    assert sightings is not None
    if not moves_points(terms):
        return np.zeros(sightings.points.shape)
    # An empty slot borrows a point: its own zero has no ray.
    first = sightings.points[np.arange(len(poses)), (sightings.target >= 0).argmax(axis=1)]
    filled = np.where((sightings.target >= 0)[..., None], sightings.points, first[:, None])
    blank = ~(sightings.target >= 0).any(axis=1)
    filled[blank] = filled[~blank].mean(axis=0)
    moved = [point_correction(terms, filled[v], view, poses[v]) for v, view in enumerate(measurement.target_views)]
    return np.where((sightings.target >= 0)[..., None], np.array(moved), 0.0)


def moves_points(terms: Sequence[Term]) -> bool:
    """True if an effect changes the points within a view, and not only where the view sits."""
    return any(term.effect.place in ("sensor", "shape") for term in terms)


def true_geometry(measurement: Measurement, model: Model) -> tuple[Array, list[Array]]:
    """Poses (V, 4, 4) T_reference_scanner, and points (N, 3) of every scan, without the effects of a model."""
    capture, points = _without_motion(measurement, model.terms), [scan.points for scan in measurement.capture.scans]
    poses, every = capture.poses(model.T_mount), slice(None)
    if moves_points(model.terms):
        points = [p + scan_correction(measurement, model.terms, v, poses[v], every) for v, p in enumerate(points)]
    return poses, points


def corrected_capture(measurement: Measurement, model: Model) -> Capture:
    """The capture as it would be without the effects of the model."""
    terms = model.terms
    capture = _without_motion(measurement, terms)
    if moves_points(terms):
        poses, points = true_geometry(measurement, model)
        scans = [_with_points(scan, p) for scan, p in zip(capture.scans, points, strict=True)]
        capture = replace(capture, scans=tuple(scans))
        if capture.sightings is not None:
            shown = capture.sightings.points + target_correction(measurement, terms, poses)
            capture = replace(capture, sightings=replace(capture.sightings, points=shown))
    return capture


def _without_motion(measurement: Measurement, terms: Sequence[Term]) -> Capture:
    """The capture without effects of robot, mount and part; the points as they were scanned."""
    left, right = perturbed_frames(measurement, terms)
    return replace(measurement.capture, T_reference_mount=left, T_behind_mount=right)


def _with_points(scan: Scan, points: Array) -> Scan:
    """Points moved by micrometres: normals, edges and spacing stay, the tree must follow."""
    return replace(scan, points=points, tree=KDTree(points, leafsize=16))
