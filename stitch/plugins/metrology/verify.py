"""`stitch verify RUN SESSION`: an artefact that no fit has seen judges the model of a run."""

from __future__ import annotations

import csv
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_block, show_table, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.plugins.metrology.verification import Verification

_FAILS = 3  # exit code where the artefact fails


@stdout_for_results
def verify(
    run: RunFolder,
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Scans of an artefact, taken with that cell.")],
    features: Annotated[
        Path | None,
        typer.Option("--features", metavar="TOML", help="Its calibrated features; default SESSION/artefact.toml."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FOLDER", help="For certificate.json and .html; default verify/NAME."),
    ] = None,
    cell: Annotated[
        Path | None, typer.Option("--cell", metavar="CELL", help="Its history says until when the model holds.")
    ] = None,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Verify a run's hand-eye and effects by a calibrated artefact; exit code 3 where it fails or cannot be decided.

    \b
    Examples:
      stitch verify runs/blade-17 sessions/sphere-plate
      stitch verify runs/blade-17 sessions/sphere-plate --cell cells/robot-7
    """
    from stitch.output.json_file import to_json, write_json
    from stitch.output.run_folder import call_entry_points
    from stitch.output.stored_run import read_result, trusted_model
    from stitch.plugins.metrology.verb import judge_artefact
    from stitch.plugins.metrology.verification import verification_document
    from stitch.session.reading.session_folder import load_session

    listed = features or session / "artefact.toml"
    notes = _require_unseen(run, session, Path(read_result(run)["session"]))
    with show_activity("verifying: stitching the artefact under the model"):
        model, _ = trusted_model(run, effects_file, trust)
        result, state = judge_artefact(load_session(session), model, listed)
    document = verification_document(result, state, str(run), str(session), _valid_until(cell), notes)
    folder = output or Path("verify") / state.session.name
    folder.mkdir(parents=True, exist_ok=True)
    write_json(document, folder / "certificate.json")
    call_entry_points("stitch.verify_pages", document, folder / "certificate.html")
    if as_json:
        emit(to_json(document))
    else:
        _show_certificate(result, document, folder)
    if result.passed is not True:
        raise typer.Exit(_FAILS)


def _require_unseen(run: Path, session: Path, fitted: Path) -> tuple[str, ...]:
    """Refuse scans that the model was fitted on: they would judge themselves. Return a note where that is not known."""
    fix = "to fix: name a session of an artefact that no fit has seen"
    if session.resolve() == fitted.resolve():
        raise InputError(f"{session}: {run} was fitted on it; {fix}")
    try:
        known = {_digest(file): file for file in _clouds(fitted)}
    except (OSError, ValueError, csv.Error):
        return (f"{fitted} is not there any more, so that nobody knows whether these scans were fitted.",)
    for file in _clouds(session):
        if (copied := known.get(_digest(file))) is not None:
            raise InputError(f"{file}: is the scan {copied}, on which {run} was fitted; {fix}")
    return ()


def _clouds(session: Path) -> list[Path]:
    from stitch.session.reading.session_folder import TABLES, measured_files

    return [file for file in measured_files(session) if file.name not in TABLES]


def _digest(file: Path) -> bytes:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").digest()


def _valid_until(cell: Path | None) -> str | None:
    """Return until when the calibration in use holds, by a cell's history."""
    if cell is None:
        return None
    from stitch.plugins.watch.exported import iso_time
    from stitch.plugins.watch.history import open_history
    from stitch.plugins.watch.report import cell_report

    with open_history(cell) as history:
        return iso_time(cell_report(history, None).recalibrate_before)


def _show_certificate(result: Verification, document: dict[str, Any], folder: Path) -> None:
    say(result.sentences[0], bold=True)
    # The doubt of the run about a given hand-eye is one of the sentences.
    for sentence in dict.fromkeys((*result.sentences[1:], *document["doubts"])):
        say(sentence)
    rows = [
        (
            n.number.feature.name,
            n.error,
            f"{n.calibrated:.5g}",
            f"{n.deviation:+.2g}",
            f"{n.number.U:.2g}",
            f"{n.E_n:+.2f}",
            "–" if n.limit is None else f"{n.limit:g}",
            ", ".join(n.answers_to).replace("_", "-") or "–",
        )
        for n in result.numbers
    ]
    headings = ("feature", "error of", "calibrated", "deviation", "U", "E_n", "limit", "answers to")
    show_table(f"Calibrated numbers, {result.length_unit}", headings, rows, words=(*headings[:2], headings[-1]))
    forms = [(f.feature, f"{f.form:.2g}", "–" if f.limit is None else f"{f.limit:g}") for f in result.forms]
    show_table(f"Form, 95 % of the points, {result.length_unit}", ("feature", "form", "limit"), forms)
    until = document["valid_until"] or "not known: name the cell's history with --cell"
    show_block([("valid until", until), *(("conditional on", text) for text in document["conditional_on"])])
    say(f"  {folder / 'certificate.html'}")
