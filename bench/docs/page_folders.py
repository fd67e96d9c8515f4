"""What must lie in the folder of a page before its first command runs, and what stands on it beside their output.

Both by the page's name without `.md`.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.docs.compensated_cell import moved_line, truth, write_cell
from bench.docs.page_blocks import ROOT, blocks
from data_synth.commands import synth
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.fixtures.raw_folders import Convention, raw_folder
from data_synth.fixtures.robot_programs import program
from data_synth.fixtures.sphere_scans import sphere_cell, write_spheres
from data_synth.kinematics import flange
from data_synth.scene import load_scene


def raw_scans(folder: Path) -> None:
    """Scans of a blade whose scanner measures too long, and a robot's poses in degrees, in `folder`/scans."""
    cell = folder / "cell"
    synth("blade-table", cell, hide=["range_scale=3"], views=8, seed=3)
    raw_folder(cell, folder / "scans", Convention("ZYX", degrees=True, angles_first=False), "robot_poses.txt")


def small_session(folder: Path) -> None:
    """A session of three views, in `folder`/blade-17."""
    synth("blade", folder / "blade-17", views=3, seed=1)


def planned_views(folder: Path) -> None:
    """Eight poses of a scanner on an arm that nobody has scanned from yet, in `folder`/planned."""
    planned = folder / "planned"
    synth("blade-table", planned, views=8, seed=3)
    shutil.rmtree(planned / "clouds")


def own_effect(folder: Path) -> None:
    """The effect of the page as `folder`/mine.py."""
    page = ROOT / "docs" / "effects.md"
    text = next(block.text for block in blocks(page) if block.language == "python")
    (folder / "mine.py").write_text(text, encoding="utf-8")


def calibrations(folder: Path) -> None:
    """Scans of a sphere, a tracker's frames, a program of a FANUC: sphere, tracker, SCAN1.LS in `folder`."""
    write_spheres(sphere_cell(3, pose_noise=0.03), folder / "sphere")
    probe, *_ = labelled_cell(4, views=30, probe=True)
    write_labelled(folder / "tracker", probe, "frames")
    arm = load_scene("blade").arm
    joints = np.radians([[10, -60, 110, 0, 40, 0], [20, -65, 105, 5, 45, 10]])
    poses = [flange(arm, q[None])[0] for q in joints]
    (folder / "SCAN1.LS").write_text(program("fanuc", [], poses), encoding="utf-8")


def tracked_arm(folder: Path) -> None:
    """An arm with two joints a little off, tracker reflectors on its flange: arm and other-poses in `folder`."""
    offset = np.array([0, 1e-3, -1.5e-3, 0, 0, 0])
    for name, seed in (("arm", 2), ("other-poses", 3)):
        session, *_ = labelled_cell(seed, views=40, offset=offset)
        write_labelled(folder / name, session)


def examples_folder(folder: Path) -> None:
    """The project's `examples`, which the pages of the cells speak of."""
    (folder / "examples").symlink_to(ROOT / "examples")


PREPARE: dict[str, Callable[[Path], None]] = {
    "back-into-the-cell": write_cell,
    "base-to-base": examples_folder,
    "calibrate": calibrations,
    "drilling": examples_folder,
    "effects": own_effect,
    "own-data": raw_scans,
    "panel": examples_folder,
    "plan": planned_views,
    "points": tracked_arm,
    "session": small_session,
    "window": examples_folder,
}


def compensated(text: str, folder: Path) -> str:
    """The page of programs with the line that moved and what the true arm does."""
    text = re.sub(r"(?m)^LIN .*; along$", moved_line(folder), text)
    between = re.compile(r"(?<=<!-- truth: begin -->\n).*?(?=\n<!-- truth: end -->)", re.DOTALL)
    return between.sub(truth(folder), text)


AFTER: dict[str, Callable[[str, Path], str]] = {"back-into-the-cell": compensated}
