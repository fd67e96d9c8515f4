"""What the sessions of one rig must have in common; sessions that cannot be fitted together are refused."""

from collections.abc import Sequence

import numpy as np

from stitch.effects.contract import find_effect, parameters_in, require_available
from stitch.errors import InputError
from stitch.model.model_toml import ModelFile
from stitch.session.axis_poses import axis_tables
from stitch.session.measurement import Measurement, require_rising_times
from stitch.session.session import SessionData

# No two measured scans begin with so many points alike.
_COMPARED_POINTS = 100


def require_same_rig(sessions: Sequence[SessionData], model: ModelFile | None) -> None:
    """Refuse sessions that cannot share a rig: its mount, length unit, model, kind of data, and external axes.

    Each session by itself also needs something measured, two views, and times that never decrease.

    Raises:
        InputError: names the session and what is wrong.
    """
    first = sessions[0]
    for other in sessions[1:]:
        if (other.mount, other.length_unit) != (first.mount, first.length_unit):
            raise InputError(
                f"{other.path}: mount {other.mount} in {other.length_unit}, but {first.path} has {first.mount} "
                f"in {first.length_unit}; only sessions of one rig share a hand-eye"
            )
    if model and model.mount != first.mount:
        raise InputError(
            f"the model's mount is {model.mount}, that of {first.path} is {first.mount}; use a run of the same rig"
        )
    if model and model.scanners and len(sessions) == 1 and not first.parts:
        raise InputError(
            f"{first.path}: one session, but the model has the hand-eyes of {', '.join(model.scanners)}; to fix: name "
            "the folder of this session within that run (--hand-eye RUN/SESSION)"
        )
    for session in sessions:
        require_rising_times(session)
        if not session.has_clouds and not session.has_sightings:
            raise InputError(f"{session.path}: some views name no cloud and there is no points.csv or frames.csv")
        if session.has_clouds != first.has_clouds:
            clouds, points = (first, session) if first.has_clouds else (session, first)
            raise InputError(
                f"{clouds.path} has clouds and {points.path} labelled points alone; to fix: run them apart, one with "
                "the model of the other (--hand-eye, --arm)"
            )
        if not session.has_clouds:
            require_same_arm(first, session)
        if session is not first and (session.has_poses, axis_tables(session)) != (first.has_poses, axis_tables(first)):
            raise InputError(
                f"{session.path}: its [[axis]] tables are not those of {first.path}; to fix: state the same axes, at "
                "the same place, in all sessions of a rig"
            )
        if len(session.views) < 2:
            raise InputError(f"{session.path}/views.csv: one view only; stitching needs at least 2")


def require_same_arm(first: SessionData, other: SessionData) -> None:
    """Refuse two sessions whose robots differ in their kinematics; masses may differ, and one may state no robot.

    Raises:
        InputError: another number of joints, or other transforms before, after or zero angles of them.
    """
    a, b = first.robot, other.robot
    if a is None or b is None:
        return
    if a.n_joints != b.n_joints or not all(
        np.allclose(getattr(a, name), getattr(b, name)) for name in ("before", "after", "theta")
    ):
        raise InputError(
            f"{other.path}: its [robot] is another arm than that of {first.path}; only sessions of one arm share its "
            "effects; to fix: state the same rows, or run them apart"
        )


def require_measured_once(sessions: Sequence[SessionData]) -> None:
    """Refuse a scan that stands in two sessions: it would count as two, and the hand-eye seem surer than it is.

    Raises:
        InputError: names both sessions and views.
    """
    # Session and view by the bytes of the scan's first points. Within one session a repeated scan is not refused here.
    known: dict[bytes, tuple[SessionData, str]] = {}
    for session in sessions:
        clouds = [(view.name, view.cloud) for view in session.views if view.cloud is not None]
        begins = {cloud.points[:_COMPARED_POINTS].tobytes(): name for name, cloud in clouds}
        for points, name in begins.items():
            if points in known:
                other, view = known[points]
                raise InputError(
                    f"{session.path}: the scan of view {name} is that of view {view} in {other.path}, measured once "
                    "and given twice; to fix: name each session once"
                )
        known |= {points: (session, name) for points, name in begins.items()}


def require_effects(measurements: Sequence[Measurement], effects: Sequence[str]) -> None:
    """Refuse effects that a session cannot have, or that have other parameters in another session of the rig.

    Raises:
        InputError: names the effect, the session and what is missing or different.
    """
    for effect in map(find_effect, effects):
        for measurement in measurements:
            require_available(measurement, effect)
        # One value of each parameter is fitted to all sessions.
        parameters = [{f"{p.name} ({p.unit})" for p in parameters_in(m, effect)} for m in measurements]
        for measurement, names in zip(measurements, parameters, strict=True):
            if names != parameters[0]:
                raise InputError(
                    f"effect {effect.name}: sessions {measurements[0].capture.name} and {measurement.capture.name} "
                    f"do not share {', '.join(sorted(parameters[0] ^ names))}; give both the same arm, link masses and "
                    "temperatures, or run them apart"
                )
