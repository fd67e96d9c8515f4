"""What `stitch calibrate robot` writes: robot.toml, robot.urdf and one JSON document."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.calibrate.link_table import LinkTable
from stitch.calibrate.robot_calibration import beyond_sentence, calibrated_robot_of_run, poses_to_add
from stitch.calibrate.robot_table import dh_rows, robot_toml
from stitch.measurement.robot import forward
from stitch.measurement.session import Session
from stitch.reading.reported_pose import has_reported_poses
from stitch.runs.run import Run
from stitch.units import length_text
from stitch.writing.result_document import result_document
from stitch.writing.urdf_file import to_urdf

_HEADER = "The [robot] table of session.toml: put it there in place of the nominal one."


def write_robot(table: LinkTable, run: Run, folder: Path) -> None:
    """robot.toml (for an arm of DH rows) and robot.urdf."""
    (folder / "robot.urdf").write_text(to_urdf(table.robot), encoding="utf-8")
    told = [_HEADER, *robot_notes(table, run)]
    text = robot_toml(table.robot, told, run.session.repeatability)
    if text is not None:
        (folder / "robot.toml").write_text(text, encoding="utf-8")


def robot_notes(table: LinkTable, run: Run) -> list[str]:
    """What the table is worth, what is not in it, and what has to be done so that it counts; a line each."""
    told = [table.sentence(run.session.length_unit), beyond_sentence(calibrated_robot_of_run(run), table.effects)]
    return [*told, *filter(None, [_reported_pose_note(table, run.session)])]


def _reported_pose_note(table: LinkTable, session: Session) -> str:
    """How a session whose controller reports poses comes to use the table; empty where nothing stands in its way."""
    if not table.effects or session.robot is None or not has_reported_poses(session.path / "views.csv"):
        return ""
    poses = [(view.T_base_flange, view.joints) for view in session.views if view.joints is not None]
    off = max(float(np.linalg.norm((T - forward(session.robot, q))[:3, 3])) for T, q in poses)
    return (
        "Take x … qw out of views.csv too: they are the nominal arm's (within "
        f"{length_text(off, session.length_unit, 2)}), and where they stand they are used and no table is."
    )


def robot_document(run: Run, table: LinkTable, notes: list[str], sentence: str) -> dict[str, Any]:
    """The JSON document."""
    result, found = result_document(run), calibrated_robot_of_run(run)
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
            "sentences": robot_notes(table, run),
        },
        "beyond_dh": list(found.beyond),
        "unproved": [name for name in found.held if name not in table.effects],
        "way": notes,
        "left": sentence,
        "next": np.round(poses_to_add(run), 2).tolist(),
    }
