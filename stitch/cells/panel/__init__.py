"""A large panel held by six parallel robots: global model with a laser tracker, pose and shape."""

from stitch.cells.panel.job import JobResult, solve_job
from stitch.cells.panel.reading import Job, read_job

__all__ = ["Job", "JobResult", "read_job", "solve_job"]
