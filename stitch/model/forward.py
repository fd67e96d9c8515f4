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
from stitch.session.capture import Capture, Sightings
from stitch.session.measurement import Measurement, ScanView
from stitch.session.robot import FlangeSlopes, Links, exact_links, flange_slopes, forward, forward_with_errors

# Steps of central differences, as shares of a parameter's plausible size: errors of third order stay far below the
# noise. A parameter with a grid, as a time constant, is stepped less, since the effect is not linear in it.
STEP, _STEP_GRIDDED = 0.1, 0.005
# What of the chain the effects of a place change, and places whose effects add a twist to the chain's own.
_CHANGED, _DISPLACED = {"robot": "joints", "links": "links", "axis": "axes"}, ("base", "mount", "part")


@dataclass(frozen=True)
class TrueChain:
    """The true chain of frames of V views: what effects of base, robot, links, mount, part and axes make of it."""

    joints: Array  # (V, n) rad, the true angles
    links: Links  # the true ones
    mount: Array  # (V, 6) twist to the right of the hand-eye: T_mount · exp(mount)
    part: Array  # (V, 6) twist of the part in the reference frame
    base: Array  # (V, 6) twist of the robot's base in the base frame
    axes: AxisMotion | None = None  # of the external axes, as they truly move


def true_chain(measurement: Measurement, terms: Sequence[Term], base: TrueChain | None = None) -> TrueChain:
    """Return the true chain of frames of all views under effects.

    Args:
        terms: effects with their values, applied in this order.
        base: the chain under other effects, to which these are added; None: the reported chain.
    """
    views = measurement.views
    if base is None:
        exact = exact_links(*views.joints.shape)
        axes = views.axes.as_read() if views.axes else None
        none = np.zeros((views.count, 6))
        base = TrueChain(views.joints, exact, none, none, none, axes)
    chain = base
    for term in terms:
        place, function, arguments = term.effect.place, term.effect.function, term.arguments
        if place in _CHANGED:
            # The function adds to what it is given; what it reads of the pose are the reported angles.
            name = _CHANGED[place]
            given = getattr(chain, name)
            # Copied, since a user's own effect may change the links that it is given.
            own = Links(*(value.copy() for value in vars(given).values())) if place == "links" else given
            chain = replace(chain, **{name: function(own, views, **arguments)})
        elif place in _DISPLACED:
            chain = replace(chain, **{place: getattr(chain, place) + function(views, **arguments)})
    return chain


def perturbed_frames(measurement: Measurement, terms: Sequence[Term]) -> tuple[Array, Array]:
    """Return L and R (V, 4, 4) of T_reference_scanner = L · T_mount · R under effects of base, robot, mount and part.

    L is exp(−part) · T_reference_mount with the true arm and axes; R is exp(mount), behind the place of the view's
    scanner if there are several.
    """
    chain = true_chain(measurement, terms)
    T_base_flange = measurement.T_base_flange
    if any(term.effect.place in ARM_PLACES for term in terms):
        true_arm = T_base_flange
        if measurement.robot is not None and measurement.views.has("joints"):
            true_arm = forward_with_errors(measurement.robot, chain.joints, chain.links)
        T_base_flange = _under_base(measurement) @ frames.exp(chain.base) @ true_arm
    if chain.axes is not None and any(term.effect.place == "axis" for term in terms):
        T_base_flange = measurement.views.axes.correction(chain.axes) @ T_base_flange
    left = frames.inverse(T_base_flange) if measurement.eye_to_hand else T_base_flange
    right, behind = frames.exp(chain.mount), measurement.views.scanners.behind
    return frames.exp(-chain.part) @ left, right if behind is None else behind @ right


def _under_base(measurement: Measurement) -> Array:
    """Return U (V, 4, 4) with T_base_flange = U · forward(reported joints): reported poses against nominal ones.

    It holds external axes that carry the robot, and what a calibrated controller knows of its arm. 1 without joints.
    """
    if measurement.robot is None or not measurement.views.has("joints"):
        return np.broadcast_to(np.eye(4), measurement.T_base_flange.shape)
    return measurement.T_base_flange @ frames.inverse(forward(measurement.robot, measurement.views.joints))


def scan_correction(
    measurement: Measurement, terms: Sequence[Term], v: int, pose: Array, index: Indices | slice
) -> Array:
    """Return vectors (N, 3), scanner frame, that added to scanned points of view v undo effects of sensor and shape.

    Args:
        pose: (4, 4) T_reference_scanner of the view.
        index: which points.
    """
    points, view = scan_points(measurement, v, index)
    return point_correction(terms, points, view, pose)


