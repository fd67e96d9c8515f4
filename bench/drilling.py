"""The simulated drilling experiment over many seeds: writes the tables of docs/drilling.md.

Run: python bench/drilling.py [--seeds N]
"""

import argparse
from pathlib import Path

import numpy as np
from drilling_loop import calibrate_sensors, drive_pose, measure_hole, run_group

from data_synth.cells.drilling import GROUPS, HEIGHT, IMAGE, NINE, DrillingCell, Sizes
from data_synth.cells.drilling_image import render_plate
from stitch.plugins.cells.drilling_sensors import (
    HoleObservations,
    fit_homography,
    leave_one_out,
    select_effects,
    to_plane,
)

PAGE = Path(__file__).resolve().parents[1] / "docs" / "drilling.md"
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
QUANTITIES = ("position 3D / mm", "direction / °", "2D by the camera / mm")
PUBLISHED = {
    "before": ("2.28 to 2.85, mean 2.55", "2.09 to 3.93, mean 3.30", "0.61 to 2.00, mean 1.32"),
    "after": ("≤ 0.30", "≤ 0.21", "0.03 to 0.15, mean 0.08"),
}


def experiment(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Errors (2, 8, 3) before and after, the largest servo step count, and the leave-one-out mean."""
    cell = DrillingCell(seed)
    xyz, uv = cell.plate()
    seeing = calibrate_sensors(xyz, uv, *cell.plane_readings(), HEIGHT)
    found: tuple[list, list] = ([], [])
    steps = []
    for references, targets in GROUPS.values():
        group = run_group(cell.measure, seeing, cell.nominal, references, targets)
        steps += [placed.steps for placed in group.placed.values()]
        for name in targets:
            for rows, T in zip(found, (drive_pose(*cell.nominal[name]), group.drives[name]), strict=True):
                seen = measure_hole(seeing, *cell.measure(name, T))
                rows.append([*cell.errors(name, T), np.hypot(*seen.offset[:2])])
    return np.array(found), np.array(steps), float(np.linalg.norm(leave_one_out(xyz[:, :2], uv), axis=1).mean())


def drilling_table(seeds: int) -> list[str]:
    runs = [experiment(seed) for seed in range(seeds)]
    found = np.array([run[0] for run in runs])  # (seeds, 2, 8, 3)
    steps = np.concatenate([run[1] for run in runs])
    lines = [
        f"{seeds} cells, eight holes each. Position and direction are true errors, which only a simulation knows; "
        "the 2D error is what the camera shows, as in the source.",
        "",
        "| | quantity | smallest | mean | largest | worst hole of a cell, 95 % of cells | source |",
        "|---|---|---|---|---|---|---|",
    ]
    for i, (stage, published) in enumerate(PUBLISHED.items()):
        for j, quantity in enumerate(QUANTITIES):
            values = found[:, i, :, j]
            high = np.quantile(values.max(axis=1), 0.95)
            lines.append(
                f"| {stage} | {quantity} | {values.min():.2f} | {values.mean():.2f} | {values.max():.2f} | "
                f"{high:.2f} | {published[j]} |"
            )
    good = ((found[:, 1, :, 0].max(axis=1) <= 0.30) & (found[:, 1, :, 1].max(axis=1) <= 0.21)).mean()
    text = (
        f"Cells with all eight holes within 0.30 mm and 0.21°: {100 * good:.1f} %. The servo loop took "
        f"{steps.mean():.1f} moves a reference hole, {steps.max()} at most. Leave-one-out error of the homography: "
        f"{np.mean([run[2] for run in runs]):.3f} mm."
    )
    return [*lines, "", text]


def effects_table(seeds: int) -> list[str]:
    lines = [
        "",
        f"Hidden effects, {seeds} cells each: nine plate holes and one hole seen at 75 places and heights. 2D "
        "error on fresh places in the work plane, mean in mm.",
        "",
        "| true k1 | true plate height / mm | named k1 | named plate height | k1 found | plate height found / mm | "
        "2D by homography | 2D with what was named |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for k1, plate in ((0.0, 0.0), (-0.004, 0.0), (0.0, 0.4), (-0.004, 0.4)):
        lines.append(effects_row(k1, plate, seeds))
    return lines


def effects_row(k1: float, plate: float, seeds: int) -> str:
    rows = []
    for seed in range(seeds):
        cell = DrillingCell(seed, Sizes(k1=k1, plate_height=plate))
        (xyz, uv), (at, seen) = cell.plate(), cell.check_holes()
        on_plate = np.arange(len(xyz) + len(at)) < len(xyz)
        selected = select_effects(HoleObservations(np.vstack([xyz, at]), np.vstack([uv, seen]), on_plate, IMAGE))
        named = {t.effect: t.value for t in selected.trials if t.accepted}
        at, seen = cell.check_holes((0.0,))
        errors = [to_plane(fit_homography(xyz[:, :2], uv), seen), selected.camera.plane(seen, at[:, 2])]
        means = [np.linalg.norm(error - at[:, :2], axis=1).mean() for error in errors]
        rows.append([named.get("k1", np.nan), named.get("plate_height", np.nan), *means])
    values = np.array(rows)
    counts = [f"{int(np.isfinite(column).sum())} of {seeds}" for column in values[:, :2].T]
    sizes = [_size(column[np.isfinite(column)], seeds) for column in values[:, :2].T]
    cells = [f"{k1:g}", f"{plate:g}", *counts, *sizes, *(f"{value:.3f}" for value in values[:, 2:].mean(axis=0))]
    return f"| {' | '.join(cells)} |"


def _size(found: np.ndarray, seeds: int) -> str:
    return f"{found.mean():.4f} ± {found.std():.4f}" if len(found) > seeds / 2 else "–"


def image_table(seeds: int) -> list[str]:
    """Needs OpenCV."""
    from stitch.plugins.cells.drilling_sensors import find_holes, order_grid

    errors, left_out = [], []
    for seed in range(seeds):
        cell = DrillingCell(seed)
        found = order_grid(find_holes(render_plate(cell)))
        truth = cell.image(np.column_stack([NINE, np.full(9, HEIGHT)]))
        H = fit_homography(NINE, found)
        errors.append(np.linalg.norm(to_plane(H, truth) - NINE, axis=1))
        left_out.append(np.linalg.norm(leave_one_out(NINE, found), axis=1))
    text = (
        f"Nine holes found by OpenCV in {seeds} rendered images of {IMAGE[0]} x {IMAGE[1]} pixels: the hand-eye is off "
        f"by {np.mean(errors):.4f} mm on average and {np.max(errors):.4f} mm at most; leave-one-out "
        f"{np.mean(left_out):.4f} mm on average."
    )
    return ["", text]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    text = "\n".join([*drilling_table(seeds), *effects_table(seeds), *image_table(5)])
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + text + "\n" + END + page.split(END)[1], encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
