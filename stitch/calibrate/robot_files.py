"""What `stitch calibrate robot` writes: robot.toml, robot.urdf and one JSON document."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.calibrate.link_table import LinkTable
from stitch.calibrate.robot_calibration import beyond_sentence, calibrated, poses_to_add
from stitch.calibrate.robot_table import dh_rows, robot_toml
from stitch.runs.run import Run
from stitch.writing.result_document import result_document
from stitch.writing.urdf_file import to_urdf

_HEADER = "The [robot] table of session.toml: put it there in place of the nominal one."


def write_robot(table: LinkTable, run: Run, folder: Path) -> None:
    """robot.toml (for an arm of DH rows) and robot.urdf."""
    (folder / "robot.urdf").write_text(to_urdf(table.robot), encoding="utf-8")
    told = [_HEADER, table.sentence(run.session.length_unit), beyond_sentence(calibrated(run))]
    text = robot_toml(table.robot, told)
    if text is not None:
        (folder / "robot.toml").write_text(text, encoding="utf-8")


def document_of(run: Run, table: LinkTable, ways: list[str], sentence: str) -> dict[str, Any]:
    """The JSON document."""
    result = result_document(run)
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
        "robot": dh_rows(table.robot),
        "table": {
            "effects": list(table.effects),
            "heldout_rms": table.heldout_rms,
            "nominal_heldout_rms": table.nominal_rms,
            "sentence": table.sentence(run.session.length_unit),
        },
        "beyond_dh": list(calibrated(run).beyond),
        "way": ways,
        "left": sentence,
        "next": np.round(poses_to_add(run), 2).tolist(),
    }