def scan_points(measurement: Measurement, v: int, index: Indices | slice) -> tuple[Array, ScanView]:
    """Return the points (N, 3) of view v at `index`, scanner frame, and the view with slant and intensity of these."""
    view = measurement.scan_views[v]
    intensity = None if view.intensity is None else view.intensity[index]
    return measurement.capture.scans[v].points[index], replace(view, cosine=view.cosine[index], intensity=intensity)


def point_correction(terms: Sequence[Term], points: Array, view: ScanView, pose: Array, steps: int = 2) -> Array:
    """Return the vectors (N, 3), scanner frame, that added to measured points undo effects of sensor and shape.

    An effect of the sensor maps true points to reported ones: its inverse is found by fixed-point steps.

    Args:
        points: (N, 3) measured, scanner frame.
        view: what effects may know of them.
        pose: (4, 4) T_reference_scanner of the view: effects of shape act in the reference frame.
        steps: of the fixed point. Corrections are thousandths of the range: the first leaves thousandths of them, which
            is enough for a slope, the second millionths.
    """
    true = points
    for term in (t for t in terms if t.effect.place == "sensor"):
        reported = true
        for _ in range(steps):
            true = reported - (term.effect.function(true, view, **term.arguments) - true)
    for term in (t for t in terms if t.effect.place == "shape"):
        in_reference = frames.transform(pose, true)
        moved = term.effect.function(in_reference, view, **term.arguments) - in_reference
        true = true - frames.rotate(frames.inverse(pose), moved)
    return true - points


def target_correction(
    measurement: Measurement, terms: Sequence[Term], poses: Array, places: Array | None = None
) -> Array:
    """Return the vectors (V, S, 3), sensor frame, that added to labelled points undo effects of sensor and shape.

    Zero in empty slots. Effects are evaluated at the targets' mean positions, not at the points as measured.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        places: (V, S, 3) those positions, from `target_places` with the same effects; None: they are computed.
    """
    sightings = measurement.capture.sightings
    assert sightings is not None
    if not moves_points(terms):
        return np.zeros(sightings.points.shape)
    places = target_places(measurement, terms, poses) if places is None else places
    T_scanner_reference = frames.inverse(poses)
    true = frames.transform(T_scanner_reference, places)
    # What the sensor reports of the same places: the part has another shape, then the sensor is off.
    reshaped = _displaced("shape", terms, measurement.target_views, places)
    seen = true.copy() if reshaped is places else frames.transform(T_scanner_reference, reshaped)
    correction = true - _displaced("sensor", terms, measurement.target_views, seen)
    return np.where((sightings.target >= 0)[..., None], correction, 0.0)


def target_places(measurement: Measurement, terms: Sequence[Term], poses: Array) -> Array:
    """Return the position (V, S, 3), reference frame, of the target in each slot: the mean of all views that use it.

    Effects are evaluated at these positions. At the measured point an effect's column would contain that point's own
    error, and the fit would explain the error by it (errors in variables; Fuller 1987, Measurement Error Models).

    Args:
        poses: (V, 4, 4) T_reference_scanner.
    """
    sightings = measurement.capture.sightings
    assert sightings is not None
    measured = frames.transform(poses, sightings.points)
    places = _mean_places(sightings, measured)
    # Positions and corrections depend on each other: two steps of the fixed point, as in `point_correction`.
    for _ in range(2 if moves_points(terms) else 0):
        correction = target_correction(measurement, terms, poses, places)
        places = _mean_places(sightings, measured + frames.rotate(poses, correction))
    return places


def _mean_places(s: Sightings, points: Array) -> Array:
    """Return per slot (V, S, 3) the mean over the views of the points of its target; one that no view uses stays.

    An empty slot, whose zero is no place with a ray to it, gets that of a target of its view; in a view without targets
    the mean of all points.

    Args:
        points: (V, S, 3) reference frame.
    """
    sums = np.zeros((len(s.targets), 3))
    np.add.at(sums, s.target[s.used], points[s.used])
    means = sums / np.maximum(s.view_counts, 1)[:, None]
    any_of_view = s.target.max(axis=1)
    target = np.where(s.target >= 0, s.target, np.maximum(any_of_view, 0)[:, None])
    places = np.where((s.view_counts[target] > 0)[..., None], means[target], points)
    return np.where((any_of_view < 0)[:, None, None], points[s.used].mean(axis=0), places)


