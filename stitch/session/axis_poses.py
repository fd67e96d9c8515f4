"""The axes of a session with their readings, and the effective poses of its views that follow from them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.axes import Axes, Axis
from stitch.session.session import SessionData


def axes_of(session: SessionData) -> Axes:
    """Return the axes of a session with their readings in its views."""
    if not session.axes:
        return Axes()
    readings = np.array([axis_readings(session.axes, v.covariates, session.length_unit) for v in session.views])
    readings = readings.reshape(len(session.views), len(session.axes))
    moved = np.sign(np.diff(readings, axis=0, prepend=readings[:1]))
    stated = zip(session.views, moved, strict=True)
    approach = np.array([m if v.axis_approach is None else v.axis_approach for v, m in stated])
    approach = np.reshape(approach, readings.shape)
    return Axes(session.axes, readings, approach, session.has_poses, session.length_unit)


def axis_readings(axes: Sequence[Axis], covariates: Mapping[str, float], length_unit: str) -> Array:
    """Return (K,) readings of one view, rad or length_unit, from its columns."""
    columns = [axis.columns(length_unit) for axis in axes]
    return np.array([next(covariates[c] * size for c, size in of.items() if c in covariates) for of in columns])


def place_axes(session: SessionData, axes: Sequence[Axis]) -> SessionData:
    """Return the session with axes of the same names at another place, and the effective poses that follow."""
    if not session.views:
        return replace(session, axes=tuple(axes))
    reported = reported_poses(session)
    session = replace(session, axes=tuple(axes))
    poses = axes_of(session).carried() @ reported
    views = [replace(view, T_base_flange=T) for view, T in zip(session.views, poses, strict=True)]
    return replace(session, views=tuple(views))


def reported_poses(session: SessionData) -> Array:
    """Return T_base_flange (V, 4, 4) as the robot reports it, without the axes."""
    T = np.array([view.T_base_flange for view in session.views])
    return frames.inverse(axes_of(session).carried()) @ T if session.axes else T


def as_stated(session: SessionData, axes: Sequence[Axis]) -> SessionData:
    """Return the session with its axes as session.toml states them, and the hand-eye that this states without a robot.

    There they are given in the scanner's frame; they count in that of the first rotary axis at its zero.

    Raises:
        InputError: place of the axis and of the scanner are both stated.
    """
    if session.has_poses or not axes:
        return place_axes(session, axes)
    own = axes[Axes(tuple(axes), has_robot=False).own]
    T_own_scanner = session.scanner.T_mount
    if own.is_placed:
        if T_own_scanner is not None:
            raise InputError(
                f"{session.path}: axis {own.name} and scanner.pose both state where the axis stands; to "
                "fix: take one out"
            )
        T_own_scanner = frames.inverse(own.frame)
        session = replace(session, scanner=replace(session.scanner, T_mount=T_own_scanner))
    placed = []
    for axis in axes:
        if axis is own:
            still = np.zeros(3) if axis.is_rotary else None
            axis = replace(axis, direction=np.array([0.0, 0.0, 1.0]), point=still)
        elif T_own_scanner is None:
            axis = replace(axis, direction=None, point=None)
        elif axis.direction is not None:
            point = None if axis.point is None else frames.transform(T_own_scanner, axis.point[None])[0]
            axis = replace(axis, direction=T_own_scanner[:3, :3] @ axis.direction, point=point)
        placed.append(axis)
    return place_axes(session, placed)


def carried_last(session: SessionData) -> Array:
    """Return (1, 4, 4) by which poses of the arm become effective ones where the axes stand as in the last view."""
    return axes_of(session).standing(1).carried() if session.axes else np.eye(4)[None]


def axis_tables(session: SessionData) -> list[dict[str, Any]]:
    """Return the [[axis]] tables of a session, as `as_stated` reads them."""
    tables = []
    to_scanner = None
    if not session.has_poses and session.scanner.T_mount is not None:
        to_scanner = frames.inverse(session.scanner.T_mount)
    for axis in session.axes:
        table: dict[str, Any] = {"name": axis.name, "kind": axis.kind, "carries": axis.carries}
        direction, point = axis.direction, axis.point
        if to_scanner is not None and direction is not None:
            direction = to_scanner[:3, :3] @ direction
            point = None if point is None else frames.transform(to_scanner, point[None])[0]
        if direction is not None and (session.has_poses or to_scanner is not None):
            table["direction"] = direction.tolist()
            table |= {} if point is None else {"point": point.tolist()}
            table |= {"stated": True} if axis.is_fixed else {}
        tables.append(table)
    return tables


def require_placed(session: SessionData) -> None:
    """Refuse a session with an axis that nobody has placed, where it is not fitted.

    Raises:
        InputError: names the axis.
    """
    for axis in session.axes:
        if not axis.is_placed:
            raise InputError(
                f"{session.path}: nobody says where axis {axis.name} stands; to fix: `stitch run` finds it; state what "
                "result.json has under axes in [[axis]]"
            )
