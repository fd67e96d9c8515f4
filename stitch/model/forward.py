"""What a model does to poses and points, both without it as they truly were, and how they answer to its parameters.

Poses and points answer to the parameters of terms by central differences about a model (`pose_derivatives`,
`PointSlopes`). Differences of poses are taken of what an effect does to joints, links, mount and part alone; from there
the chain of frames carries them.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.model.model import ARM_PLACES, Model, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.session.axes import AxisMotion
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement, ScanView
from stitch.session.robot import FlangeSlopes, Links, exact_links, flange_slopes, forward, forward_with_errors

# Step as a share of the plausible size: errors of third order stay far below the noise. A time constant is stepped
# less, since the effect is not linear in it.
STEP, _STEP_GRIDDED = 0.1, 0.005


@dataclass(frozen=True)
class ChainErrors:
    """What effects of base, robot, mount and part do to the chain of frames of V views."""

    joints: Array  # (V, n) rad, as they truly were
    links: Links  # as they truly are
    mount: Array  # (V, 6) twist right of the hand-eye
    part: Array  # (V, 6) twist of the part in the reference frame
    base: Array  # (V, 6) twist of the robot's base in the base frame
    axes: AxisMotion | None = None  # of the external axes, as they truly move


def chain_errors(measurement: Measurement, terms: Sequence[Term], base: ChainErrors | None = None) -> ChainErrors:
    """Return how effects change joint angles, links, mount, part, base and axes of the chain of frames, in all views.

    Args:
        terms: effects with their values.
        base: what others have done already; None: nothing.
    """
    views = measurement.views
    if base is None:
        right = exact_links(*views.joints.shape)
        axes = views.axes.as_read() if views.axes else None
        still = np.zeros((views.count, 6))
        base = ChainErrors(views.joints, right, still, still, still, axes)
    joints, mount, part, axes = base.joints, base.mount, base.part, base.axes
    tilt = base.base
    # A user's own effect may change the links that it is given in place.
    links = Links(*(value.copy() for value in vars(base.links).values()))
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
        elif term.effect.place == "base":
            tilt = tilt + function(views, **arguments)
        elif term.effect.place == "axis":
            axes = function(axes, views, **arguments)
    return ChainErrors(joints, links, mount, part, tilt, axes)


def perturbed_frames(measurement: Measurement, terms: Sequence[Term]) -> tuple[Array, Array]:
    """Return (V, 4, 4) what stands left and right of the hand-eye under effects of base, robot, mount and part."""
    errors = chain_errors(measurement, terms)
    T_base_flange = measurement.T_base_flange
    if any(term.effect.place in ARM_PLACES for term in terms):
        # A reported pose that differs from the nominal kinematics (a calibrated controller) keeps its difference.
        under, true = _under_base(measurement), T_base_flange
        if measurement.robot is not None and measurement.views.has("joints"):
            true = forward_with_errors(measurement.robot, errors.joints, errors.links)
        T_base_flange = under @ frames.exp(errors.base) @ true
    if errors.axes is not None and any(term.effect.place == "axis" for term in terms):
        T_base_flange = measurement.views.axes.correction(errors.axes) @ T_base_flange
    left = frames.inverse(T_base_flange) if measurement.eye_to_hand else T_base_flange
    right, behind = frames.exp(errors.mount), measurement.views.scanners.behind
    return frames.exp(-errors.part) @ left, right if behind is None else behind @ right


def _under_base(measurement: Measurement) -> Array:
    """Return (V, 4, 4) what stands between the frame of the reported poses and the base that carries the arm."""
    if measurement.robot is None or not measurement.views.has("joints"):
        return np.broadcast_to(np.eye(4), measurement.T_base_flange.shape)
    return measurement.T_base_flange @ frames.inverse(forward(measurement.robot, measurement.views.joints))


def scan_correction(
    measurement: Measurement, terms: Sequence[Term], v: int, pose: Array, index: Indices | slice
) -> Array:
    """Return (N, 3) what must be added to the scanned points of view v, scanner frame, to undo sensor and part effects.

    Args:
        pose: (4, 4) T_reference_scanner of the view.
    """
    points, view = scan_points(measurement, v, index)
    return point_correction(terms, points, view, pose)


def scan_points(measurement: Measurement, v: int, index: Indices | slice) -> tuple[Array, ScanView]:
    """Return some points (N, 3) of view v, scanner frame, and what effects may know of them."""
    view = measurement.scan_views[v]
    intensity = None if view.intensity is None else view.intensity[index]
    return measurement.capture.scans[v].points[index], replace(view, cosine=view.cosine[index], intensity=intensity)


def point_correction(terms: Sequence[Term], points: Array, view: ScanView, pose: Array, steps: int = 2) -> Array:
    """Return (N, 3) what must be added to measured points (N, 3) of one view to undo sensor and part effects.

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
    return true - points


