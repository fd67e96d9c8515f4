"""What `stitch calibrate` does: hand-eyes from a sphere or a tracker, and the arm itself."""

import json
from pathlib import Path

import numpy as np

from stitch.calibrate.link_table import link_table
from stitch.calibrate.robot_calibration import calibrated_robot_of_run
from stitch.calibrate.robot_files import robot_document, write_robot
from stitch.calibrate.sphere_calibration import calibrate_sphere
from stitch.calibrate.sphere_report import sphere_document
from stitch.calibrate.tracker_calibration import calibrate_tracker, tracker_document
from stitch.cli.actions.diagnosed_run import write_diagnosis
from stitch.cli.terminal.calibration_summary import length_row, show_hand_eye, show_robot
from stitch.cli.terminal.streams import emit
from stitch.pipeline import run
from stitch.reading.session_folder import load_session
from stitch.runs.state import state_of
from stitch.stepwise import suggest
from stitch.writing import run_folder
from stitch.writing.json_file import to_json, write_json


def calibrate_by_sphere(session: Path, radius_free: bool, output: Path | None, as_json: bool) -> None:
    """Hand-eye from scans of one sphere.

    Raises:
        InputError, NoResultError: as `stitch calibrate sphere` ends.
    """
    loaded = load_session(session, at_most=None)
    document = sphere_document(calibrate_sphere(loaded, radius_free), loaded)
    if output is not None:
        write_json(document, output)
    if as_json:
        emit(json.dumps(document, indent=1))
        return
    unit, radius = document["length_unit"], document["radius"]
    facts = [
        (
            "sphere's centre",
            f"{length_row(document['centre'], unit)} ± {length_row(document['centre_sigma'], unit)} {unit}",
        ),
        ("radius", f"{radius['used']:.6g} {unit}"),
        (
            "points from the sphere",
            f"{document['rms']:#.3g} {unit} rms, noise within a scan {document['point_sigma']:#.3g}",
        ),
        ("start", document["start"]),
    ]
    show_hand_eye(document, facts)


def calibrate_by_tracker(session: Path, as_json: bool) -> None:
    """Base and tool from frames.csv.

    Raises:
        InputError, NoResultError: as `stitch calibrate tracker` ends.
    """
    loaded = load_session(session)
    document = tracker_document(calibrate_tracker(loaded), loaded)
    if as_json:
        emit(json.dumps(document, indent=1))
        return
    unit, other, heldout = document["length_unit"], document["other"], document["heldout_position_error"]
    facts = [
        (
            other["name"],
            f"{length_row(np.array(other['transform'])[:3, 3], unit)} ± {length_row(other['sigma'][3:], unit)} {unit}",
        ),
        ("views", f"{document['views']}, turned by up to {document['turned_deg']:.0f}°"),
        ("position error", f"{heldout['mean']:.4g} {unit} mean of views left out, at most {heldout['max']:.4g}"),
        ("rotation error", f"{document['heldout_rotation_error_deg']['mean']:.4f} ° mean of views left out"),
    ]
    show_hand_eye(document, facts)


def calibrate_arm(session: Path, output: Path | None, *, force: bool, at_most: int, as_json: bool) -> None:
    """What the arm's nominal model lacks.

    Raises:
        InputError, NoResultError: as `stitch calibrate robot` ends.
    """
    loaded = load_session(session)
    first = run(loaded)
    calibrated_robot_of_run(first)
    found, lines, diagnosis = suggest(state_of(first), at_most)
    result = found or first
    target = output or Path("runs") / f"{loaded.name}-robot"
    with run_folder.new_folder(target, [session], force) as scratch:
        run_folder.write_with_page(result, scratch)
        table = link_table(loaded)
        write_robot(table, result, scratch)
        write_diagnosis(diagnosis, state_of(result), scratch)
    document = robot_document(result, table, lines, diagnosis.sentence)
    if as_json:
        emit(to_json(document))
    else:
        show_robot(result, document, lines, target)
