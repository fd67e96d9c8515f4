"""The files of examples/panel: leg 4 of robot C is 0.5 mm longer than it believes, the panel just laid on.

Run: python bench/panel_example.py
"""

from pathlib import Path

import numpy as np
from panel_loops import measure_pose
from panel_ready import POSES, ready

from data_synth.cells import panel_job
from data_synth.cells.panel import NAMES

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "panel"


def main() -> None:
    """The job of a cell in which leg 4 of robot C is 0.5 mm longer than it believes, panel just laid on."""
    EXAMPLE.mkdir(exist_ok=True)
    hidden = np.zeros((6, 6))
    hidden[2, 3] = 0.5
    r = ready(7, leg_offsets=hidden)
    files = {k: f"{k}.csv" for k in ("calibration", "flanges", "targets", "control", "forces")}
    commands = panel_job.calibration_poses(POSES, 7)
    seen = np.stack([reading.reflectors for reading in r.readings], axis=1)
    panel_job.write_calibration(EXAMPLE / files["calibration"], commands, seen)
    panel_job.write_flanges(EXAMPLE / files["flanges"], r.T_base_flange)
    targets, (control, clamp) = panel_job.pose_targets(), panel_job.control_points()
    names = [f"T{i + 1}" for i in range(len(targets))]
    panel_job.write_points(EXAMPLE / files["targets"], names, targets, r.cell.track(targets))
    names = [f"SC{c + 1}.{i % 3 + 1}" for i, c in enumerate(clamp)]
    panel_job.write_points(EXAMPLE / files["control"], names, control, r.cell.track(control), [NAMES[c] for c in clamp])
    panel_job.write_forces(EXAMPLE / files["forces"], r.cell.forces())
    panel_job.write_job(EXAMPLE / "job.toml", r.cell, files)
    print(measure_pose(r.cell, r.stage, targets).T)


if __name__ == "__main__":
    main()
