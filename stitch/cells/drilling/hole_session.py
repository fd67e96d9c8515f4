"""The reference holes as a points session: sensors on the flange see holes that are fixed in the cell."""

import numpy as np

from stitch import frames
from stitch.cells.drilling.drill_job import DrillJob
from stitch.cells.drilling.drill_solution import DrillResult, hole_in_plane
from stitch.cells.session_tables import points_table
from stitch.writing.session_files import SessionFiles, pose_columns


def hole_session(job: DrillJob, result: DrillResult) -> SessionFiles:
    """One view for each reference hole; the sensors' frame is the flange's, and the drawing gives the targets.

    The sigma is what leaving one hole of the plate out says of the camera; the rangers' height has none of its own.
    """
    T_tool_flange = frames.make(np.eye(3), np.array([0.0, 0.0, -job.height]))
    names = tuple(job.placed)
    views = [f"at-{name}" for name in names]
    T_base_flange = np.array([job.placed[name].T_base_tool @ T_tool_flange for name in names])
    places = [np.append(hole_in_plane(job, result.H, result.effects, name), job.placed[name].height) for name in names]
    errors = result.leave_one_out_errors
    sigma = np.full(len(names), np.sqrt((errors**2).mean())) if len(errors) else None
    return SessionFiles(
        name="drilling",
        length_unit=job.length_unit,
        mount="eye_in_hand",
        tables={"scanner": {"pose": np.eye(4).tolist()}},
        views={"view": views, **pose_columns(T_base_flange)},
        points=points_table(views, names, np.array(places), sigma),
        targets={hole.name: hole.position for hole in job.holes if hole.name in names},
    )