def target_correction(
    measurement: Measurement, terms: Sequence[Term], poses: Array, places: Array | None = None
) -> Array:
    """Return (V, S, 3) what must be added to the labelled points of all views to undo sensor and part effects; zero in
    empty slots.

    Args:
        places: (V, S, 3) of the points, as `target_places` finds them under the same effects.
    """
    sightings = measurement.capture.sightings
    assert sightings is not None
    if not moves_points(terms):
        return np.zeros(sightings.points.shape)
    places = target_places(measurement, terms, poses) if places is None else places
    to_sensor = frames.inverse(poses)
    shown = frames.transform(to_sensor, places)
    grown = _displaced("shape", terms, measurement.target_views, places)
    points = shown.copy() if grown is places else frames.transform(to_sensor, grown)
    apart = shown - _displaced("sensor", terms, measurement.target_views, points)
    return np.where((sightings.target >= 0)[..., None], apart, 0.0)


def target_places(measurement: Measurement, terms: Sequence[Term], poses: Array, steps: int = 2) -> Array:
    """Return (V, S, 3) where the targets in the slots of all views lie, reference frame: the mean of the views that use
    each.

    An effect is evaluated there. At a point as it was measured it would hold the error of that point, times the effect,
    and explain the error by itself (errors in variables; Fuller 1987, Measurement Error Models).
    """
    s = measurement.capture.sightings
    assert s is not None
    placed = frames.transform(poses, s.points)
    used = s.used
    blank = s.target.max(axis=1) < 0
    count = np.maximum(s.view_counts, 1)[:, None]
    # An empty slot borrows the first target of its view, a view without any the first of all: its own zero has no ray.
    first = np.maximum(s.target.max(axis=1), 0)
    slots = np.where(s.target >= 0, s.target, first[:, None])

    def mean(points: Array) -> Array:
        sums = np.zeros((len(s.targets), 3))
        np.add.at(sums, s.target[used], points[used])
        out = np.where((s.view_counts[slots] > 0)[..., None], (sums / count)[slots], points)
        return np.where(blank[:, None, None], points[used].mean(axis=0), out)

    places = mean(placed)
    for _ in range(steps if moves_points(terms) else 0):
        correction = target_correction(measurement, terms, poses, places)
        places = mean(placed + frames.rotate(poses, correction))
    return places


def _displaced(place: str, terms: Sequence[Term], views: Sequence[ScanView], points: Array) -> Array:
    """Return points (V, N, 3) of all views where the effects of one place put them, the last effect first."""
    for term in (t for t in reversed(terms) if t.effect.place == place):
        displace = partial(term.effect.function, **term.arguments)
        points = np.array([displace(of_view, view) for of_view, view in zip(points, views, strict=True)])
    return points


def moves_points(terms: Sequence[Term]) -> bool:
    """Return whether an effect changes the points within a view, and not only where the view sits."""
    return any(term.effect.place in ("sensor", "shape") for term in terms)


def true_geometry(measurement: Measurement, model: Model) -> tuple[Array, list[Array]]:
    """Return poses (V, 4, 4) T_reference_scanner, and points (N, 3) of every scan, without the effects of a model."""
    poses = _without_motion(measurement, model.terms).poses(model.T_mount)
    points = [scan.points for scan in measurement.capture.scans]
    if moves_points(model.terms):
        terms = model.terms
        points = [p + scan_correction(measurement, terms, v, poses[v], slice(None)) for v, p in enumerate(points)]
    return poses, points


