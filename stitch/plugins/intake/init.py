"""`stitch init FOLDER`: a session from a folder of scans and poses of unknown convention."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import split_names
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_next, stdout_for_results
from stitch.errors import InputError, NoResultError
from stitch.plugins.intake.detect import BallOption, BoardOption, parse_target_options

if TYPE_CHECKING:
    from stitch.plugins.intake.first_session import FirstSession
    from stitch.plugins.intake.guesses import Guess
    from stitch.plugins.intake.stated_folder import StatedFolder

# Lines of what is left aside on a terminal.
_SHOWN = 8
# Guesses that are asked for one by one; the fields of `StatedFolder` bear the same names.
_QUESTIONS = ("rotation", "length_unit", "cloud_unit", "mount")

_Folder = Annotated[
    Path,
    typer.Argument(
        metavar="FOLDER", help="Scans, or points of a tracker, and poses beside or below them; or a bag of ROS, MCAP."
    ),
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
_CloudUnit = Annotated[str | None, typer.Option("--cloud-unit", help="Of the clouds: mm, m, cm or inch.")]
_Orientation = Annotated[
    str | None,
    typer.Option("--orientation", help="Of all poses, for a table of x, y, z alone: 180,0,0 or qx,qy,qz,qw."),
]
_Mount = Annotated[str | None, typer.Option("--mount", help="eye_in_hand or eye_to_hand.")]
_Within = Annotated[
    str | None,
    typer.Option(
        "--within", help="Box that counts, in the clouds' frame and unit: its lowest and highest corner, x,y,z,x,y,z."
    ),
]
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
_Force = Annotated[bool, typer.Option("--force", help="Replace session.toml and views.csv that are there.")]
_Json = Annotated[bool, typer.Option("--json", help="Print the guesses as JSON.")]


@stdout_for_results
def init(
    folder: _Folder,
    poses: _Poses = None,
    columns: _Columns = None,
    rotation: _Rotation = None,
    angles: _Angles = None,
    unit: _Unit = None,
    cloud_unit: _CloudUnit = None,
    mount: _Mount = None,
    orientation: _Orientation = None,
    within: _Within = None,
    inverse: _Inverse = None,
    board: BoardOption = None,
    ball: BallOption = None,
    topic: _Topic = None,
    frames: _Frames = None,
    output: _Output = None,
    yes: _Yes = False,
    force: _Force = False,
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
    from stitch.plugins.intake.ros_bag import find_bag
    from stitch.plugins.intake.stated_folder import StatedFolder

    if bag := find_bag(folder):
        _init_from_bag(bag, output, mount, topic, frames, as_json)
        return
    if topic or frames:
        raise InputError(f"{folder}: --topic and --frames are for bags, which this is not; to fix: leave them out")
    stated = StatedFolder(
        split_names(columns),
        rotation,
        angles,
        length_unit=unit,
        inverse=inverse,
        poses=poses,
        cloud_unit=cloud_unit,
        mount=mount,
        orientation=_numbers("--orientation", orientation),
        within=_numbers("--within", within),
        targets=parse_target_options(board, ball),
    )
    if not _init_from_points(folder, output or folder, stated, yes, force, as_json):
        _init_from_scans(folder, output or folder, stated, yes, force, as_json)


def _init_from_bag(
    bag: Path, output: Path | None, mount: str | None, topic: str | None, named: str | None, as_json: bool
) -> None:
    """Write a session beside a bag if nowhere else; what its messages do not say is not asked, flags state it."""
    from stitch.plugins.intake.ros_bag import write_bag_session

    out = output or bag.with_name(f"{bag.stem}-session")
    frames = split_names(named)
    if named and len(frames) not in (2, 3):
        raise InputError(f"--frames {named}: to fix: name base and flange, and the scanner's frame if it is another")
    with show_activity("reading the bag"):
        made = write_bag_session(bag, out, topic, frames, mount)
    _print_guesses(made.guesses)
    _report_session(out, made.views, made.guesses, as_json, "run")


def _init_from_scans(folder: Path, out: Path, stated: StatedFolder, yes: bool, force: bool, as_json: bool) -> None:
    """Write a session of scans; what they do not tell is asked on a terminal, or guessed with `yes`."""
    from stitch.plugins.intake.folder_files import one_scan_a_file
    from stitch.plugins.intake.session_draft import draft_files, require_free, write_draft

    if not force:
        require_free(out, draft_files(not stated.targets.is_empty))
    with one_scan_a_file(folder) as scans, _named_as(scans, folder):
        first = _judge_folder(scans, stated)
        if not yes:
            first = _ask_uncertain(scans, out, first, stated)
        elif stated.rotation is None:
            _require_fit(scans, first)
        write_draft(out, first, force=force, unpacked=scans != folder)
    command = "run" if first.sphere_mm is None else "calibrate sphere"
    for words in first.not_used[:_SHOWN]:
        say(f"not used: {words}", hang=2)
    if len(first.not_used) > _SHOWN:
        say(f"not used: {len(first.not_used) - _SHOWN} more, which --json lists", hang=2)
    inventory = [found.as_dict() for found in first.files.inventory]
    document = {"inventory": inventory, "not_used": list(first.not_used), "question": _question(first.guesses)}
    _report_session(out, len(first.pairing.used), first.guesses, as_json, command, document)


def _init_from_points(folder: Path, out: Path, stated: StatedFolder, yes: bool, force: bool, as_json: bool) -> bool:
    """Write a session of measured points; False where scans lie there, or no points.

    Raises:
        InputError: without `yes`, what the fit does not tell.
    """
    from stitch.plugins.intake.measured_points import measured_session, write_measured

    with show_activity(f"{folder.name}: reading the tables and trying conventions"):
        made = measured_session(folder, stated)
    if made is None:
        return False
    _print_guesses(made.guesses)
    if not yes:
        _require_determined(out, made.guesses)
    write_measured(out, made, force=force)
    _report_session(out, len(made.way.pairing.used), made.guesses, as_json, "run")
    return True


@contextmanager
def _named_as(scratch: Path, folder: Path) -> Iterator[None]:
    """Name a folder in refusals in place of a passing one, which is gone when they are read."""
    try:
        yield
    except (InputError, NoResultError) as error:
        if scratch == folder or str(scratch) not in str(error):
            raise
        raise type(error)(str(error).replace(str(scratch), str(folder))) from None


def _judge_folder(folder: Path, stated: StatedFolder) -> FirstSession:
    """Return the session that files and scans tell of, after its guesses are printed."""
    from stitch.plugins.intake.first_session import first_session

    with show_activity(f"{folder.name}: reading the scans and trying conventions"):
        first = first_session(folder, stated)
    _print_guesses(first.guesses)
    return first


# Where so many of the scanner's motions close, a reading is worth a guess.
_WORTH_A_GUESS = 0.5


def _require_fit(folder: Path, first: FirstSession) -> None:
    """Refuse poses that contradict the scans under every reading, with the mistake that explains it.

    Raises:
        InputError: what the deep check finds wrong for certain.
    """
    from stitch.plugins.intake.session_draft import write_draft
    from stitch.screening.deep_check import deep_check
    from stitch.session.reading.session_folder import load_session

    choice = first.choice
    if choice.determined or first.sphere_mm is not None or (choice.best.closed or 0.0) >= _WORTH_A_GUESS:
        return
    trying = show_activity("no reading fits clearly: trying the usual mistakes")
    with TemporaryDirectory() as draft, _named_as(Path(draft), folder), trying:
        write_draft(Path(draft), first)
        session = load_session(Path(draft))
        try:
            certain = [p for p in deep_check(session) if p.certain]
            # What is wrong with all views comes before what is wrong with one.
            found = [
                p.line(session.names) for p in sorted(certain, key=lambda p: 0 < len(p.views) < len(session.views))
            ]
        except NoResultError as error:
            found = [str(error).replace(draft, str(folder))]
    if found:
        raise InputError(f"{folder}: no session was written, as no reading of the poses fits the scans. {found[0]}")


def _ask_uncertain(folder: Path, out: Path, first: FirstSession, stated: StatedFolder) -> FirstSession:
    """Return the session with what a person answers on a terminal, judged anew; elsewhere refuse what is uncertain.

    Raises:
        InputError: names the flags that would tell it; or a person does not want the session.
    """
    untold = [guess for guess in first.guesses if not guess.determined]
    if not sys.stdin.isatty():
        _require_determined(out, first.guesses)
        return first
    asked = [guess for guess in untold if guess.what in _QUESTIONS]
    while asked:
        answers: dict[str, Any] = {guess.what: _ask_guess(guess) for guess in asked}
        if all(answers[guess.what] == _flag_value(guess) for guess in asked):
            break
        try:
            # What was kept counts as stated too: the person has seen it.
            first = _judge_folder(folder, replace(stated, **answers))
            break
        except InputError as error:
            say(error.command_line, bold=True)
    if not typer.confirm("Write the session?", default=True, err=True):
        raise InputError(f"{out}: nothing was written; to fix: state what is wrong with the flags above")
    return first


def _require_determined(out: Path, guesses: Sequence[Guess]) -> None:
    """Refuse guesses that neither files nor measurements tell."""
    untold = [guess for guess in guesses if not guess.determined]
    if untold:
        flags = ", ".join(dict.fromkeys(guess.flag for guess in untold))
        what = ", ".join(guess.what for guess in untold)
        raise InputError(f"{out}: {what} cannot be told from these views; to fix: state {flags}, or guess with --yes")


def _ask_guess(guess: Guess) -> str:
    """Return what a person says instead of a guess, or the guess."""
    text = f"{guess.what} cannot be told from these views; enter another, or keep"
    return str(typer.prompt(text, default=_flag_value(guess), err=True)).strip()


def _flag_value(guess: Guess) -> str:
    """Return the word of a guess, as its flag takes it."""
    return guess.value.split(",")[0]


def _print_guesses(guesses: Sequence[Guess]) -> None:
    for guess in guesses:
        say(guess.line, hang=2)


def _question(guesses: Sequence[Guess]) -> dict[str, Any] | None:
    """What a person would be asked first, as JSON; None where files and measurements tell all that is asked."""
    guess = next((guess for guess in guesses if not guess.determined), None)
    if guess is None:
        return None
    return {"what": guess.what, "flag": guess.flag, "answers": [guess.value, *filter(None, [guess.runner_up])]}


def _report_session(
    out: Path, views: int, guesses: Sequence[Guess], as_json: bool, command: str, beside: dict[str, Any] | None = None
) -> None:
    """Print the files, what may be wrong in them, and the next command."""
    untold = [guess for guess in guesses if not guess.determined]
    if as_json:
        document: dict[str, Any] = {
            "session": str(out),
            "views": views,
            "told": not untold,
            "guesses": [guess.as_dict() for guess in guesses],
            "inventory": [],
            "not_used": [],
            "question": None,
        } | (beside or {})
        emit(json.dumps(document, indent=1))
    say(f"{out / 'session.toml'} and views.csv: {views} views")
    folder = shlex.quote(str(out))
    if untold:
        say("NOT TOLD by files and scans, only guessed; any of it may be wrong:", bold=True)
        for guess in untold:
            say(f"  {guess.what}: {guess.value}; to state it: {guess.flag}")
        say("Results are worth no more than these guesses.")
        say(f"To try the usual mistakes: stitch check --deep {folder}")
    show_next(f"Next: stitch {command} {folder}")


def _numbers(flag: str, text: str | None) -> tuple[float, ...]:
    """Return the numbers of a flag."""
    try:
        return tuple(float(cell) for cell in split_names(text))
    except ValueError:
        raise InputError(f"{flag} {text}: is no list of numbers; to fix: write numbers with commas between") from None
