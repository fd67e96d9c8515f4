"""The axes of a session with their readings, and the effective poses of its views that follow from them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.axes import Axes, Axis
from stitch.session.session import SessionData, View


def axes_of(session: SessionData) -> Axes:
    """Return the axes of a session with their readings and approach in its V views.

    An approach that views.csv does not state is the sign of the change since the view before; 0 in the first.
    """
    if not session.axes:
        return Axes()
    readings = np.array([axis_readings(session.axes, v.covariates, session.length_unit) for v in session.views])
    readings = readings.reshape(len(session.views), len(session.axes))
    approach = np.sign(np.diff(readings, axis=0, prepend=readings[:1]))
    for v, view in enumerate(session.views):
        if view.axis_approach is not None:
            approach[v] = view.axis_approach
    return Axes(session.axes, readings, approach, session.has_poses, session.length_unit)


def axis_readings(axes: Sequence[Axis], covariates: Mapping[str, float], length_unit: str) -> Array:
    """Return the readings (K,) of one view, rad or length_unit.

    Args:
        axes: K axes.
        covariates: column of views.csv -> value; each axis has one of its columns among them.
    """
    columns = [axis.columns(length_unit) for axis in axes]
    return np.array([next(covariates[c] * size for c, size in of.items() if c in covariates) for of in columns])


def require_readings(views: Sequence[View], axes: Sequence[Axis], length_unit: str) -> None:
    """Refuse a view whose covariates do not hold exactly one of the possible columns of each axis.

    Raises:
        InputError: names the view and the axis.
    """
    for axis in axes:
        columns = axis.columns(length_unit)
        for view in views:
            if len(columns.keys() & view.covariates.keys()) != 1:
                raise InputError(
                    f"view {view.name}: no reading of axis {axis.name}; to fix: pass covariates with "
                    f"{' or '.join(columns)}, one number a view"
                )


def place_axes(session: SessionData, axes: Sequence[Axis]) -> SessionData:
    """Return the session with axes of the same names placed elsewhere, and with the effective poses that follow.

    A view's T_base_flange holds the motion of the axes too: it is taken off with the old axes, and put on with the new.
    """
    if not session.views:
        return replace(session, axes=tuple(axes))
    reported = reported_poses(session)
    session = replace(session, axes=tuple(axes))
    poses = axes_of(session).carried() @ reported
    views = [replace(view, T_base_flange=T) for view, T in zip(session.views, poses, strict=True)]
    return replace(session, views=tuple(views))


def reported_poses(session: SessionData) -> Array:
    """Return T_base_flange (V, 4, 4) as the robot reports it: the views' effective poses less the axes' motion."""
    T = np.array([view.T_base_flange for view in session.views])
    return frames.inverse(axes_of(session).carried()) @ T if session.axes else T


def place_stated_axes(session: SessionData, axes: Sequence[Axis]) -> SessionData:
    """Return the session with the axes that session.toml states.

    With a robot they are given in its base frame, and stay in it. Without one session.toml gives them in the scanner's
    frame; all that follows needs them in that of one axis, the frame axis (`Axes.frame_axis`), with z along it. Its
    stated place is the hand-eye T_mount; where it is not known, the other axes become unplaced too.

    Raises:
        InputError: without a robot, the frame axis and `scanner.pose` both state where the scanner stands.
    """
    if session.has_poses or not axes:
        return place_axes(session, axes)
    k = Axes(tuple(axes), has_robot=False).frame_axis
    frame_axis = axes[k]
    T_axis_scanner = session.scanner.T_mount
    if frame_axis.is_placed:
        if T_axis_scanner is not None:
            raise InputError(
                f"{session.path}: axis {frame_axis.name} and scanner.pose both state where the axis stands; to "
                "fix: take one out"
            )
        T_axis_scanner = frames.inverse(frame_axis.frame)
        session = replace(session, scanner=replace(session.scanner, T_mount=T_axis_scanner))
    placed = [_axis_in_frame(axis, T_axis_scanner) for axis in axes]
    origin = np.zeros(3) if frame_axis.is_rotary else None
    placed[k] = replace(frame_axis, direction=np.array([0.0, 0.0, 1.0]), point=origin)
    return place_axes(session, placed)


def _axis_in_frame(axis: Axis, T_new_old: Array | None) -> Axis:
    """Return an axis in another frame: T_new_old (4, 4) maps its present frame into that one; None: it is unplaced.

    An axis without a direction stays as it is.
    """
    if T_new_old is None:
        return replace(axis, direction=None, point=None)
    if axis.direction is None:
        return axis
    point = None if axis.point is None else frames.transform(T_new_old, axis.point[None])[0]
    return replace(axis, direction=T_new_old[:3, :3] @ axis.direction, point=point)


def carried_last(session: SessionData) -> Array:
    """Return (1, 4, 4): multiplied from the left it makes a pose of the arm effective, the axes as in the last view."""
    return axes_of(session).standing(1).carried() if session.axes else np.eye(4)[None]


def axis_tables(session: SessionData) -> list[dict[str, Any]]:
    """Return the [[axis]] tables of session.toml for a session, such that `place_stated_axes` gives its axes again.

    Without a robot they are written in the scanner's frame, and without a place where the hand-eye is not known.
    """
    tables = []
    for axis in session.axes:
        table: dict[str, Any] = {"name": axis.name, "kind": axis.kind, "carries": axis.carries}
        if not session.has_poses:
            T_mount = session.scanner.T_mount
            axis = _axis_in_frame(axis, None if T_mount is None else frames.inverse(T_mount))
        if axis.direction is not None:
            table["direction"] = axis.direction.tolist()
            if axis.point is not None:
                table["point"] = axis.point.tolist()
            if axis.is_fixed:
                table["stated"] = True
        tables.append(table)
    return tables


def require_placed(session: SessionData) -> None:
    """Refuse a session with an axis of unknown place, for commands that do not fit it.

    Raises:
        InputError: names the axis.
    """
    for axis in session.axes:
        if not axis.is_placed:
            raise InputError(
                f"{session.path}: nobody says where axis {axis.name} stands; to fix: `stitch run` finds it; state what "
                "result.json has under axes in [[axis]]"
            )