def _displaced(place: str, terms: Sequence[Term], views: Sequence[ScanView], points: Array) -> Array:
    """Return the true points (V, N, 3) of all views as displaced by the effects that act at one place.

    The last effect comes first: the reverse of the order in which `point_correction` undoes them.

    Args:
        place: where in the chain the effects act, "sensor" or "shape".
        points: in the frame of that place: the scanner's, or the reference frame.
    """
    for term in (t for t in reversed(terms) if t.effect.place == place):
        displace = partial(term.effect.function, **term.arguments)
        points = np.array([displace(points_of_view, view) for points_of_view, view in zip(points, views, strict=True)])
    return points


def moves_points(terms: Sequence[Term]) -> bool:
    """Return True if an effect moves the points of a view against each other, not only the view as a whole."""
    return any(term.effect.place in ("sensor", "shape") for term in terms)


def true_geometry(measurement: Measurement, model: Model) -> tuple[Array, list[Array]]:
    """Return true poses T_reference_scanner (V, 4, 4) and true points (N, 3) of each scan: the effects undone."""
    poses = _without_motion(measurement, model.terms).poses(model.T_mount)
    points = [scan.points for scan in measurement.capture.scans]
    if moves_points(model.terms):
        terms = model.terms
        points = [p + scan_correction(measurement, terms, v, poses[v], slice(None)) for v, p in enumerate(points)]
    return poses, points


def corrected_capture(measurement: Measurement, model: Model) -> Capture:
    """Return the capture with the effects of the model undone: true chain of frames, scans and labelled points."""
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
    """Return the capture with the true T_reference_mount and T_behind_mount; points stay as they were scanned."""
    left, right = perturbed_frames(measurement, terms)
    return replace(measurement.capture, T_reference_mount=left, T_behind_mount=right)


def pose_derivatives(measurement: Measurement, model: Model, terms: Sequence[Term], centre: Array) -> Iterator[Array]:
    """Yield per term the derivatives (P, V, 6) of the views' poses by its P parameters: ξ of exp(ξ)·T, about `centre`.

    By central differences, at the model with the term added, or in place of its term of the same effect. Zero for the
    view of an event, which is tried and not fitted.

    Args:
        centre: (3,) reference frame.
    """
    # One Jacobian of the chain serves all terms that leave the chain at the same errors.
    jacobian = None
    in_use = true_chain(measurement, model.terms)
    for term in terms:
        # The chain under all other effects, which the term's own are added to.
        others = in_use
        if any(used.name == term.name for used in model.terms):
            others = true_chain(measurement, model.without(term.name).terms)
        chain = true_chain(measurement, [term], others)
        if jacobian is None or not jacobian.is_about(chain):
            jacobian = _ChainJacobian(measurement, model.with_term(term), chain, frames.make(np.eye(3), -centre))
        derivatives = np.zeros((len(term.parameters), measurement.views.count, 6))
        sizes = [(_STEP_GRIDDED if p.grid else STEP) * p.typical for p in term.parameters]
        fitted = [i for i, p in enumerate(term.parameters) if not p.discrete]
        steps = [[true_chain(measurement, [moved], others) for moved in _stepped(term, i, sizes[i])] for i in fitted]
        if steps:
            twists = jacobian.twists(steps, term.effect.place)
            derivatives[fitted] = twists / (2 * np.array(sizes)[fitted, None, None])
        yield derivatives


