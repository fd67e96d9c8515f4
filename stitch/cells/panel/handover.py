"""Each robot's calibration as a points session: a tracker in the cell sees three reflectors on the flange."""

import numpy as np

from stitch import frames
from stitch.cells.panel.job import JobResult
from stitch.cells.panel.legs import leg_lengths
from stitch.cells.panel.reading import Job
from stitch.cells.session_folder import HandOver, LabelledPoint

_REFLECTORS = ("r1", "r2", "r3")


def sessions(job: Job, result: JobResult) -> tuple[HandOver, ...]:
    """One session a robot, since each has a base of its own; the sensor's frame is the world's.

    The poses are the controller's own, a leg offset that was found is still in them. A parallel robot has no chain of
    joints that a session could name; the lengths of its legs go along as covariates.
    """
    out = []
    for readings, model in zip(job.calibration, result.models, strict=True):
        count = len(readings.T_base_flange)
        views = tuple(f"{readings.name}{m + 1:03}" for m in range(count))
        points = tuple(
            LabelledPoint(views[m], target, readings.reflectors[m, k], float(readings.sigma[m, k]))
            for m in range(count)
            for k, target in enumerate(_REFLECTORS)
        )
        legs = {} if job.legs is None else dict(zip(
            (f"leg{i + 1}_mm" for i in range(6)), leg_lengths(job.legs, readings.T_base_flange).T, strict=True
        ))  # fmt: skip
        out.append(HandOver(
            readings.name, "mm", "eye_to_hand", views, readings.T_base_flange,
            np.asarray(frames.inverse(model.T_world_base)), legs, points,
        ))  # fmt: skip
    return tuple(out)
