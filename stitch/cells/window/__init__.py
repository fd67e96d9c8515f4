"""A window in a car body: scan onto CAD, deviation map, corrected path, flush and gap of the seam."""

from stitch.cells.window.window_jobs import FitJob, SeamJob, read_fit_job, read_seam_job
from stitch.cells.window.window_solution import fit_parts, solve_seam

__all__ = ["FitJob", "SeamJob", "fit_parts", "read_fit_job", "read_seam_job", "solve_seam"]