def corrected_capture(measurement: Measurement, model: Model) -> Capture:
    """Return the capture as it would be without the effects of the model."""
    terms = model.terms
    capture = _without_motion(measurement, terms)
    if moves_points(terms):
        poses, points = true_geometry(measurement, model)
        # Points move by micrometres: normals, edges and spacing stay, the tree must follow.
        moved = zip(capture.scans, points, strict=True)
        scans = tuple(replace(scan, points=p, tree=KDTree(p, leafsize=16)) for scan, p in moved)
        capture = replace(capture, scans=scans)
        if capture.sightings is not None:
            shown = capture.sightings.points + target_correction(measurement, terms, poses)
            capture = replace(capture, sightings=replace(capture.sightings, points=shown))
    return capture


def _without_motion(measurement: Measurement, terms: Sequence[Term]) -> Capture:
    """Return the capture without effects of robot, mount and part; the points as they were scanned."""
    left, right = perturbed_frames(measurement, terms)
    return replace(measurement.capture, T_reference_mount=left, T_behind_mount=right)


def pose_derivatives(measurement: Measurement, model: Model, terms: Sequence[Term], centre: Array) -> Iterator[Array]:
    """Yield per term (P, V, 6) left twists of the views about `centre`, reference frame, per unit of each parameter.

    About the model with the term in place of its own, or added at its values; the view of an event moves nothing.
    """
    chain = None
    in_use = chain_errors(measurement, model.terms)
    for term in terms:
        others = in_use
        if any(used.name == term.name for used in model.terms):
            others = chain_errors(measurement, model.without(term.name).terms)
        errors = chain_errors(measurement, [term], others)
        if chain is None or not chain.is_about(errors):
            chain = _ChainJacobian(measurement, model.with_term(term), errors, frames.make(np.eye(3), -centre))
        derivatives = np.zeros((len(term.parameters), measurement.views.count, 6))
        sizes = [(_STEP_GRIDDED if p.grid else STEP) * p.typical for p in term.parameters]
        fitted = [i for i, p in enumerate(term.parameters) if not p.discrete]
        steps = [[chain_errors(measurement, [moved], others) for moved in _stepped(term, i, sizes[i])] for i in fitted]
        if steps:
            twists = chain.twists(steps, term.effect.place)
            derivatives[fitted] = twists / (2 * np.array(sizes)[fitted, None, None])
        yield derivatives


@dataclass(frozen=True)
class _ChainJacobian:
    """How the views answer to small errors of the chain of frames, about those of a model."""

    measurement: Measurement
    about: Model
    errors: ChainErrors
    to_centre: Array  # (4, 4)

    def is_about(self, errors: ChainErrors) -> bool:
        """Return whether errors are those of this model: of the same effects, summed in another order, they are."""
        arrays, others = (
            (e.joints, *vars(e.links).values(), e.mount, e.part, e.base, *(vars(e.axes).values() if e.axes else ()))
            for e in (self.errors, errors)
        )
        pairs = zip(arrays, others, strict=True)
        return all(np.array_equal(a, b) or np.allclose(a, b, rtol=1e-12, atol=0.0) for a, b in pairs)

    def twists(self, steps: Sequence[Sequence[ChainErrors]], place: str) -> Array:
        """Return (P, V, 6) left twists of the views between the two errors of each step, near these.

        Args:
            place: in the chain, of what was stepped.
        """
        if place == "axis":
            carried = self.measurement.views.axes.carried
            moved = [frames.log(carried(up.axes) @ frames.inverse(carried(down.axes))) for up, down in steps]
            return _apply_matrices(self.of_axes, np.array(moved))
        if place == "base":
            return _apply_matrices(self.of_base, np.array([up.base - down.base for up, down in steps]))
        if place in ARM_PLACES and self.measurement.robot is not None:
            moved = []
            for up, down in steps:
                links = {name: value - getattr(down.links, name) for name, value in vars(up.links).items()}
                moved.append(self.flange.twists(up.joints - down.joints, Links(**links)))
            return _apply_matrices(self.of_flange, np.array(moved))
        mount = np.array([up.mount - down.mount for up, down in steps])
        part = np.array([up.part - down.part for up, down in steps])
        of_part = _apply_matrices(self.of_part, part) if part.any() else part
        return of_part + _apply_matrices(self.of_mount, mount) if mount.any() else of_part

    @cached_property
    def flange(self) -> FlangeSlopes:
        """Body twists of the flange."""
        assert self.measurement.robot is not None
        return flange_slopes(self.measurement.robot, self.errors.joints, self.errors.links)

    @cached_property
    def of_flange(self) -> Array:
        """(V, 6, 6) for body twists of the flange."""
        if self.measurement.eye_to_hand:
            # (T·exp ξ)⁻¹ = exp(−ξ)·T⁻¹: the flange's own side stands left.
            return -frames.adjoint(self.to_centre @ frames.exp(-self.errors.part))
        return frames.adjoint(self._left)

    @cached_property
    def of_base(self) -> Array:
        """(V, 6, 6) for changes of the twist of the base, which external axes may carry."""
        under = frames.adjoint(_under_base(self.measurement))
        return self.of_axes @ under @ frames.left_jacobian(self.errors.base)

    @cached_property
    def of_axes(self) -> Array:
        """(V, 6, 6) for twists left of the flange's effective pose."""
        if self.measurement.eye_to_hand:
            return -frames.adjoint(self._left)
        return frames.adjoint(self.to_centre @ frames.exp(-self.errors.part))

    @cached_property
    def of_mount(self) -> Array:
        """(V, 6, 6) for changes of the twist of the mount: exp(m + δ) = exp(J δ)·exp(m)."""
        behind = self.measurement.views.scanners.behind
        T_mount = self.about.T_mount if behind is None else self.about.T_mount @ behind
        return frames.adjoint(self._left @ T_mount) @ frames.left_jacobian(self.errors.mount)

    @cached_property
    def of_part(self) -> Array:
        """(V, 6, 6) for changes of the twist of the part."""
        return -(frames.adjoint(self.to_centre) @ frames.left_jacobian(-self.errors.part))

    @cached_property
    def _left(self) -> Array:
        """Return (V, 4, 4) what stands left of the hand-eye, about the centre."""
        return self.to_centre @ perturbed_frames(self.measurement, self.about.terms)[0]


