"""What `stitch init` does: guesses told, what cannot be told asked for, a session written."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer

from stitch.cli.options import split_names
from stitch.cli.terminal.streams import emit
from stitch.errors import InputError
from stitch.intake.bag_messages import is_bag
from stitch.intake.bag_session import write_bag_session
from stitch.intake.first_session import FirstSession, first_session
from stitch.intake.guesses import Guess
from stitch.intake.session_draft import require_free, write_draft
from stitch.intake.stated import StatedFolder
from stitch.system.console import console

# Guesses that are asked for one by one; the fields of `StatedFolder` bear the same names.
_QUESTIONS = ("rotation", "length_unit", "cloud_unit", "mount")


def run_init(
    folder: Path,
    output: Path | None,
    stated: StatedFolder,
    *,
    topic: str | None,
    frames: str | None,
    yes: bool,
    as_json: bool,
) -> None:
    """A session of a bag, of which topic and frames may be stated, or of scans and poses.

    Raises:
        InputError, NoResultError: as `stitch init` ends.
    """
    if is_bag(folder):
        _init_from_bag(folder, output, topic, frames, as_json)
        return
    if topic or frames:
        raise InputError(f"{folder}: --topic and --frames are for bags, which this is not; to fix: leave them out")
    _init_from_scans(folder, output, stated, yes, as_json)


def _init_from_scans(folder: Path, output: Path | None, stated: StatedFolder, yes: bool, as_json: bool) -> None:
    """In their folder if nowhere else; what they do not tell is asked on a terminal, or guessed with `yes`."""
    out = folder if output is None else output
    require_free(out, not stated.targets.is_empty)
    first = first_session(folder, stated)
    _print_guesses(first.guesses)
    if not yes:
        first = _ask_uncertain(folder, out, first, stated)
    write_draft(out, first)
    _report_session(out, len(first.pairing.used), first.guesses, as_json)


def _init_from_bag(bag: Path, output: Path | None, topic: str | None, named: str | None, as_json: bool) -> None:
    """Beside it if nowhere else; what its messages do not say is not asked, flags state it."""
    out = output or bag.with_name(f"{bag.stem}-session")
    frames = split_names(named)
    if named and len(frames) not in (2, 3):
        raise InputError(f"--frames {named}: to fix: name base and flange, and the scanner's frame if it is another")
    made = write_bag_session(bag, out, topic, frames)
    _print_guesses(made.guesses)
    _report_session(out, made.views, made.guesses, as_json)


def _report_session(out: Path, views: int, guesses: Sequence[Guess], as_json: bool) -> None:
    if as_json:
        emit(json.dumps(_document(out, views, guesses), indent=1))
    print(f"{out / 'session.toml'} and views.csv: {views} views", file=sys.stderr)
    untold = [guess for guess in guesses if not guess.determined]
    if untold:
        _warn_uncertain(out, untold)
    print(f"Next: stitch run {out}", file=sys.stderr)


def _warn_uncertain(out: Path, uncertain: Sequence[Guess]) -> None:
    """What was guessed and may be wrong, where it is read last."""
    terminal = console()
    terminal.print("NOT TOLD by files and scans, only guessed; any of it may be wrong:", style="bold red")
    for guess in uncertain:
        terminal.print(f"  {guess.what}: {guess.value}; to state it: {guess.flag}", soft_wrap=True)
    terminal.print(
        f"Until that is stated, results of {out} are worth no more than the guess; `stitch check --deep {out}` tries "
        "the usual mistakes.",
        soft_wrap=True,
    )


def _print_guesses(guesses: Sequence[Guess]) -> None:
    for guess in guesses:
        print(f"{'' if guess.determined else '? '}{guess.line}", file=sys.stderr)


def _ask_uncertain(folder: Path, out: Path, first: FirstSession, stated: StatedFolder) -> FirstSession:
    """On a terminal what cannot be told is asked, and judged anew; elsewhere it is refused.

    Raises:
        InputError: names the flags that would tell it; or a person does not want the session.
    """
    untold = [guess for guess in first.guesses if not guess.determined]
    if not sys.stdin.isatty():
        if untold:
            flags = ", ".join(dict.fromkeys(guess.flag for guess in untold))
            what = ", ".join(guess.what for guess in untold)
            raise InputError(
                f"{out}: {what} cannot be told from these views; to fix: state {flags}, or guess with --yes"
            )
        return first
    answers: dict[str, Any] = {guess.what: _ask_guess(guess) for guess in untold if guess.what in _QUESTIONS}
    if any(answers[guess.what] != _flag_value(guess) for guess in untold if guess.what in answers):
        # What was kept counts as stated too: the person has seen it.
        first = first_session(folder, replace(stated, **answers))
        _print_guesses(first.guesses)
    if not typer.confirm("Write the session?", default=True, err=True):
        raise InputError(f"{out}: nothing was written; to fix: state what is wrong with the flags above")
    return first


def _ask_guess(guess: Guess) -> str:
    """What a person says instead of a guess, or the guess."""
    text = f"{guess.what} cannot be told from these views; enter another, or keep"
    return str(typer.prompt(text, default=_flag_value(guess), err=True)).strip()


def _flag_value(guess: Guess) -> str:
    """The word of a guess, as its flag takes it."""
    return guess.value.split(",")[0]


def _document(out: Path, views: int, guesses: Sequence[Guess]) -> dict[str, object]:
    return {
        "session": str(out),
        "views": views,
        "told": all(guess.determined for guess in guesses),
        "guesses": [guess.as_dict() for guess in guesses],
    }
