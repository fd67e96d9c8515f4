"""The panel cell in closed loop: writes the tables and pictures of docs/panel.md.

Run: python bench/panel.py [--draws N]
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from panel_drift import drift_table
from panel_loops import run_pose
from panel_ready import MASTER, POSES, TOLERANCE, pose_error, read, ready, ready_without_panel, shape_run

from data_synth.cells import hexapod, panel_job
from data_synth.cells.panel import NAMES, PanelCell, Sizes
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.plugins.cells.panel_model import (
    SHAPE_AXES,
    LaserTracker,
    Legs,
    calibrate_robot,
    errors_along_motion,
    find_leg_offset,
    true_flanges,
)
from viz.cells.panel import errors_figure, shape_figure

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURES = ROOT / "docs" / "panel.md", ROOT / "docs" / "pictures"
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
JOINT = 0.05  # mm along each axis, of every joint of base and platform
LEGS = Legs(hexapod.BASE, hexapod.PLATFORM)


def pose_table(draws: int) -> list[str]:
    before, after, forces, crooked = [], [], [], []
    for seed in range(draws):
        r = ready(seed)
        before.append(pose_error(r.cell))
        run_pose(r.cell, r.stage, panel_job.pose_targets(), r.T_base_flange)
        after.append(pose_error(r.cell))
        forces.append(np.linalg.norm(r.cell.state()[2][:, 3:], axis=1).max())
        r = ready(seed, sizes=Sizes(joint=JOINT))
        run_pose(r.cell, r.stage, panel_job.pose_targets(), r.T_base_flange)
        crooked.append(pose_error(r.cell))
    b, a, c = np.abs(before), np.abs(after), np.abs(crooked)
    lines = [
        f"Pose after one adjustment, {draws} cells; absolute errors against the truth.",
        "",
        "| | x / mm | y / mm | z / mm | about x / ° | about y / ° | about z / ° |",
        "|---|---|---|---|---|---|---|",
    ]
    order = [3, 4, 5, 0, 1, 2]
    rows = [("before, largest", b.max(0), "{:.2f}"), ("after, rms", np.sqrt((a**2).mean(0)), "{:.4f}")]
    rows.append(("after, largest", a.max(0), "{:.4f}"))
    rows.append((f"after, joints {JOINT} mm off, rms", np.sqrt((c**2).mean(0)), "{:.4f}"))
    rows.append((f"after, joints {JOINT} mm off, largest", c.max(0), "{:.4f}"))
    lines += [f"| {name} | {' | '.join(f.format(v) for v in values[order])} |" for name, values, f in rows]
    text = (
        f"Largest change of force at a clamp after the adjustment: {np.median(forces):.1f} N in the median cell, "
        f"{max(forces):.1f} N in the worst."
    )
    return [*lines, "| published, largest of 3 | 0.047 | 0.069 | 0.036 | 0.008 | 0.008 | 0.008 |", "", text]


def shape_table(draws: int) -> list[str]:
    lines = [
        f"Shape until all control points are within {TOLERANCE} mm, {draws} cells each.",
        "",
        "| driven axes | before, largest / mm | after 1 / mm | after 2 / mm | corrections needed | "
        "largest force at the end / N | largest force in the plane / N |",
        "|---|---|---|---|---|---|---|",
    ]
    cases = (
        ("z and about x, y; the rest gives way", True, SHAPE_AXES),
        ("z and about x, y; the rest is held", False, SHAPE_AXES),
        ("all six", False, np.ones(6, bool)),
    )
    for name, compliant, axes in cases:
        runs = [shape_run(seed, compliant, axes) for seed in range(draws)]
        at = [max(run.deviations[min(k, len(run.deviations) - 1)].max() for run in runs) for k in range(3)]
        force = max(np.linalg.norm(run.forces[-1][:, 3:], axis=1).max() for run in runs)
        plane = max(np.linalg.norm(run.forces[-1][:, 3:5], axis=1).max() for run in runs)
        steps = max(len(run.deviations) - 1 for run in runs)
        lines.append(f"| {name} | {at[0]:.2f} | {at[1]:.2f} | {at[2]:.2f} | {steps} | {force:.0f} | {plane:.0f} |")
    lines.append("| published | larger | | | not given | table lost | |")
    return lines


def leg_table(draws: int) -> list[str]:
    lines = [
        f"A hidden offset of leg 4 of robot C, {POSES} calibration poses, {draws} cells.",
        "",
        "| offset / mm | robot found | leg found | offset found, mean ± spread / mm | its own sigma / mm | "
        "false alarms in other robots | base error before / mm | after / mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for size in (0.0, 0.2, 0.3, 0.5, 1.0):
        found, right, values, sigmas, wrong, errors = 0, 0, [], [], 0, []
        for seed in range(draws):
            hidden = np.zeros((6, 6))
            hidden[2, 3] = size
            cell = PanelCell(1000 + seed, leg_offsets=hidden)
            readings = read(cell, LaserTracker(cell.tracker))
            for i, reading in enumerate(readings):
                model = calibrate_robot(reading)
                o = find_leg_offset(reading, model, LEGS, 36)
                wrong += o.detected and i != 2
                if i == 2:
                    found, right = found + o.detected, right + (o.detected and o.leg == 4)
                    values, sigmas = [*values, o.offset], [*sigmas, o.sigma]
                    errors.append(_base_errors(cell, reading, model, o))
        b, a = np.sqrt((np.array(errors) ** 2).mean(0))
        mean = f"{np.mean(values):+.3f} ± {np.std(values):.3f} | {np.mean(sigmas):.3f}"
        counts = f"{found} of {draws} | {right} of {draws}"
        lines.append(f"| {size} | {counts} | {mean} | {wrong} of {5 * draws} | {b:.3f} | {a:.3f} |")
    return lines


def _base_errors(cell, reading, model, offset) -> tuple[float, float]:
    """Distance of robot C's base from the truth before and after the finding is used, mm."""
    better = model
    if offset.detected:
        real = true_flanges(LEGS, reading.T_base_flange, [(offset.leg, offset.offset)])
        better = calibrate_robot(replace(reading, T_base_flange=real))
    off = [(frames.inverse(cell.T_world_base[2]) @ m.T_world_base)[:3, 3] for m in (model, better)]
    return tuple(float(np.linalg.norm(v)) for v in off)


def pictures() -> None:
    PICTURES.mkdir(exist_ok=True)
    r = ready_without_panel(0)
    args = r.stage.models, r.T_base_flange, MASTER
    shift = errors_along_motion(*args, np.linspace(0, 100, 11), turn=False)
    turn = errors_along_motion(*args, np.radians(np.linspace(0, 2, 11)), turn=True)
    errors_figure(NAMES, MASTER, shift, turn).savefig(PICTURES / "panel-errors.png", dpi=110)
    try:
        run = shape_run(0, True, SHAPE_AXES, tolerance=0.25)
    except NoResultError:
        run = shape_run(0, True, SHAPE_AXES)
    forces = np.array([np.linalg.norm(f[:, 3:], axis=1).max() for f in run.forces])
    shape_figure(NAMES, run.deviations, TOLERANCE, forces).savefig(PICTURES / "panel-shape.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=30)
    given = parser.parse_args()
    pictures()
    parts = [pose_table(given.draws), shape_table(max(1, given.draws // 3)), leg_table(given.draws), drift_table()]
    text = "\n\n".join("\n".join(part) for part in parts)
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + text + "\n" + END + page.split(END)[1], encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
