"""The whole line: sphere hand-eye, window and body onto CAD, corrected path, placed window, measured seam.

Writes the error budget of docs/window.md. Everything between simulator and simulator is a command of stitch.

Run: python bench/window_line.py [--seeds N] [--keep FOLDER]
"""

import argparse
import csv
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from data_synth.cells.window_line import EXACT, Errors, WindowLine
from data_synth.cells.window_line_job import write_line, write_seam
from data_synth.cells.window_scans import true_seam
from stitch.cli.main import main as stitch
from stitch.numerics import frames
from stitch.plugins.cells.job_files import poses_from_columns, read_columns
from stitch.plugins.cells.seam import Station

PAGE = Path(__file__).resolve().parents[1] / "docs" / "window.md"
BEGIN, END = "<!-- line: begin -->", "<!-- line: end -->"
ALL = Errors()
# Sphere scans, part scans and moves of the gripper; what is not named is exact.
SOURCES = {
    "nothing: what fit and seam leave by themselves": (EXACT, EXACT, EXACT),
    "the scanner's noise": (EXACT, replace(EXACT, noise=ALL.noise), EXACT),
    "the robot while it scans": (EXACT, replace(EXACT, turn=ALL.turn, shift=ALL.shift), EXACT),
    "the rail while it scans": (EXACT, replace(EXACT, rail=ALL.rail), EXACT),
    "the hand-eye, calibrated with all of them": (ALL, EXACT, EXACT),
    "robot and rail while they grip and place": (EXACT, EXACT, ALL),
    "all together": (ALL, ALL, ALL),
}


@dataclass(frozen=True)
class Outcome:
    """Errors of one line against its truth, mm."""

    hand_eye: float  # at the scanner's standoff
    window: float  # largest over the part's points: found against true pose
    body: float
    placed: float  # largest distance of a point of the window from its design place in the true body
    seam: np.ndarray  # (8, 2) flush and gap, measured less true
    sigma: np.ndarray  # (8, 2) stated
    asked: np.ndarray  # (8, 2) true flush and gap less those of the drawing


def run_line(folder: Path, line: WindowLine) -> Outcome:
    """Scan, calibrate, fit, grip, place, measure; the files stay in the folder."""
    write_line(folder, line)
    if line.sphere_errors == EXACT:
        document = {"hand_eye": line.T_flange_scanner.tolist(), "length_unit": "mm"}
        (folder / "hand-eye.json").write_text(json.dumps(document))
    else:
        command("calibrate", "sphere", folder / "sphere", "-o", folder / "hand-eye.json")
    command("fit", folder / "window.toml", "-o", folder / "found-window")
    command("fit", folder / "body.toml", "-o", folder / "found-body")
    T_cell_window = line.T_cell_window
    line.place(last_pose(folder / "found-window" / "path.csv"), last_pose(folder / "found-body" / "path.csv"))
    write_seam(folder, line)
    command("seam", folder / "seam.toml", "-o", folder / "seam.csv")
    return judge(folder, line, T_cell_window)


def command(*arguments: object) -> None:
    """One command of stitch, as a shell would give it."""
    said = StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            stitch([str(a) for a in arguments])
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"stitch {' '.join(map(str, arguments))}: {said.getvalue()}") from None


def last_pose(path: Path) -> np.ndarray:
    """(4, 4) where a path ends."""
    return poses_from_columns(read_columns(path, "name", "x y z a_deg b_deg c_deg"))[-1]


def judge(folder: Path, line: WindowLine, T_cell_window: np.ndarray) -> Outcome:
    """Everything that was found against what only the simulator knows; T_cell_window (4, 4) is that in the rack."""
    hand_eye = np.array(json.loads((folder / "hand-eye.json").read_text())["hand_eye"])
    place = np.array([[0.0, 0.0, 500.0]])
    off = frames.transform(hand_eye, place) - frames.transform(line.T_flange_scanner, place)
    found = {part: fitted(folder / f"found-{part}" / "fit.json") for part in ("window", "body")}
    T_body_window = frames.inverse(line.T_cell_body) @ line.T_cell_window
    window = line.window_mesh.copy().apply_transform(T_body_window)
    places = [Station("", *v).T_part_station for v in zip(*line.stations(), strict=True)]
    true = np.array([true_seam(window, line.body_mesh, T) for T in places])
    with (folder / "seam.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    measured, sigma = (
        np.array([[float(row[f"{p}flush"]), float(row[f"{p}gap"])] for row in rows]) for p in ("", "sigma_")
    )
    drawn = np.array([true_seam(line.window_mesh, line.body_mesh, T) for T in places])
    return Outcome(
        hand_eye=float(np.linalg.norm(off)),
        window=furthest(found["window"], T_cell_window, line.window_mesh),
        body=furthest(found["body"], line.T_cell_body, line.body_mesh),
        placed=furthest(T_body_window, np.eye(4), line.window_mesh),
        seam=measured - true,
        sigma=sigma,
        asked=true - drawn,
    )


def fitted(file: Path) -> np.ndarray:
    """(4, 4) of a fit.json."""
    return np.array(json.loads(file.read_text())["parts"][0]["T_base_part"])


def furthest(T: np.ndarray, true: np.ndarray, mesh) -> float:
    """Largest distance between where two poses put a point of the part, mm."""
    off = frames.transform(T, mesh.vertices) - frames.transform(true, mesh.vertices)
    return float(np.linalg.norm(off, axis=1).max())


def budget(seeds: int, keep: Path | None) -> list[str]:
    lines = [
        f"{seeds} lines for each row; mm. Rms over the lines, and the largest. A pose counts by the point of its part "
        "that it moves furthest.",
        "",
        "| switched on | hand-eye at 500 mm | window in the rack | body | window set against its design place | "
        "flush and gap set, rms of 8 places | seam measured against its truth, rms | largest |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, (sphere, scans, moves) in SOURCES.items():
        found = []
        for seed in range(seeds):
            with TemporaryDirectory() as scratch:
                folder = keep if keep is not None and name == "all together" and seed == 0 else Path(scratch)
                found.append(run_line(folder, WindowLine(seed, scans, sphere, moves)))
        cells = [_cell([getattr(o, key) for o in found]) for key in ("hand_eye", "window", "body", "placed")]
        asked, seam = (np.array([getattr(o, key) for o in found]) for key in ("asked", "seam"))
        cells += [f"{_rms(asked):.3f}", f"{_rms(seam):.3f}", f"{np.abs(seam).max():.3f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    share = _rms(seam / np.array([o.sigma for o in found]))
    return [*lines, "", f"Seam's error over its stated sigma with all errors, rms: {share:.2f}."]


def _cell(values: list[float]) -> str:
    return f"{_rms(np.array(values)):.3f}, {max(values):.3f}"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--keep", type=Path, help="Folder for the files of one line.")
    given = parser.parse_args()
    text = "\n".join(budget(given.seeds, given.keep))
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + text + "\n" + END + page.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
