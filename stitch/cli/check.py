"""`stitch check SESSION`: read everything, compute nothing, say what is there or what is wrong."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import Json
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_block
from stitch.errors import InputError, ScaleError

if TYPE_CHECKING:
    from stitch.screening.problems import SessionProblem


def check(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Session folders.")],
    deep: Annotated[
        bool, typer.Option("--deep", help="Also try out what people do wrong: pairing, conventions, units, views.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Read sessions completely and say what is wrong; computes nothing unless asked to look deeper.

    \b
    Examples:
      stitch check blade-17
      stitch check --deep blade-17 --json
    """
    if deep:
        _check_deeply(sessions, as_json)
    else:
        _check_readable(sessions, as_json)


def _check_readable(sessions: list[Path], as_json: bool) -> None:
    """Print what sessions hold, and why others cannot be read; exit code 2 if there are such."""
    from stitch.api.check import session_summary
    from stitch.session.reading.session_folder import load_session

    summaries: list[dict[str, Any]] = []
    errors: list[str] = []
    for path in sessions:
        try:
            summaries.append(session_summary(load_session(path)))
        except InputError as error:
            errors.append(error.command_line)
    if as_json:
        emit(json.dumps({"sessions": summaries, "errors": errors}, indent=1))
    else:
        for summary in summaries:
            say(f"{summary['session']}: readable", bold=True)
            show_block(_summary_rows(summary))
    for line in errors:
        say(f"stitch: {line}", stream=sys.stderr)
    if errors:
        raise typer.Exit(2)


def _check_deeply(sessions: list[Path], as_json: bool) -> None:
    """Search each session for usual mistakes and print those found.

    Exit code 2 if a session cannot be read, or if a mistake is certain.
    """
    from stitch.output.json_file import to_json

    with show_activity("trying the usual mistakes"):
        checked = [(str(path), *_problems_of(path)) for path in sessions]
    if as_json:
        documents = [
            {"session": path, "ok": not problems and not unread, "problems": [p.as_dict() for p in problems]}
            | ({"errors": [unread]} if unread else {})
            for path, _, problems, unread in checked
        ]
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        for path, names, problems, unread in checked:
            lines = [p.line(names) for p in problems]
            if not lines and not unread:
                lines = ["nothing wrong was found"]
            for line in lines:
                say(f"{path}: {line}", hang=2)
    for *_, unread in checked:
        if unread:
            say(f"stitch: {unread}", stream=sys.stderr)
    if any(unread or any(p.certain for p in problems) for _, _, problems, unread in checked):
        raise typer.Exit(2)


def _problems_of(path: Path) -> tuple[Sequence[str], list[SessionProblem], str]:
    """Return names of a session's views, the problems found, and an error line if it cannot be read, else "".

    A wrong length unit is found while reading; it counts as a problem.
    """
    from stitch.screening.deep_check import deep_check
    from stitch.screening.problems import SessionProblem
    from stitch.session.reading.session_folder import load_session

    try:
        session = load_session(path)
    except ScaleError as error:
        return error.views, [SessionProblem("unit", error.views, error.command_line)], ""
    except InputError as error:
        return (), [], error.command_line
    return session.names, deep_check(session), ""


def _summary_rows(fact: dict[str, Any]) -> list[tuple[str, str]]:
    """Return rows (name, text) of what `session_summary` returns, for people; rows without text are left out."""
    carried = "the scanner" if fact["mount"] == "eye_in_hand" else "the part"
    unit, far = fact["length_unit"], fact["median_range"]
    rows = [
        ("mount", f"{fact['mount']}: {carried} sits at the flange"),
        ("length unit", unit),
        ("views", str(fact["views"])),
        ("scanned points", f"{fact['points']:,}" if fact["points"] else ""),
        ("labelled points", f"{fact['targets']}, in {fact['sightings']} sightings" if fact["targets"] else ""),
        ("distance from the scanner", "" if far is None else f"{far:g} {unit}, median"),
        ("arm", fact["robot"] or "not stated: poses of the flange only"),
        ("joint angles", "in views.csv" if fact["joints"] else "none: effects of joints cannot be tested"),
        ("hand-eye", "a coarse one is stated" if fact["hand_eye_given"] else "not stated: found from the views"),
        ("measured with each view", ", ".join(fact["covariates"]) or "nothing"),
        *(("note", note) for note in fact["notes"]),
    ]
    return [row for row in rows if row[1]]
