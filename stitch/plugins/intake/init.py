"""`stitch init FOLDER`: a session from a folder of scans and poses of unknown convention."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import split_names
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_next, stdout_for_results
from stitch.errors import InputError
from stitch.plugins.intake.detect import BallOption, BoardOption

if TYPE_CHECKING:
    from stitch.plugins.intake.first_session import FirstSession
    from stitch.plugins.intake.guesses import Guess
    from stitch.plugins.intake.make_session import Made
    from stitch.plugins.intake.refusals import Refusal

# Lines of what is left aside on a terminal.
_SHOWN = 8
# Questions about a folder that is refused, one after the other.
_MOST_QUESTIONS = 3

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
_Rows = Annotated[
    str | None,
    typer.Option("--rows", help="Row of the table for each cloud, in the order of their names: 1-7,9; - for none."),
]
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
    rows: _Rows = None,
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

    if bag := find_bag(folder):
        _init_from_bag(bag, output, mount, topic, frames, as_json)
        return
    if topic or frames:
        raise InputError(f"{folder}: --topic and --frames are for bags, which this is not; to fix: leave them out")
    given = {
        "poses": None if poses is None else str(poses), "columns": columns, "rows": rows, "rotation": rotation,
        "angles": angles, "unit": unit, "cloud_unit": cloud_unit, "mount": mount, "orientation": orientation,
        "within": within, "board": " ".join(board or ()), "ball": " ".join(ball or ()),
        "inverse": None if inverse is None else "yes" if inverse else "no",
    }  # fmt: skip
    _init_from_files(folder, output or folder, {n: v for n, v in given.items() if v}, yes, force, as_json)


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
    _report_session(out, made, as_json)


def _init_from_files(folder: Path, out: Path, options: dict[str, str], yes: bool, force: bool, as_json: bool) -> None:
    """Write a session; what is refused for want of an answer is asked on a terminal, one question at a time."""
    from stitch.plugins.intake.make_session import Company, make_session
    from stitch.plugins.intake.refusals import Refusal

    asks = not yes and sys.stdin.isatty()
    company = Company(show_activity, _print_guesses, _ask_uncertain if asks else None)
    for left in range(_MOST_QUESTIONS, -1, -1):
        try:
            made = make_session(folder, out, options, guess=yes, force=force, company=company)
            break
        except Refusal as refused:
            if as_json:
                emit(json.dumps(refused.as_dict(folder), indent=1))
            if not asks or not left or not any(fix.options for fix in refused.fixes):
                raise
            options = options | _ask_way_on(refused)
            out, force = Path(options.pop("output", out)), force or bool(options.pop("force", ""))
    _report_session(out, made, as_json)


def _ask_way_on(refused: Refusal) -> dict[str, str]:
    """Return the options that lead on, as a person chooses and completes them, with the rows shown."""
    say(refused.command_line, bold=True, stream=sys.stderr)
    ways = [fix for fix in refused.fixes if fix.options]
    for number, fix in enumerate(ways, 1) if len(ways) > 1 else ():
        say(f"  {number}: {fix.words}", hang=5, stream=sys.stderr)
    chosen = typer.prompt("Which", default="1", err=True) if len(ways) > 1 else "1"
    fix = ways[int(chosen) - 1] if chosen.isdigit() and 0 < int(chosen) <= len(ways) else ways[0]
    for line in fix.shows:
        say(f"  {line}", stream=sys.stderr)
    return {
        name: str(typer.prompt(f"--{name.replace('_', '-')}", err=True)).strip() if value.isupper() else value
        for name, value in fix.options.items()
    }


def _ask_uncertain(first: FirstSession) -> dict[str, str]:
    """Return what a person states instead of guesses; nothing where they are right.

    Raises:
        InputError: a person does not want the session.
    """
    asked = {guess.what: next(iter(guess.states.items())) for guess in first.guesses if guess.is_asked}
    answers = {}
    for what, (name, value) in asked.items():
        text = f"{what} cannot be told from these views; enter another, or keep"
        answers[name] = str(typer.prompt(text, default=value, err=True)).strip()
    if any(answers[name] != value for name, value in asked.values()):
        # What was kept counts as stated too: the person has seen it.
        return answers
    if not typer.confirm("Write the session?", default=True, err=True):
        raise InputError("nothing was written; to fix: state what is wrong with the flags above")
    return {}


def _print_guesses(guesses: Sequence[Guess]) -> None:
    for guess in guesses:
        say(guess.line, hang=2)


def _report_session(out: Path, made: Made, as_json: bool) -> None:
    """Print the files, what may be wrong in them, and the next command."""
    untold = made.untold
    if as_json:
        emit(json.dumps({"session": str(out), "views": made.views, "told": not untold} | made.as_dict(), indent=1))
    for words in made.not_used[:_SHOWN]:
        say(f"not used: {words}", hang=2)
    if len(made.not_used) > _SHOWN:
        say(f"not used: {len(made.not_used) - _SHOWN} more, which --json lists", hang=2)
    say(f"{out / 'session.toml'} and views.csv: {made.views} views")
    folder = shlex.quote(str(out))
    if untold:
        say("NOT TOLD by files and scans, only guessed; any of it may be wrong:", bold=True)
        for guess in untold:
            say(f"  {guess.what}: {guess.value}; to state it: {guess.flag}")
        say("Results are worth no more than these guesses.")
        say(f"To try the usual mistakes: stitch check --deep {folder}")
    show_next(f"Next: stitch {made.command} {folder}")
