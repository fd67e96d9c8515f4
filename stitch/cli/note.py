"""`stitch note RUN TEXT`: what a reviewer remarks on a step of the model's history, kept in its ledger."""

from datetime import UTC, datetime
from typing import Annotated

import typer

from stitch.cli.options import Json, RunFolder
from stitch.cli.terminal import emit, say
from stitch.errors import InputError

_LONGEST = 2000


def note(
    run: RunFolder,
    text: Annotated[str, typer.Argument(metavar="TEXT", help="What to remark.")],
    step: Annotated[int | None, typer.Option("--step", help="Step of the ledger; default the last.")] = None,
    by: Annotated[str, typer.Option("--by", metavar="NAME", help="Who says so.")] = "",
    as_json: Json = False,
) -> None:
    """Write a remark beside a step of the model's history; it stays there when the model changes.

    \b
    Examples:
      stitch note runs/blade-17 "fixture shimmed after this step" --step 0
    """
    from stitch.output import json_file, run_folder, stored_run

    text, by = text.strip(), by.strip()
    if not text:
        raise InputError("TEXT: empty; to fix: write the remark")
    if len(text) > _LONGEST:
        raise InputError(f"TEXT: has {len(text)} characters; to fix: shorten it to {_LONGEST}")
    with run_folder.lock_run_folder(run):
        steps = stored_run.read_ledger(run)
        at = len(steps) - 1 if step is None else step
        if not 0 <= at < len(steps):
            raise InputError(f"--step {at}: to fix: name one of the steps 0 to {len(steps) - 1} of {run}/ledger.json")
        when = datetime.now(UTC).isoformat(timespec="seconds")
        steps[at].setdefault("notes", []).append({"at": when, "by": by, "text": text})
        json_file.write_json(steps, run / "ledger.json")
    if as_json:
        emit(json_file.to_json(steps))
    else:
        say(f"  step {at}, {when}{f', {by}' if by else ''}: {text}")
