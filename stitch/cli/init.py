"""`stitch init FOLDER`: a session from a folder of scans and poses of unknown convention."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.detect import BallOption, BoardOption
from stitch.cli.options import split_names
from stitch.cli.terminal import emit
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.intake.first_session import FirstSession, StatedFolder
    from stitch.intake.folder_files import Guess


# What `stitch init` does: guesses told, what cannot be told asked for, a session written.

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
    from stitch.intake.ros_bag import is_bag

    if is_bag(folder):
        _init_from_bag(folder, output, topic, frames, as_json)
        return
    if topic or frames:
        raise InputError(f"{folder}: --topic and --frames are for bags, which this is not; to fix: leave them out")
    _init_from_scans(folder, output, stated, yes, as_json)


def _init_from_scans(folder: Path, output: Path | None, stated: StatedFolder, yes: bool, as_json: bool) -> None:
    """In their folder if nowhere else; what they do not tell is asked on a terminal, or guessed with `yes`."""
    from stitch.intake.first_session import first_session
    from stitch.intake.session_draft import require_free, write_draft

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
    from stitch.intake.ros_bag import write_bag_session

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
    from stitch.system.process import console

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
    from stitch.intake.first_session import first_session

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


_Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Scans, and poses beside or below them; or a bag of ROS, MCAP.")
]
_Poses = Annotated[Path | None, typer.Option("--poses", help="File or folder of the poses; default: found.")]
_Columns = Annotated[
    str | None, typer.Option("--columns", help="Names of the columns of numbers: rx,ry,rz,x,y,z; - leaves one out.")
]
_Rotation = Annotated[
    str | None, typer.Option("--rotation", help="xyz-extrinsic, zyx-intrinsic, rotation-vector, quaternion-xyzw …")
]
_Angles = Annotated[str | None, typer.Option("--angles", help="deg or rad.")]
_Unit = Annotated[str | None, typer.Option("--unit", help="Of the poses: mm, m, cm or inch.")]
_CloudUnit = Annotated[str | None, typer.Option("--cloud-unit", help="Of the clouds: mm or m.")]
_Mount = Annotated[str | None, typer.Option("--mount", help="eye_in_hand or eye_to_hand.")]
_Inverse = Annotated[
    bool | None, typer.Option("--inverse/--no-inverse", help="The poses are T_flange_base, or are not.")
]
_Topic = Annotated[str | None, typer.Option("--topic", help="Of a bag: the topic of the scans.")]
_Frames = Annotated[
    str | None, typer.Option("--frames", metavar="BASE,FLANGE[,SCANNER]", help="Of a bag: frames of tf.")
]
_Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="OUT", help="Folder of the session; default FOLDER, or BAG-session."),
]
_Yes = Annotated[bool, typer.Option("--yes", "-y", help="Guess what cannot be told, do not ask.")]
_Json = Annotated[bool, typer.Option("--json", help="Print the guesses as JSON.")]


def init(
    folder: _Folder,
    poses: _Poses = None,
    columns: _Columns = None,
    rotation: _Rotation = None,
    angles: _Angles = None,
    unit: _Unit = None,
    cloud_unit: _CloudUnit = None,
    mount: _Mount = None,
    inverse: _Inverse = None,
    board: BoardOption = None,
    ball: BallOption = None,
    topic: _Topic = None,
    frames: _Frames = None,
    output: _Output = None,
    yes: _Yes = False,
    as_json: _Json = False,
) -> None:
    """Make a session of a folder of scans and poses; the scans tell which convention the poses are in.

    \b
    Examples:
      stitch init scans
      stitch init scans --poses robot_poses.txt --yes
      stitch init scans --rotation zyx-intrinsic --angles deg --unit mm --mount eye_in_hand -o session
      stitch init drive.mcap --topic /points
    """
    from stitch.cli.detect import parse_target_options
    from stitch.intake.first_session import StatedFolder

    stated = StatedFolder(
        split_names(columns),
        rotation,
        angles,
        length_unit=unit,
        inverse=inverse,
        poses=poses,
        cloud_unit=cloud_unit,
        mount=mount,
        targets=parse_target_options(board, ball),
    )
    run_init(folder, output, stated, topic=topic, frames=frames, yes=yes, as_json=as_json)
