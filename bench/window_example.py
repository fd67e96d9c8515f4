"""The files of examples/window: a pane to fit, coarse enough to be small, and the seam of a pane set a little wrong.

Run: python bench/window_example.py
"""

from pathlib import Path

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from data_synth.cells import window_job, window_scans, window_views
from data_synth.shapes import car_door
from data_synth.shapes.car_door import Pane
from stitch.numerics import frames

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "window"
NOISE = 0.05
FIT_JOB = """# Lengths in the CAD's unit, here mm; poses are x, y, z and a, b, c in degrees about z, y', x''.
format = "stitch-fit/1"
cad = "pane.stl"
scans = "pane.csv"  # cloud files in their scanners' frames, and where the scanner stood in the base
tolerance = 0.5  # of the deviation map
path = "path.csv"  # of the robot, programmed for a part that stands as [nominal] says

[nominal]
"""
GRIPPER = """

[[region]]  # a box of the part's frame whose points do not count; "expected" boxes carry the fit alone
name = "gripper"
kind = "forbidden"
low = [600.0, -50.0, 700.0]
high = [700.0, 50.0, 800.0]
"""
SEAM_JOB = """# Lengths in mm; poses are x, y, z and a, b, c in degrees about z, y', x''.
format = "stitch-seam/1"
scans = "seam.csv"
stations = "stations.csv"  # in the part's frame: across from the pane to the body, out of the surface

[part]  # where it lies in the base; or, above this table, fit = "fit.json" as stitch fit wrote it
"""
LIMITS = """

[limits]
flush = 0.0
flush_tolerance = 1.5
gap = 16.0
gap_tolerance = 2.0
"""


def truth(seed: int) -> np.ndarray:
    """Any turn, about where the source's body stands."""
    return frames.make(Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), [3567.7, -2954.3, 1932.9])


def main() -> None:
    """A pane to fit, coarse enough to be small, and the seam of a pane set a little wrong."""
    EXAMPLE.mkdir(exist_ok=True)
    pane = car_door.build_pane()
    vertices, faces, _, _ = igl.qslim(np.asfortranarray(pane.vertices), np.asfortranarray(pane.faces, np.int32), 3000)
    pane.__init__(vertices, faces)
    pane.export(EXAMPLE / "pane.stl")
    T, nominal = truth(1), truth(1) @ frames.exp(np.array([0.01, -0.006, 0.004, 6.0, -4.0, 9.0]))
    overview, poses = window_scans.scan_outside(pane, T, NOISE, 1, (3, 1), rays=60)
    close, near = window_scans.scan_edges(pane, T, Pane(), "pane", NOISE, 2, count=8, rays=60)
    window_job.write_scans(EXAMPLE / "pane.csv", overview + close, np.concatenate([poses, near]))
    path = np.array([nominal @ frames.make(np.eye(3), [x, 200.0, 750.0]) for x in (300, 600, 900)])
    window_job.write_path(EXAMPLE / "path.csv", path)
    (EXAMPLE / "fit.toml").write_text(FIT_JOB + window_job.pose_table(nominal) + GRIPPER, encoding="utf-8")
    middle, across, out = window_views.stations(Pane())
    door, set_wrong = car_door.build(), car_door.build_pane()
    set_wrong.apply_translation([0.8, 0.6, -0.5])
    clouds, poses = window_scans.scan_seam([door, set_wrong], T, (middle, across, out), NOISE, 3, rays=100)
    clouds = [points[(np.abs(points[:, :2]) < 24).all(axis=1)] for points in clouds]
    window_job.write_scans(EXAMPLE / "seam.csv", clouds, poses)
    window_job.write_stations(EXAMPLE / "stations.csv", middle, across, out)
    (EXAMPLE / "seam.toml").write_text(SEAM_JOB + window_job.pose_table(T) + LIMITS, encoding="utf-8")


if __name__ == "__main__":
    main()
