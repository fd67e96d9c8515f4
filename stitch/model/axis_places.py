"""Where the external axes of a session stand under a model, with sigma, as a person states them.

Direction and point lie in the base frame with all axes at zero; without a robot in the scanner's frame, as the
hand-eye has it. A point is that of the axis nearest to the one stated, or to what was scanned; along the axis it is
free, and its sigma says nothing of that.
"""

from dataclasses import dataclass

import numpy as np

from stitch.effects.axis_effects import PLACEMENT
from stitch.model.forward import true_chain
from stitch.model.model import Model, Term, values_of
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import MILLIMETRES, value_uncertainty_text
from stitch.session.axes import Axis
from stitch.session.measurement import Measurement
from stitch.system.values import Value

# Step of differences, rad or length_unit: far above rounding, far below the bend of any angle.
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class AxisPlace(Value):
    """One axis where a model puts it; sigmas are NaN where the views do not show it, or it was used as given.

    Example:
        >>> [axis.name for axis in run.axes]
        []
    """

    name: str
    kind: str  # rotary | linear
    direction: Array  # (3,) unit vector
    direction_sigma: Array  # (3,) rad
    point: Array | None  # (3,) length_unit, of a rotary axis
    point_sigma: Array | None  # (3,)
    unobservable: tuple[str, ...] = ()

    def line(self, length_unit: str) -> str:
        """Return the axis as a line for people: direction as a unit vector, point in mm, each with ± U (k = 2).

        Example:
            >>> [axis.line("mm") for axis in run.axes]
            []
        """
        to_mm = MILLIMETRES[length_unit]
        numbers = zip(self.direction, 2 * self.direction_sigma, strict=True)
        shown = bool(np.isfinite(self.direction_sigma).all())
        text = ", ".join(value_uncertainty_text(x, u) if shown else f"{x:.6f}" for x, u in numbers)
        parts = [f"direction {text}"]
        if self.point is not None and self.point_sigma is not None:
            shown = bool(np.isfinite(self.point_sigma).all())
            numbers = zip(self.point * to_mm, 2 * self.point_sigma * to_mm, strict=True)
            text = ", ".join(value_uncertainty_text(x, u) if shown else f"{x:.3f}" for x, u in numbers)
            parts.append(f"point {text} mm")
        return f"{self.name}: {'; '.join([*parts, *self.unobservable])}"


def axis_places(measurement: Measurement, model: Model) -> tuple[AxisPlace, ...]:
    """Return where a model puts the axes of a session, with sigmas, in their order; () without axes.

    Sigmas to first order, by differences of direction and point in hand-eye and placement.
    """
    axes = measurement.views.axes
    if not axes:
        return ()
    term = next((term for term in model.terms if term.name == PLACEMENT), None)
    near = _middle(measurement, model)
    names = [] if term is None else [f"{term.name}.{p.name}" for p in term.parameters]
    covariance = model.covariance_with(names)
    if (known := model.effects_covariance.with_hand_eye).size:
        # Without the prior's part: only what the motions show.
        covariance[:6, :6] = known[:, :6]
    places = []
    for k, axis in enumerate(axes.axes):
        place = _as_stated(measurement, model, term, k, near)
        moved = [_as_stated(measurement, *_moved(model, term, s), k, near) for s in _STEP * np.eye(len(covariance))]
        # Derivatives of direction and point (6,) by the hand-eye's twist and the parameters, one a row.
        J = (np.array(moved) - place) / _STEP
        sigma = np.sqrt(np.maximum(np.einsum("ij,ik,kj->j", J, covariance, J), 0.0))
        no_sigma, unobservable = _unseen(axis, term, has_robot=axes.has_robot, is_frame_axis=k == axes.frame_axis)
        sigma[:3][no_sigma[0]] = np.nan
        sigma[3:][no_sigma[1]] = np.nan
        point, point_sigma = (place[3:], sigma[3:]) if axis.is_rotary else (None, None)
        places.append(AxisPlace(axis.name, axis.kind, place[:3], sigma[:3], point, point_sigma, unobservable))
    return tuple(places)


def _moved(model: Model, term: Term | None, step: Array) -> tuple[Model, Term | None]:
    """Return the hand-eye and the placement moved by a step (6 + P,): a twist, then changes of the parameters."""
    T_mount = model.T_mount @ frames.exp(step[:6])
    moved = None if term is None else term.at(values_of([term]) + step[6:])
    return Model(T_mount), moved


def _as_stated(measurement: Measurement, model: Model, term: Term | None, k: int, near: Array) -> Array:
    """Return direction and point (6,) of axis k: in the robot's base frame, without a robot in the scanner's.

    Args:
        term: axis_placement with its values; None: the axes as stated.
        near: (3,) same frame; the point returned is the one on the axis that is nearest to it.
    """
    axes = measurement.views.axes
    motion = axes.as_read() if term is None else true_chain(measurement, [term]).axes
    assert motion is not None
    axis = axes.placed(motion)[k]
    assert axis.direction is not None
    direction = axis.direction
    point = np.zeros(3) if axis.point is None else axis.point
    if not axes.has_robot:
        to_scanner = frames.inverse(model.T_mount)
        direction = to_scanner[:3, :3] @ direction
        point = frames.transform(to_scanner, point[None])[0]
    return np.append(direction, point + direction * (direction @ (near - point)))


def _middle(measurement: Measurement, model: Model) -> Array:
    """Return the mean (3,) over the views of their points: reference frame, without a robot the scanner's."""
    clouds = measurement.capture.visible_points
    if measurement.views.axes.has_robot:
        poses = measurement.capture.poses(model.T_mount)
        clouds = [frames.transform(T, points) for T, points in zip(poses, clouds, strict=True)]
    return np.asarray(np.mean([points.mean(axis=0) for points in clouds if len(points)], axis=0))


def _unseen(
    axis: Axis, term: Term | None, *, has_robot: bool, is_frame_axis: bool
) -> tuple[tuple[bool, bool], tuple[str, ...]]:
    """Return whether direction and point of an axis have no sigma, and in words what of it the views do not show.

    Args:
        term: axis_placement; None: it was not fitted.
        has_robot: False: axes alone move what is scanned.
        is_frame_axis: without a robot, the axis in whose frame the others are given: the hand-eye places it.
    """
    if is_frame_axis:
        return (False, False), ()
    if axis.is_fixed or term is None:
        return (True, True), ()
    mine = [p for p in term.parameters if p.name.partition("_")[2] == axis.name]
    turned = [p.fitted for p in mine if p.unit == "rad"]
    moved = [p.fitted for p in mine if p.unit != "rad"]
    if not has_robot and any(turned) and (any(moved) or not moved):
        # The common frame may turn about its own axis and move along it: one of two parameters is always held.
        return (False, False), ()
    unknown = [f"{what} not known" for what, seen in (("direction", turned), ("place", moved)) if not all(seen)]
    return (not all(turned), not all(moved)), tuple(unknown)
