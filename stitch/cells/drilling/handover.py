"""The reference holes as a points session: sensors on the flange see holes that are fixed in the cell."""

import numpy as np

from stitch import frames
from stitch.cells.drilling.job import JobResult, seen_in_plane
from stitch.cells.drilling.reading import Job
from stitch.cells.session_folder import HandOver, LabelledPoint


def session(job: Job, result: JobResult) -> HandOver:
    """One view for each reference hole; the sensors' frame is the flange's, and the drawing gives the targets.

    The sigma is what leaving one hole of the plate out says of the camera; the rangers' height has none of its own.
    """
    back = frames.make(np.eye(3), np.array([0.0, 0.0, -job.height]))
    names = tuple(job.placed)
    flanges = np.array([job.placed[name][0] @ back for name in names])
    sigma = float(np.sqrt((result.left_out**2).mean())) if len(result.left_out) else None
    places = (np.append(seen_in_plane(job, result.H, result.naming, name), job.placed[name][2]) for name in names)
    points = tuple(LabelledPoint(f"at-{name}", name, p, sigma) for name, p in zip(names, places, strict=True))
    drawn = {hole.name: hole.position for hole in job.holes if hole.name in names}
    return HandOver(
        "drilling", job.length_unit, "eye_in_hand", tuple(f"at-{name}" for name in names), flanges, np.eye(4),
        points=points, targets=drawn,
    )  # fmt: skip
