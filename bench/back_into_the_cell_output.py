"""Run the example of docs/back-into-the-cell.md and write what it prints: python -m bench.back_into_the_cell_output.

A blade cell whose arm gives way under load is simulated and run with that effect in the model; the page's commands
take its results back into the cell.
"""

import json
import os
import re
import tempfile
from contextlib import redirect_stderr
from pathlib import Path

import numpy as np

from bench.readme_output import BEGIN, END, commands, printed, shown
from data_synth import kinematics
from data_synth.commands import synth
from data_synth.fixtures.true_arm import true_flanges
from data_synth.scene import load_scene
from stitch.cli.main import main as stitch
from stitch.controllers.program import read_program
from stitch.frames import Array

BASE, TOOL = "0,0,0,0,0,0", "0,0,150,0,0,0"
TRUTH = re.compile(r"(?<=<!-- truth: begin -->\n).*?(?=\n<!-- truth: end -->)", re.DOTALL)
PAGE = Path(__file__).resolve().parents[1] / "docs" / "back-into-the-cell.md"
PROGRAM = """DEF SCAN ( )
;FOLD SPTP home
PTP {A1 11.0,A2 -68.0,A3 108.0,A4 -17.0,A5 56.0,A6 -70.0}
;ENDFOLD
LIN {X 1250.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; in
LIN {X 1350.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; along
LIN {X 1450.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; out
END
"""


def prepare(folder: Path) -> None:
    """A run `found` of a cell, and a program `scan.src`, in `folder`."""
    synth("blade", folder / "cell", hide=["joint_compliance=3"], views=10, seed=4)
    with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
        try:
            stitch(
                [
                    "run",
                    str(folder / "cell"),
                    "-o",
                    str(folder / "found"),
                    "--effects",
                    "joint_compliance",
                    "--no-recording",
                ]
            )
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


def main() -> None:
    """Write the example into the page, and what the true arm does."""
    example, text = shown(PAGE), PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        anew = printed(commands(example), folder)
        told = truth(folder)
        line = next(x for x in (folder / "scan-compensated.src").read_text().splitlines() if "; along" in x)
    text = text.replace(BEGIN + example + END, BEGIN + anew + END)
    text = re.sub(r"(?m)^LIN .*; along$", line, text)
    PAGE.write_text(TRUTH.sub(told, text), encoding="utf-8")


if __name__ == "__main__":
    main()