@dataclass(frozen=True)
class _ChainJacobian:
    """Derivatives of the views' poses by small changes of the chain of frames, at the chain under a model's effects.

    All results are twists ξ of exp(ξ)·T_reference_scanner about a centre, reference frame, rotation first.
    """

    measurement: Measurement
    about: Model
    chain: TrueChain  # under that model
    to_centre: Array  # (4, 4) translation of the reference frame's origin to the centre

    def is_about(self, chain: TrueChain) -> bool:
        """Return True if `chain` equals this one up to rounding, as that of the same effects added in another order."""
        arrays, others = (
            (e.joints, *vars(e.links).values(), e.mount, e.part, e.base, *(vars(e.axes).values() if e.axes else ()))
            for e in (self.chain, chain)
        )
        pairs = zip(arrays, others, strict=True)
        return all(np.array_equal(a, b) or np.allclose(a, b, rtol=1e-12, atol=0.0) for a, b in pairs)

    def twists(self, steps: Sequence[Sequence[TrueChain]], place: str) -> Array:
        """Return twists (P, V, 6) of the views from the second chain of each pair to the first.

        Args:
            steps: P pairs of chains near this one, a parameter stepped up and down.
            place: where in the chain the stepped effect acts: only that part of the chains is compared.
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
        """Derivatives of the flange's pose by joints and links, twists in the flange frame."""
        assert self.measurement.robot is not None
        return flange_slopes(self.measurement.robot, self.chain.joints, self.chain.links)

    @cached_property
    def of_flange(self) -> Array:
        """(V, 6, 6) maps twists in the flange frame, T_base_flange·exp(ξ), to twists of the views about the centre."""
        if self.measurement.eye_to_hand:
            # The flange is the reference frame, and its pose is inverted: (T·exp ξ)⁻¹ = exp(−ξ)·T⁻¹.
            return -frames.adjoint(self.to_centre @ frames.exp(-self.chain.part))
        return frames.adjoint(self._left)

    @cached_property
    def of_base(self) -> Array:
        """(V, 6, 6) maps changes of the base's twist to twists of the views; axes may carry the base."""
        under = frames.adjoint(_under_base(self.measurement))
        return self.of_axes @ under @ frames.left_jacobian(self.chain.base)

    @cached_property
    def of_axes(self) -> Array:
        """(V, 6, 6) maps twists ξ of the flange's effective pose, exp(ξ)·T_base_flange, to those of the views."""
        if self.measurement.eye_to_hand:
            return -frames.adjoint(self._left)
        return frames.adjoint(self.to_centre @ frames.exp(-self.chain.part))

    @cached_property
    def of_mount(self) -> Array:
        """(V, 6, 6) maps changes δ of the mount's twist m to twists of the views: exp(m + δ) ≈ exp(J δ)·exp(m)."""
        behind = self.measurement.views.scanners.behind
        T_mount = self.about.T_mount if behind is None else self.about.T_mount @ behind
        return frames.adjoint(self._left @ T_mount) @ frames.left_jacobian(self.chain.mount)

    @cached_property
    def of_part(self) -> Array:
        """(V, 6, 6) maps changes of the part's twist to twists of the views."""
        return -(frames.adjoint(self.to_centre) @ frames.left_jacobian(-self.chain.part))

    @cached_property
    def _left(self) -> Array:
        """(V, 4, 4) T_centre_mount: all that stands left of the hand-eye, seen from the centre."""
        return self.to_centre @ perturbed_frames(self.measurement, self.about.terms)[0]


def _apply_matrices(matrix: Array, vectors: Array) -> Array:
    """Return matrix[v] @ vectors[p, v] (P, V, 6) for matrices (V, 6, 6) and vectors (P, V, 6)."""
    return (matrix @ vectors.transpose(1, 2, 0)).transpose(2, 0, 1)


