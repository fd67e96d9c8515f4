"""`stitch calibrate …`: hand-eyes from known objects and from trackers, and the arm itself."""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from stitch.calibrate.robot_calibration import calibrated
from stitch.calibrate.robot_files import beyond_sentence, write_robot
from stitch.calibrate.robot_files import document_of as robot_document
from stitch.calibrate.sphere_calibration import calibrate_sphere
from stitch.calibrate.sphere_report import document_of
from stitch.calibrate.tracker_calibration import calibrate_tracker
from stitch.calibrate.tracker_calibration import document_of as tracker_document
from stitch.cli.change import show_ledger
from stitch.cli.diagnose import write_diagnosis
from stitch.cli.options import Force, Json
from stitch.cli.streams import emit, results_alone
from stitch.errors import InputError
from stitch.pipeline import run
from stitch.reading.session_folder import load_session
from stitch.runs.run import Run
from stitch.runs.state import state_of
from stitch.stepwise import suggest
from stitch.system.console import console
from stitch.writing import run_folder
from stitch.writing.json_file import to_json, write_json

calibrate = typer.Typer(
    help="Find hand-eyes from known objects and from trackers, and an arm's own errors.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
_SESSION = Annotated[Path, typer.Argument(metavar="SESSION", help="Session folder.")]


@calibrate.command()
@results_alone
def sphere(
    session: _SESSION,
    radius_free: Annotated[bool, typer.Option("--radius-free", help="Fit the sphere's radius too.")] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write the JSON there.")] = None,
    as_json: Json = False,
) -> None:
    """Hand-eye from laser-line or area scans of one sphere of known radius.

    \b
    Examples:
      stitch calibrate sphere ball-session
      stitch calibrate sphere ball-session --radius-free -o hand-eye.json
    """
    if output is not None and output.exists() and output.suffix != ".json":
        raise InputError(f"{output}: exists and is no JSON file; name another, or remove it")
    loaded = load_session(session)
    document = document_of(calibrate_sphere(loaded, radius_free), loaded)
    if output is not None:
        write_json(document, output)
    if as_json:
        emit(json.dumps(document, indent=1))
        return
    unit, radius = document["length_unit"], document["radius"]
    facts = [
        ("sphere's centre", f"{_row(document['centre'], unit)} ± {_row(document['centre_sigma'], unit)} {unit}"),
        ("radius", f"{radius['used']:.6g} {unit}"),
        (
            "points from the sphere",
            f"{document['rms']:#.3g} {unit} rms, noise within a scan {document['point_sigma']:#.3g}",
        ),
        ("start", document["start"]),
    ]
    show(document, facts)


@calibrate.command()
@results_alone
def tracker(session: _SESSION, as_json: Json = False) -> None:
    """Base and tool from frames.csv: a tracker and its 6D probe, or a camera and its board.

    \b
    Examples:
      stitch calibrate tracker probe-session --json
    """
    loaded = load_session(session)
    document = tracker_document(calibrate_tracker(loaded), loaded)
    if as_json:
        emit(json.dumps(document, indent=1))
        return
    unit, other, heldout = document["length_unit"], document["other"], document["heldout_position_error"]
    facts = [
        (other["name"], f"{_row(np.array(other['transform'])[:3, 3], unit)} ± {_row(other['sigma'][3:], unit)} {unit}"),
        ("views", f"{document['views']}, turned by up to {document['turned_deg']:.0f}°"),
        ("position error", f"{heldout['mean']:.4g} {unit} mean of views left out, at most {heldout['max']:.4g}"),
        ("rotation error", f"{document['heldout_rotation_error_deg']['mean']:.4f} ° mean of views left out"),
    ]
    show(document, facts)


@calibrate.command()
@results_alone
def robot(
    session: _SESSION,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT", help="Run folder; default runs/NAME-robot.")
    ] = None,
    force: Force = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Largest number of effects.")] = 8,
    as_json: Json = False,
) -> None:
    """Kinematic calibration: what the arm's nominal model lacks, as model, corrected DH rows and URDF.

    \b
    Examples:
      stitch calibrate robot reflector-session -o runs/arm
    """
    loaded = load_session(session)
    first = run(loaded)
    calibrated(first)
    found, lines, diagnosis = suggest(state_of(first), at_most)
    result = found or first
    target = output or Path("runs") / f"{loaded.name}-robot"
    with run_folder.new_folder(target, [session], force) as scratch:
        run_folder.write_with_page(result, scratch)
        write_robot(result, calibrated(result), scratch)
        write_diagnosis(diagnosis, state_of(result), scratch)
    document = robot_document(result, lines, diagnosis.sentence)
    if as_json:
        emit(to_json(document))
    else:
        _show_robot(result, document, lines, target)


def _show_robot(result: Run, document: dict[str, Any], lines: list[str], target: Path) -> None:
    """The way, the history, the rows, the poses to add."""
    terminal = console()
    for line in lines:
        terminal.print(line, soft_wrap=True)
    show_ledger(result)
    table = Table(title="Corrected DH rows", title_justify="left")
    for heading in ("joint", "a", "alpha (°)", "d", "theta (°)"):
        table.add_column(heading, justify="right")
    for i, row in enumerate(document["robot"] or ()):
        table.add_row(str(i + 1), *(f"{row[key]:.5f}" for key in ("a", "alpha_deg", "d", "theta_deg")))
    if document["robot"]:
        terminal.print(table)
    terminal.print(beyond_sentence(calibrated(result)), soft_wrap=True)
    for pose in document["next"]:
        told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(pose))
        terminal.print(f"A pose that would tell most of the rest: {told}.", soft_wrap=True)
    for name in ("model.toml", "robot.toml", "robot.urdf", "report.html"):
        if (target / name).exists():
            terminal.print(f"  {target / name}", soft_wrap=True)


def show(document: dict[str, Any], facts: list[tuple[str, str]]) -> None:
    """The hand-eye with its sigmas, more facts, and the notes, for people."""
    terminal, unit = console(), document["length_unit"]
    mount = "flange" if document["mount"] == "eye_in_hand" else "base"
    table = Table(title=f"{document['session']}: T_{mount}_scanner", title_justify="left", show_header=False)
    for name, text in [*hand_eye_rows(document, unit), *facts]:
        table.add_row(name, text)
    terminal.print(table)
    for note in document["notes"]:
        terminal.print(f"{note}.", soft_wrap=True)


def hand_eye_rows(document: dict[str, Any], unit: str) -> list[tuple[str, str]]:
    """Translation in the mount's axes, rotation matrix, sigmas in both frames."""
    T = np.array(document["hand_eye"])
    sigma = np.array(document["hand_eye_sigma"])
    return [
        ("translation", f"{_row(T[:3, 3], unit)} ± {_row(document['translation_sigma_mount'], unit)} {unit}"),
        ("rotation", "\n".join(" ".join(f"{x:+.6f}" for x in row) for row in T[:3, :3])),
        ("sigma of rotation", f"{', '.join(f'{1e3 * x:.2g}' for x in sigma[:3])} mrad about scanner x, y, z"),
        ("sigma of translation", f"{_row(sigma[3:], unit)} {unit} along scanner x, y, z"),
    ]


def _row(values: Any, unit: str = "mm") -> str:
    """Lengths to a micrometre."""
    digits = 6 if unit == "m" else 3
    return ", ".join(f"{x:.{digits}f}" for x in values)
