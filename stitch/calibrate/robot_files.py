"""What `stitch calibrate robot` writes: robot.toml, robot.urdf and one JSON document."""

from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from stitch.calibrate.robot_calibration import CalibratedRobot, calibrated, dh_rows, poses_to_add
from stitch.runs.run import Run
from stitch.writing.result_document import result_document
from stitch.writing.urdf_file import to_urdf

_HEADER = """# The [robot] table of session.toml with the offsets and link errors that were found: put it there in place
# of the nominal one. {beyond}
"""


def write_robot(found: CalibratedRobot, folder: Path) -> None:
    """robot.toml (for an arm of DH rows) and robot.urdf."""
    (folder / "robot.urdf").write_text(to_urdf(found.robot), encoding="utf-8")
    table = robot_toml(found)
    if table is not None:
        (folder / "robot.toml").write_text(table, encoding="utf-8")


def robot_toml(found: CalibratedRobot) -> str | None:
    """The [robot] table of session.toml, commented; None for an arm that came as URDF."""
    rows = dh_rows(found.robot)
    if rows is None:
        return None
    table: dict[str, Any] = {
        "name": found.robot.name,
        "dh": found.robot.convention,
        "gravity": found.robot.gravity.tolist(),
        "joints": rows,
    }
    if found.robot.payload_mass:
        table["payload"] = {"mass": found.robot.payload_mass, "com": found.robot.payload_com.tolist()}
    return _HEADER.format(beyond=beyond_sentence(found)) + tomli_w.dumps({"robot": table})


def beyond_sentence(found: CalibratedRobot) -> str:
    """What the table cannot hold."""
    if not found.beyond:
        return "No other error of the arm was found."
    return f"Not in it, because no table of links can hold it: {', '.join(found.beyond)}; model.toml has it."


def document_of(run: Run, ways: list[str], sentence: str) -> dict[str, Any]:
    """The JSON document."""
    found, result = calibrated(run), result_document(run)
    steps = [
        {"effects": list(s.effects), "residual_rms": s.residual_rms, "heldout_rms": s.heldout_rms} for s in run.ledger
    ]
    return {
        "format": "stitch-calibrate/1",
        "kind": "robot",
        "session": run.session.name,
        "length_unit": run.session.length_unit,
        "steps": steps,
        **{key: result[key] for key in ("residual_rms", "heldout_rms", "noise_floor", "effects", "targets", "notes")},
        "outliers": result.get("outliers", []),
        "robot": dh_rows(found.robot),
        "beyond_dh": list(found.beyond),
        "way": ways,
        "left": sentence,
        "next": np.round(poses_to_add(run), 2).tolist(),
    }
