"""A large panel held by six parallel robots: global model with a laser tracker, pose and shape."""

from stitch.cells.panel.panel_job import Job, read_job
from stitch.cells.panel.panel_solution import JobResult, solve_job

__all__ = ["Job", "JobResult", "read_job", "solve_job"]
