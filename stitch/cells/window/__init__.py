"""A window in a car body: scan onto CAD, deviation map, corrected path, flush and gap of the seam."""

from stitch.cells.window.job import fit_parts, solve_seam
from stitch.cells.window.reading import FitJob, SeamJob, read_fit_job, read_seam_job

__all__ = ["FitJob", "SeamJob", "fit_parts", "read_fit_job", "read_seam_job", "solve_seam"]
