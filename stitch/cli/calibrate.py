"""`stitch calibrate …`: hand-eyes from known objects and from trackers, and the arm itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import Force, Json
from stitch.cli.terminal import emit, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.runs.run import Run


# What `stitch calibrate` says: a hand-eye with its sigmas, the rows of an arm, poses to add.


def show_robot(result: Run, document: dict[str, Any], lines: list[str], target: Path) -> None:
    """The way, the history, the rows, the poses to add."""
    from rich.table import Table

    from stitch.cli.change import show_ledger
    from stitch.system.process import console

    terminal = console()
    for line in lines:
        terminal.print(line, soft_wrap=True)
    show_ledger(result)
    corrected = document["table"]["effects"]
    table = Table(title="Corrected DH rows" if corrected else "Nominal DH rows", title_justify="left")
    for heading in ("joint", "a", "alpha (°)", "d", "theta (°)"):
        table.add_column(heading, justify="right")
    for i, row in enumerate(document["robot"] or ()):
        table.add_row(str(i + 1), *(f"{row[key]:.5f}" for key in ("a", "alpha_deg", "d", "theta_deg")))
    if document["robot"]:
        terminal.print(table)
    for line in document["table"]["sentences"]:
        terminal.print(line, soft_wrap=True)
    for pose in document["next"]:
        told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(pose))
        terminal.print(f"A pose that would tell most of the rest: {told}.", soft_wrap=True)
    for name in ("model.toml", "robot.toml", "robot.urdf", "report.html"):
        if (target / name).exists():
            terminal.print(f"  {target / name}", soft_wrap=True)


def show_hand_eye(document: dict[str, Any], facts: list[tuple[str, str]]) -> None:
    """The hand-eye with its sigmas, more facts, and the notes, for people."""
    from rich.table import Table

    from stitch.system.process import console

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
    import numpy as np

    T = np.array(document["hand_eye"])
    sigma = np.array(document["hand_eye_sigma"])
    return [
        (
            "translation",
            f"{length_row(T[:3, 3], unit)} ± {length_row(document['translation_sigma_mount'], unit)} {unit}",
        ),
        ("rotation", "\n".join(" ".join(f"{x:+.6f}" for x in row) for row in T[:3, :3])),
        ("sigma of rotation", f"{', '.join(f'{1e3 * x:.2g}' for x in sigma[:3])} mrad about scanner x, y, z"),
        ("sigma of translation", f"{length_row(sigma[3:], unit)} {unit} along scanner x, y, z"),
    ]


def length_row(values: Any, unit: str = "mm") -> str:
    """Lengths to a micrometre."""
    digits = 6 if unit == "m" else 3
    return ", ".join(f"{x:.{digits}f}" for x in values)


# What `stitch calibrate` does: hand-eyes from a sphere or a tracker, and the arm itself.


def calibrate_by_sphere(session: Path, radius_free: bool, output: Path | None, as_json: bool) -> None:
    """Hand-eye from scans of one sphere.

    Raises:
        InputError, NoResultError: as `stitch calibrate sphere` ends.
    """
    from stitch.calibrate.sphere import calibrate_sphere, sphere_document
    from stitch.reading.session_folder import load_session
    from stitch.writing.json_file import write_json

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
    import numpy as np

    from stitch.calibrate.tracker import calibrate_tracker, tracker_document
    from stitch.reading.session_folder import load_session

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
    from stitch.calibrate.robot import calibrated_robot_of_run, link_table, robot_document, write_robot
    from stitch.cli.diagnose import write_diagnosis
    from stitch.pipeline import run, suggest
    from stitch.reading.session_folder import load_session
    from stitch.writing import run_folder
    from stitch.writing.json_file import to_json

    loaded = load_session(session)
    first = run(loaded)
    calibrated_robot_of_run(first)
    found, lines, diagnosis = suggest(first, at_most)
    result = found or first
    target = output or Path("runs") / f"{loaded.name}-robot"
    with run_folder.new_folder(target, [session], force) as scratch:
        run_folder.write_with_page(result, scratch)
        table = link_table(loaded)
        write_robot(table, result, scratch)
        write_diagnosis(diagnosis, result, scratch)
    document = robot_document(result, table, lines, diagnosis.sentence)
    if as_json:
        emit(to_json(document))
    else:
        show_robot(result, document, lines, target)


calibrate = typer.Typer(
    help="Find hand-eyes from known objects and from trackers, and an arm's own errors.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
_SESSION = Annotated[Path, typer.Argument(metavar="SESSION", help="Session folder.")]


@calibrate.command()
@stdout_for_results
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

    calibrate_by_sphere(session, radius_free, output, as_json)


@calibrate.command()
@stdout_for_results
def tracker(session: _SESSION, as_json: Json = False) -> None:
    """Base and tool from frames.csv: a tracker and its 6D probe, or a camera and its board.

    \b
    Examples:
      stitch calibrate tracker probe-session --json
    """

    calibrate_by_tracker(session, as_json)


@calibrate.command()
@stdout_for_results
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

    calibrate_arm(session, output, force=force, at_most=at_most, as_json=as_json)
