"""Each robot's calibration as a points session: a tracker in the cell sees three reflectors on the flange."""

import numpy as np

from stitch import frames
from stitch.cells.panel.global_model import ReflectorReadings, RobotModel
from stitch.cells.panel.legs import Legs, leg_lengths
from stitch.cells.panel.panel_job import PanelJob
from stitch.cells.panel.panel_solution import PanelResult
from stitch.cells.session_tables import points_table
from stitch.frames import Array
from stitch.writing.session_files import SessionFiles, pose_columns

_REFLECTORS = ("r1", "r2", "r3")


def robot_sessions(job: PanelJob, result: PanelResult) -> list[SessionFiles]:
    """One session a robot, since each has a base of its own; the sensor's frame is the world's.

    The poses are the controller's own, a leg offset that was found is still in them. A parallel robot has no chain of
    joints that a session could name; the lengths of its legs go along as covariates.
    """
    pairs = zip(job.calibration, result.models, strict=True)
    return [_robot_session(readings, model, job.legs) for readings, model in pairs]


def _robot_session(readings: ReflectorReadings, model: RobotModel, legs: Legs | None) -> SessionFiles:
    count = len(readings.T_base_flange)
    views = [f"{readings.name}{m + 1:03}" for m in range(count)]
    points = points_table(
        np.repeat(views, len(_REFLECTORS)).tolist(),
        _REFLECTORS * count,
        readings.reflectors.reshape(-1, 3),
        readings.sigma.ravel(),
    )
    lengths = {} if legs is None else _leg_columns(legs, readings.T_base_flange)
    return SessionFiles(
        name=readings.name,
        length_unit="mm",
        mount="eye_to_hand",
        tables={"scanner": {"pose": frames.inverse(model.T_world_base).tolist()}},
        views={"view": views, **pose_columns(readings.T_base_flange), **lengths},
        points=points,
    )


def _leg_columns(legs: Legs, T_base_flange: Array) -> dict[str, Array]:
    return {f"leg{i + 1}_mm": lengths for i, lengths in enumerate(leg_lengths(legs, T_base_flange).T)}
