"""The cell of docs/back-into-the-cell.md: an arm that gives way under load, a program, what the true arm does."""

import json
import os
from contextlib import redirect_stderr
from pathlib import Path

import numpy as np

from data_synth import kinematics
from data_synth.commands import synth
from data_synth.fixtures.true_arm import true_flanges
from data_synth.scene import load_scene
from stitch.cli.main import main as stitch
from stitch.numerics.frames import Array
from stitch.plugins.intake.controllers.program import read_program

BASE, TOOL = "0,0,0,0,0,0", "0,0,150,0,0,0"
PROGRAM = """DEF SCAN ( )
;FOLD SPTP home
PTP {A1 11.0,A2 -68.0,A3 108.0,A4 -17.0,A5 56.0,A6 -70.0}
;ENDFOLD
LIN {X 1250.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; in
LIN {X 1350.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; along
LIN {X 1450.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; out
END
"""


def write_cell(folder: Path) -> None:
    """A run `found` of a cell, and a program `scan.src`, in `folder`."""
    synth("blade", folder / "cell", hide=["joint_compliance=3"], views=10, seed=4)
    with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
        try:
            words = ["--effects", "joint_compliance", "--no-recording"]
            stitch(["run", str(folder / "cell"), "-o", str(folder / "found"), *words])
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError("the run of the example failed") from None
    (folder / "scan.src").write_text(PROGRAM, encoding="utf-8")


def tool_errors(folder: Path, name: str) -> Array:
    """(K,) mm from where the program `scan.src` meant the tool to where the true arm takes it for that of a name."""
    arm, tool = load_scene("blade").arm, np.eye(4)
    tool[2, 3] = float(TOOL.split(",")[2])
    hidden = json.loads((folder / "cell.truth.json").read_text())["hidden"]["joint_compliance"]

    def commanded(program: str) -> Array:
        out: list[Array] = []
        for point in read_program(folder / program, BASE, TOOL).points:
            if point.T_frame_tool is None:
                found = point.joints
            else:
                found = kinematics.inverse(arm, point.T_frame_tool @ np.linalg.inv(tool), out[-1])
            assert found is not None
            out.append(found)
        return np.array(out)

    meant = kinematics.flange(arm, commanded("scan.src")) @ tool
    reached = true_flanges("joint_compliance", hidden, arm, commanded(name)) @ tool
    return np.asarray(np.linalg.norm((reached - meant)[:, :3, 3], axis=1))


def truth(folder: Path) -> str:
    """One sentence."""
    before, after = (tool_errors(folder, name) for name in ("scan.src", "scan-compensated.src"))
    missed, misses = (f"{errors.min():.2f} to {errors.max():.2f} mm" for errors in (before, after))
    return (
        f"The cell is simulated, so its true arm can be asked: it missed the tool's poses by {missed}\n"
        f"with `scan.src`, and misses them by {misses} with the copy."
    )


def moved_line(folder: Path) -> str:
    """One of the program's targets, as the copy has it."""
    copy = (folder / "scan-compensated.src").read_text(encoding="utf-8")
    return next(line for line in copy.splitlines() if "; along" in line)
