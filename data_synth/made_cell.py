"""Whole cells by their names: what a command of a cell reads, or several sessions, and the truth beside them."""

import json
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_synth.cells import drilling_job, panel_job, window_line_job
from data_synth.cells.base_stand import TwoBases
from data_synth.cells.drilling import DrillingCell, Sizes
from data_synth.cells.panel import NAMES
from data_synth.cells.window_line import WindowLine
from data_synth.fixtures.sphere_scans import sphere_cell, write_spheres
from data_synth.made_session import truth_path
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import truth_of, write_session
from stitch.system.files import sync_to_disk
from stitch.system.process import console

Array = NDArray[np.float64]
Truth = dict[str, Any]
_LINE = (
    "stitch calibrate sphere FOLDER/sphere -o FOLDER/hand-eye.json",
    "stitch fit FOLDER/window.toml -o FOLDER/found-window",
    "stitch fit FOLDER/body.toml -o FOLDER/found-body",
    "stitch seam FOLDER/seam.toml -o seam.csv",
)


class Made(NamedTuple):
    """A way to make a cell: what it writes, and how to go on, with FOLDER for where."""

    write: Callable[[Path, int], Truth]
    next_commands: tuple[str, ...]


def make_cell(name: str, out: Path, seed: int, truth: Path | None) -> None:
    """Write a cell's folder, whole or not at all, and its truth; say how to go on."""
    target = truth or truth_path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as scratch:
        made = Path(scratch) / "cell"
        made.mkdir()
        known = CELLS[name].write(made, seed)
        sync_to_disk(made)
        made.rename(out)
    target.parent.mkdir(parents=True, exist_ok=True)
    document = {"scene": name, "seed": seed, **known}
    target.write_text(json.dumps(document, indent=1, default=_plain) + "\n", encoding="utf-8")
    terminal = console()
    terminal.print(f"{name} → {out}\ntruth → {target}", soft_wrap=True)
    for command in CELLS[name].next_commands:
        terminal.print(f"Next: {command.replace('FOLDER', str(out))}", soft_wrap=True)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def _drilling(folder: Path, seed: int) -> Truth:
    """A lens with distortion and a plate that is a little too high, both unknown to the job."""
    cell = DrillingCell(seed, Sizes(k1=-0.004, plate_height=0.3))
    T_measuring_base = drilling_job.write_job(folder, cell)
    drilling_job.write_trials(folder, cell)
    holes = {name: {"position": p, "direction": d} for name, (p, d) in cell.actual.items()}
    return {"T_measuring_base": T_measuring_base, "holes": holes, "hidden": {"k1": -0.004, "plate_height": 0.3}}


def _panel(folder: Path, seed: int) -> Truth:
    cell = panel_job.cell_with_a_leg_off(seed)
    panel_job.write_cell(folder, cell)
    robot, leg = np.unravel_index(np.abs(cell.leg_offsets).argmax(), cell.leg_offsets.shape)
    return {
        "T_world_base": cell.T_world_base,
        "T_world_panel": cell.pose,
        "hidden": {"robot": NAMES[robot], "leg": int(leg) + 1, "offset": cell.leg_offsets[robot, leg]},
    }


def _two_bases(folder: Path, seed: int) -> Truth:
    cell = TwoBases(seed)
    cell.write(folder / "stand.toml")
    return {"T_base1_base2": cell.T_base1_base2, "T_base1_stand": cell.T_base1_stand, "length_unit": "m"}


def _sphere_lines(folder: Path, seed: int) -> Truth:
    """A line scanner before a sphere: two more positions of one orientation, then twelve orientations."""
    cell = sphere_cell(seed)
    write_spheres(cell, folder / "sphere")
    return {"hand_eye": cell.T_mount, "centre": cell.centre}


def _window_line(folder: Path, seed: int, sweeps: bool = False) -> Truth:
    """The window is set where the true places say, with the robot's own errors, and the seam is scanned."""
    line = WindowLine(seed, sweeps=sweeps)
    window_line_job.write_line(folder, line)
    truth = {
        "hand_eye": line.T_flange_scanner,
        "T_cell_window": line.T_cell_window,
        "T_cell_body": line.T_cell_body,
    }
    line.place(line.T_cell_window @ line.T_window_tool, line.T_cell_body @ line.T_window_tool)
    window_line_job.write_seam(folder, line)
    return {**truth, "T_cell_window_set": line.T_cell_window}


def _two_sessions(folder: Path, seed: int) -> Truth:
    """One cell on two days: other views, climate and scatter, the same arm, scanner and hand-eye."""
    scene = load_scene("blade")
    days = {name: simulate(scene, {}, seed, day=day) for day, name in enumerate(("first", "second"))}
    for name, measured in days.items():
        write_session(folder / name, measured, name)
    return {name: truth_of(measured) for name, measured in days.items()}


CELLS = {
    "drilling": Made(_drilling, ("stitch drill FOLDER/job.toml --report page.html",)),
    "panel-robots": Made(
        _panel,
        (
            "stitch panel FOLDER/job.toml -o commands",
            "stitch panel FOLDER/job.toml -o moves "
            '--drive "python -m data_synth.cells.panel_job FOLDER moves/shape_move.csv"',
        ),
    ),
    "two-bases": Made(_two_bases, ("stitch base FOLDER/stand.toml",)),
    "sphere-lines": Made(_sphere_lines, ("stitch calibrate sphere FOLDER/sphere -o hand-eye.json",)),
    "window-line": Made(_window_line, _LINE),
    "window-sweeps": Made(partial(_window_line, sweeps=True), _LINE),
    "two-sessions": Made(_two_sessions, ("stitch run FOLDER/first FOLDER/second",)),
}