@dataclass(frozen=True)
class PointSlopes:
    """Derivatives, by the P parameters of some terms, of the vectors that added to measured points undo all effects.

    By central differences, at the model with each term added, or in place of its term of the same effect.
    """

    measurement: Measurement
    terms: Sequence[Term] = ()
    model: Model | None = None  # may be None where there are no terms

    def at(self, v: int, pose: Array, index: Indices | slice) -> Array:
        """Return the derivatives (P, N, 3), scanner frame, for the points of view v at `index`.

        Args:
            pose: (4, 4) T_reference_scanner of the view.
        """
        points, view = scan_points(self.measurement, v, index)

        def exact_slopes(per_unit: Callable[..., Array]) -> Array:
            """Return (P, N, 3) what undoes a unit of each parameter of an effect."""
            return np.stack([-per_unit(points, view, axis) for axis in np.eye(3)], axis=-1)

        return self._slopes(partial(_correction_change, points, view, pose), exact_slopes)

    def along(self, v: int, pose: Array, index: Indices, direction: Array) -> Array:
        """Return the derivatives (P, N) along unit vectors (N, 3), scanner frame, for the points of view v at `index`.

        A point that comes more than once, as with several partners, is corrected once.

        Args:
            pose: (4, 4) T_reference_scanner of the view.
        """
        every = scan_points(self.measurement, v, index)
        different, position = np.unique(index, return_inverse=True)
        points, view = scan_points(self.measurement, v, different)

        def change_along(up: Sequence[Term], down: Sequence[Term]) -> Array:
            """Return how far (N,) the corrections by two sets of effects differ along the directions."""
            change = _correction_change(points, view, pose, up, down).take(position, axis=0)
            return np.einsum("ni,ni->n", change, direction)

        def exact_slopes(per_unit: Callable[..., Array]) -> Array:
            """Return (P, N) what undoes a unit of each parameter of an effect, along the directions."""
            return -per_unit(*every, direction)

        return self._slopes(change_along, exact_slopes)

    def at_targets(self, poses: Array) -> Array:
        """Return the derivatives (P, V, S, 3), sensor frame, for the labelled points of all views.

        Args:
            poses: (V, 4, 4) T_reference_scanner.
        """
        sightings, views = self.measurement.capture.sightings, self.measurement.target_views
        assert sightings is not None
        places = target_places(self.measurement, () if self.model is None else self.model.terms, poses)
        in_scanner = frames.transform(frames.inverse(poses), places)

        def exact_slopes(per_unit: Callable[..., Array]) -> Array:
            """Return (P, V, S, 3) what undoes a unit of each parameter of an effect; zero in empty slots."""
            of_views = zip(in_scanner, views, strict=True)
            moved = np.array([[per_unit(points, view, axis) for axis in np.eye(3)] for points, view in of_views])
            return np.where((sightings.target >= 0)[..., None], -moved.transpose(2, 0, 3, 1), 0.0)

        def change(up: Sequence[Term], down: Sequence[Term]) -> Array:
            """Return by how much (V, S, 3) the corrections by two sets of effects differ."""
            corrected = (target_correction(self.measurement, terms, poses, places) for terms in (up, down))
            return np.subtract(*corrected)

        return self._slopes(change, exact_slopes)

    def _slopes(
        self,
        change: Callable[[Sequence[Term], Sequence[Term]], Array],
        exact_slopes: Callable[[Callable[..., Array]], Array],
    ) -> Array:
        """Return the derivatives (P, …) of a correction by the parameters of all terms.

        Args:
            change: called with two sets of effects; returns by how much (…) what undoes them differs.
            exact_slopes: called with an effect's `per_unit`; returns the derivatives (p, …) by its p parameters.
        """
        slopes = [change((), ())[None][:0]]
        for term, steps in zip(self.terms, self._steps, strict=True):
            per_unit = term.effect.per_unit
            if steps is not None:
                slopes += [(change(up, down) / width)[None] for up, down, width in steps]
            elif per_unit is not None:
                slopes.append(exact_slopes(per_unit))
        return np.concatenate(slopes)

    @cached_property
    def _steps(self) -> list[list[tuple[tuple[Term, ...], tuple[Term, ...], float]] | None]:
        """Per term the steps of central differences, one a parameter; None where the derivatives are known exactly.

        A step is the effects of the model with the parameter larger, those with it smaller, and the difference of the
        two values. Exact are those of an effect with `per_unit` that is alone among the effects that move points.
        """
        steps = list[list[tuple[tuple[Term, ...], tuple[Term, ...], float]] | None]()
        for term in self.terms:
            assert self.model is not None
            if term.effect.per_unit is not None and not moves_points(self.model.without(term.name).terms):
                steps.append(None)
                continue
            # The view of an event is tried, never fitted: a step of zero width has the derivative 0.
            sizes = [0.0 if parameter.discrete else STEP * parameter.typical for parameter in term.parameters]
            stepped = (map(self.model.with_term, _stepped(term, i, size)) for i, size in enumerate(sizes))
            steps.append(
                [(up.terms, down.terms, 2 * size or 1.0) for (up, down), size in zip(stepped, sizes, strict=True)]
            )
        return steps


def _correction_change(points: Array, view: ScanView, pose: Array, up: Sequence[Term], down: Sequence[Term]) -> Array:
    """Return by how much (N, 3), scanner frame, the corrections of points (N, 3) by two sets of effects differ."""
    return point_correction(up, points, view, pose, steps=1) - point_correction(down, points, view, pose, steps=1)


def _stepped(term: Term, i: int, size: float) -> tuple[Term, Term]:
    """Return the term with parameter i increased by `size`, and with it decreased by as much."""
    step = np.zeros(len(term.parameters))
    step[i] = size
    return term.at(term.values + step), term.at(term.values - step)