def _apply_matrices(matrix: Array, vectors: Array) -> Array:
    """Return (P, V, 6) of (V, 6, 6) and (P, V, 6)."""
    return (matrix @ vectors.transpose(1, 2, 0)).transpose(2, 0, 1)


@dataclass(frozen=True)
class PointSlopes:
    """What must be added to measured points, per unit of each of the terms' P parameters: scanner frame.

    About the model with each term in place of its own, or added at its values.
    """

    measurement: Measurement
    terms: Sequence[Term] = ()
    model: Model | None = None  # None: without terms

    def at(self, v: int, pose: Array, index: Indices | slice) -> Array:
        """Return (P, N, 3) for some points of view v, which stands at `pose` (4, 4) T_reference_scanner."""
        points, view = scan_points(self.measurement, v, index)
        return self._differences(lambda terms: point_correction(terms, points, view, pose, steps=1))

    def at_targets(self, poses: Array) -> Array:
        """Return (P, V, S, 3) for the labelled points of all views."""
        places = target_places(self.measurement, () if self.model is None else self.model.terms, poses)
        return self._differences(lambda terms: target_correction(self.measurement, terms, poses, places))

    def _differences(self, moved: Callable[[Sequence[Term]], Array]) -> Array:
        if not self._steps:
            return moved(())[None][:0]
        return np.array([(moved(up) - moved(down)) / width for up, down, width in self._steps])

    @cached_property
    def _steps(self) -> list[tuple[tuple[Term, ...], tuple[Term, ...], float]]:
        """The effects of the model with one parameter larger and smaller, and how far these are apart."""
        steps = []
        for term in self.terms:
            assert self.model is not None
            for i, parameter in enumerate(term.parameters):
                # The view of an event is tried, never fitted: nothing answers to it.
                size = 0.0 if parameter.discrete else STEP * parameter.typical
                up, down = (self.model.with_term(moved).terms for moved in _stepped(term, i, size))
                steps.append((up, down, 2 * size or 1.0))
        return steps


def _stepped(term: Term, i: int, size: float) -> tuple[Term, Term]:
    """Return the term with parameter i larger and smaller by a step."""
    step = np.zeros(len(term.parameters))
    step[i] = size
    return term.at(term.values + step), term.at(term.values - step)
