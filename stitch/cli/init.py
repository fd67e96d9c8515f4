"""`stitch init FOLDER`: a session from a folder of scans and poses of unknown convention."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from stitch.cli.looked_for import BallOption, BoardOption, looked_for
from stitch.cli.streams import emit
from stitch.errors import InputError
from stitch.intake.bag_messages import is_bag
from stitch.intake.bag_session import write_bag_session
from stitch.intake.first_session import FirstSession, first_session
from stitch.intake.guesses import Guess
from stitch.intake.session_draft import require_free, write_draft
from stitch.intake.stated import Stated

# Guesses that are asked for one by one; the fields of `Stated` bear the same names.
_ASKED = ("rotation", "length_unit", "cloud_unit", "mount")


def init(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Scans, and poses beside or below them; or a bag of ROS, MCAP."),
    ],
    poses: Annotated[Path | None, typer.Option("--poses", help="File or folder of the poses; default: found.")] = None,
    columns: Annotated[
        str | None, typer.Option("--columns", help="Names of the columns of numbers: rx,ry,rz,x,y,z; - leaves one out.")
    ] = None,
    rotation: Annotated[
        str | None, typer.Option("--rotation", help="xyz-extrinsic, zyx-intrinsic, rotation-vector, quaternion-xyzw …")
    ] = None,
    angles: Annotated[str | None, typer.Option("--angles", help="deg or rad.")] = None,
    unit: Annotated[str | None, typer.Option("--unit", help="Of the poses: mm, m, cm or inch.")] = None,
    cloud_unit: Annotated[str | None, typer.Option("--cloud-unit", help="Of the clouds: mm or m.")] = None,
    mount: Annotated[str | None, typer.Option("--mount", help="eye_in_hand or eye_to_hand.")] = None,
    inverse: Annotated[
        bool | None, typer.Option("--inverse/--no-inverse", help="The poses are T_flange_base, or are not.")
    ] = None,
    board: BoardOption = None,
    ball: BallOption = None,
    topic: Annotated[str | None, typer.Option("--topic", help="Of a bag: the topic of the scans.")] = None,
    named: Annotated[
        str | None, typer.Option("--frames", metavar="BASE,FLANGE[,SCANNER]", help="Of a bag: frames of tf.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="OUT", help="Folder of the session; default FOLDER, or BAG-session."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Guess what cannot be told, do not ask.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the guesses as JSON.")] = False,
) -> None:
    """Make a session of a folder of scans and poses; the scans tell which convention the poses are in.

    \b
    Examples:
      stitch init scans
      stitch init scans --poses robot_poses.txt --yes
      stitch init scans --rotation zyx-intrinsic --angles deg --unit mm --mount eye_in_hand -o session
      stitch init drive.mcap --topic /points
    """
    if is_bag(folder):
        _of_bag(folder, output or folder.with_name(f"{folder.stem}-session"), topic, named, as_json)
        return
    if topic or named:
        raise InputError(f"{folder}: --topic and --frames are for bags, which this is not; to fix: leave them out")
    out = folder if output is None else output
    require_free(out, bool(board or ball))
    names = tuple(name.strip() for name in columns.split(",")) if columns else ()
    stated = Stated(
        poses, names, rotation, angle_unit=angles, length_unit=unit, cloud_unit=cloud_unit, mount=mount, inverse=inverse
    )
    stated = replace(stated, targets=looked_for(board, ball))
    first = first_session(folder, stated)
    _tell(first.guesses)
    if not yes:
        first = _asked(folder, out, first, stated)
    write_draft(out, first)
    _end(out, len(first.pairing.used), first.guesses, as_json)


def _of_bag(bag: Path, out: Path, topic: str | None, named: str | None, as_json: bool) -> None:
    """A session of a bag: what its messages do not say is not asked, flags state it."""
    frames = tuple(name.strip() for name in named.split(",")) if named else ()
    if named and len(frames) not in (2, 3):
        raise InputError(f"--frames {named}: to fix: name base and flange, and the scanner's frame if it is another")
    made = write_bag_session(bag, out, topic, frames)
    _tell(made.guesses)
    _end(out, made.views, made.guesses, as_json)


def _end(out: Path, views: int, guesses: Sequence[Guess], as_json: bool) -> None:
    if as_json:
        emit(json.dumps(_document(out, views, guesses), indent=1))
    print(f"{out / 'session.toml'} and views.csv: {views} views", file=sys.stderr)
    print(f"next: stitch run {out}", file=sys.stderr)


def _tell(guesses: Sequence[Guess]) -> None:
    for guess in guesses:
        print(f"{'' if guess.told else '? '}{guess.line}", file=sys.stderr)


def _asked(folder: Path, out: Path, first: FirstSession, stated: Stated) -> FirstSession:
    """On a terminal what cannot be told is asked, and judged anew; elsewhere it is refused.

    Raises:
        InputError: names the flags that would tell it; or a person does not want the session.
    """
    untold = [guess for guess in first.guesses if not guess.told]
    if not sys.stdin.isatty():
        if untold:
            flags = ", ".join(dict.fromkeys(guess.flag for guess in untold))
            what = ", ".join(guess.what for guess in untold)
            raise InputError(
                f"{out}: {what} cannot be told from these views; to fix: state {flags}, or guess with --yes"
            )
        return first
    answers: dict[str, Any] = {guess.what: _answer(guess) for guess in untold if guess.what in _ASKED}
    if any(answers[guess.what] != _own(guess) for guess in untold if guess.what in answers):
        # What was kept counts as stated too: the person has seen it.
        first = first_session(folder, replace(stated, **answers))
        _tell(first.guesses)
    if not typer.confirm("Write the session?", default=True, err=True):
        raise InputError(f"{out}: nothing was written; to fix: state what is wrong with the flags above")
    return first


def _answer(guess: Guess) -> str:
    """What a person says instead of a guess, or the guess."""
    text = f"{guess.what} cannot be told from these views; enter another, or keep"
    return str(typer.prompt(text, default=_own(guess), err=True)).strip()


def _own(guess: Guess) -> str:
    """The word of a guess, as its flag takes it."""
    return guess.value.split(",")[0]


def _document(out: Path, views: int, guesses: Sequence[Guess]) -> dict[str, object]:
    return {
        "session": str(out),
        "views": views,
        "told": all(guess.told for guess in guesses),
        "guesses": [guess.as_dict() for guess in guesses],
    }
