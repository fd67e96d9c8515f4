"""`stitch calibrate …`: hand-eyes from known objects and from trackers, and the arm itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import Force, Json
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_block, show_files, show_table, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.run_data import RunData

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
    from stitch.output.json_file import write_json
    from stitch.plugins.metrology.calibrate.sphere import calibrate_sphere, sphere_document
    from stitch.session.axis_poses import require_placed
    from stitch.session.reading.session_folder import load_session

    if output is not None and output.exists() and output.suffix != ".json":
        raise InputError(f"{output}: exists and is no JSON file; to fix: name another, or remove it")
    with show_activity("calibrating by a sphere"):
        loaded = load_session(session, at_most=None)
        require_placed(loaded)
        document = sphere_document(calibrate_sphere(loaded, radius_free), loaded)
    if output is not None:
        write_json(document, output)
    if as_json:
        emit(json.dumps(document, indent=1))
        return
    unit, radius = document["length_unit"], document["radius"]
    noise = f"noise within a scan {document['point_sigma']:#.3g}"
    _show_hand_eye(
        document,
        [
            ("sphere's centre", _lengths_with_sigma(document["centre"], document["centre_sigma"], unit)),
            ("radius", f"{radius['used']:.6g} {unit}"),
            ("points from the sphere", f"{document['rms']:#.3g} {unit} rms, {noise}"),
            ("start", document["start"]),
        ],
    )


@calibrate.command()
@stdout_for_results
def tracker(session: _SESSION, as_json: Json = False) -> None:
    """Base and tool from frames.csv: a tracker and its 6D probe, or a camera and its board.

    \b
    Examples:
      stitch calibrate tracker probe-session --json
    """
    import numpy as np

    from stitch.plugins.metrology.calibrate.tracker import calibrate_tracker, tracker_document
    from stitch.session.axis_poses import require_placed
    from stitch.session.reading.session_folder import load_session

    loaded = load_session(session)
    require_placed(loaded)
    document = tracker_document(calibrate_tracker(loaded), loaded)
    if as_json:
        emit(json.dumps(document, indent=1))
        return
    unit, other, heldout = document["length_unit"], document["other"], document["heldout_position_error"]
    _show_hand_eye(
        document,
        [
            (other["name"], _lengths_with_sigma(np.array(other["transform"])[:3, 3], other["sigma"][3:], unit)),
            ("views", f"{document['views']}, turned by up to {document['turned_deg']:.0f}°"),
            ("position error", f"{heldout['mean']:.4g} {unit} mean of views left out, at most {heldout['max']:.4g}"),
            ("rotation error", f"{document['heldout_rotation_error_deg']['mean']:.4f} ° mean of views left out"),
        ],
    )


@calibrate.command()
@stdout_for_results
def robot(
    session: _SESSION,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT", help="Run folder; default runs/NAME-robot.")
    ] = None,
    force: Force = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Largest number of effects.")] = 8,
    on: Annotated[
        list[Path] | None,
        typer.Option("--on", metavar="SESSION", help="Another session of this arm, on which the model has to hold."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Kinematic calibration: what the arm's nominal model lacks, as model, corrected DH rows and URDF.

    Of the effects that are found, those stay that make no session worse of those that are named with --on.

    \b
    Examples:
      stitch calibrate robot reflector-session -o runs/arm
      stitch calibrate robot monday --on tuesday --on friday -o runs/arm
    """
    from stitch.api.pipeline import run
    from stitch.api.stepwise import suggest
    from stitch.cli.diagnose import write_diagnosis
    from stitch.output.json_file import to_json
    from stitch.output.run_folder import new_folder, write_with_page
    from stitch.plugins.metrology.calibrate.other_sessions import keep_what_holds
    from stitch.plugins.metrology.calibrate.robot import (
        calibrated_robot_of_run,
        link_table,
        robot_document,
        write_robot,
    )
    from stitch.session.reading.session_folder import load_session

    with show_activity("calibrating the arm"):
        loaded = load_session(session)
        others = [load_session(folder) for folder in on or ()]
        first = run(loaded)
        calibrated_robot_of_run(first)
        found, lines, diagnosis = suggest(first, at_most)
        result, proved = keep_what_holds(found or first, others)
    target = output or Path("runs") / f"{loaded.name}-robot"
    with new_folder(target, [session], force) as scratch:
        write_with_page(result, scratch)
        table = link_table(loaded, others)
        write_robot(table, result, scratch, proved)
        write_diagnosis(diagnosis, result, scratch)
    document = robot_document(result, table, lines, diagnosis.sentence, proved)
    if as_json:
        emit(to_json(document))
    else:
        show_robot(result, document, lines, target)


def show_robot(result: RunData, document: dict[str, Any], lines: list[str], target: Path) -> None:
    """Print the way, the result, the rows of the arm, and poses to add."""
    from stitch.cli.run import show_report

    for line in lines:
        say(line)
    show_report(result)
    if document["robot"]:
        show_table(
            "Corrected DH rows" if document["table"]["effects"] else "Nominal DH rows",
            ("joint", "a", "alpha (°)", "d", "theta (°)"),
            [
                (str(i + 1), *(f"{row[key]:.5f}" for key in ("a", "alpha_deg", "d", "theta_deg")))
                for i, row in enumerate(document["robot"])
            ],
        )
    for line in [*document["proved"], *document["table"]["sentences"]]:
        say(line)
    for pose in document["next"]:
        told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(pose))
        say(f"A pose that would tell most of the rest: {told}.")
    show_files(target, ("model.toml", "robot.toml", "robot.urdf", "report.html"))


def _show_hand_eye(document: dict[str, Any], facts: list[tuple[str, str]]) -> None:
    """Print the hand-eye with its sigmas, more facts, and the notes."""
    import numpy as np

    unit, sigma = document["length_unit"], np.array(document["hand_eye_sigma"])
    T, mount = np.array(document["hand_eye"]), "flange" if document["mount"] == "eye_in_hand" else "base"
    say(f"{document['session']}: T_{mount}_scanner", bold=True)
    show_block(
        [
            ("translation", _lengths_with_sigma(T[:3, 3], document["translation_sigma_mount"], unit)),
            ("rotation", "\n".join(" ".join(f"{x:+.6f}" for x in row) for row in T[:3, :3])),
            ("sigma of rotation", f"{', '.join(f'{1e3 * x:.2g}' for x in sigma[:3])} mrad about scanner x, y, z"),
            ("sigma of translation", f"{_lengths(sigma[3:], unit)} {unit} along scanner x, y, z"),
            *facts,
        ]
    )
    for note in document["notes"]:
        say(f"{note}.")


def _lengths_with_sigma(values: Any, sigma: Any, unit: str) -> str:
    return f"{_lengths(values, unit)} ± {_lengths(sigma, unit)} {unit}"


def _lengths(values: Any, unit: str) -> str:
    """Return lengths to a micrometre."""
    digits = 6 if unit == "m" else 3
    return ", ".join(f"{x:.{digits}f}" for x in values)
