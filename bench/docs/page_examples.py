"""Run the commands that the pages show, and write what they print: python -m bench.docs.page_examples [PAGE …]
[--check].

Tests run them too and compare. What must lie in the folder of a page before its first command runs stands in PREPARE,
and what stands on it beside their output in AFTER, both by the page's name without `.md`. Which blocks are run, which
are only parsed, which can be neither:

| block | what the tests do with it |
|---|---|
| `console` | lines behind `$ ` are run, in one folder for each page; what they print stands below them |
| `sh` | forms of commands, with words in capitals for what one has oneself: every `stitch` among them has to parse |
| `python` | run, from the first of the page to the last |
| toml, csv, text, diff, mermaid | looked at by tests of their own, or by nobody |

A block below a line `<!-- not run: why -->` is left alone.
"""

import argparse
import io
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import typer

from data_synth import kinematics
from data_synth.commands import synth
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.fixtures.raw_folders import Convention, raw_folder
from data_synth.fixtures.robot_programs import program
from data_synth.fixtures.sphere_scans import sphere_cell, write_spheres
from data_synth.fixtures.true_arm import true_flanges
from data_synth.scene import load_scene
from stitch.cli.main import build
from stitch.cli.main import main as stitch
from stitch.effects.contract import EFFECTS
from stitch.numerics.frames import Array
from stitch.plugins.intake.controllers.program import read_program

WIDTH = 110
BASE, TOOL = "0,0,0,0,0,0", "0,0,150,0,0,0"
PROGRAM = """DEF SCAN ( )
;FOLD SPTP home
PTP {A1 11.0,A2 -68.0,A3 108.0,A4 -17.0,A5 56.0,A6 -70.0}
;ENDFOLD
LIN {X 1250.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; in
LIN {X 1350.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; along
LIN {X 1450.0,Y 250.0,Z 870.0,A 70.0,B 15.0,C 175.0,S 2,T 35} C_DIS ; out
END
"""
# Seconds are the machine's own.
_SECONDS = re.compile(r"(│ +)(\d+\.\d\d)( │)$", re.MULTILINE)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")
ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md")))
LANGUAGES = ("console", "sh", "python", "toml", "csv", "text", "diff", "yaml", "sql")
_BLOCK = re.compile(r"(?:^<!-- not run: ([^\n]+) -->\n)?^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def main() -> None:
    """Write the examples into the pages; with --check, end with 1 where one differs and write nothing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", type=Path, help="all that have examples, unless named")
    parser.add_argument("--check", action="store_true", help="write nothing, end with 1 where a page differs")
    given = parser.parse_args()
    stale = 0
    for page in [p.resolve() for p in given.pages] or [p for p in PAGES if examples(p)]:
        known = dict(EFFECTS)
        with tempfile.TemporaryDirectory() as folder:
            anew = rewritten(page, Path(folder))
        # An effect that one page brings is not known to the next.
        for name in set(EFFECTS) - set(known):
            del EFFECTS[name]
        same = anew == page.read_text(encoding="utf-8")
        stale += not same
        print(f"{page.relative_to(ROOT)}: {'as it was' if same else 'differs' if given.check else 'written'}")
        if not given.check:
            page.write_text(anew, encoding="utf-8")
    raise SystemExit(int(given.check and stale > 0))


def rewritten(page: Path, folder: Path) -> str:
    """The page with its examples run anew in an empty folder."""
    text = page.read_text(encoding="utf-8")
    for shown, anew in zip(examples(page), printed(page, folder), strict=True):
        text = text.replace(f"```console\n{shown}```", f"```console\n{anew}```")
    return AFTER.get(page.stem, lambda text, _: text)(text, folder)


def printed(page: Path, folder: Path) -> list[str]:
    """The examples of a page anew: every block with what its commands print, run in a folder made ready for them."""
    PREPARE.get(page.stem, lambda _: None)(folder)
    with chdir(folder), _narrow():
        return ["\n".join(f"$ {line}\n{_output(line)}" for line in commands(shown)) for shown in examples(page)]


def _output(line: str) -> str:
    """What a command prints for people, without colours and without the time it took, and an empty line."""
    words = shlex.split(line, comments=True)
    if words[0] != "stitch":
        text = subprocess.run(line, shell=True, check=True, capture_output=True, text=True).stdout
    else:
        out = io.StringIO()
        with redirect_stdout(out), redirect_stderr(out):
            try:
                stitch(words[1:])
            except SystemExit as ended:
                if ended.code:
                    raise RuntimeError(f"{line}: {out.getvalue()}") from None
        text = _SECONDS.sub(lambda m: m[1] + "…".rjust(len(m[2])) + m[3], out.getvalue())
    lines = [_wrapped(line.rstrip()) for line in text.rstrip().splitlines()]
    return "".join(f"{line}\n" for line in lines)


def _wrapped(line: str) -> str:
    """A long sentence over several lines, as a terminal shows it."""
    if len(line) <= WIDTH:
        return line
    margin = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(line, WIDTH, subsequent_indent=margin, break_on_hyphens=False)


@contextmanager
def _narrow() -> Iterator[None]:
    """A page's width for tables, whatever the terminal has, and no word of how long the work takes."""
    before = {name: os.environ.get(name) for name in ("COLUMNS", "NO_COLOR", "STITCH_PROGRESS")}
    os.environ.update(COLUMNS=str(WIDTH), NO_COLOR="1", STITCH_PROGRESS="off")
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def differences(anew: str, shown: str) -> list[str]:
    """Where two outputs differ by more than another processor would make of them: one in the last digit shown."""

    def words(text: str) -> list[str]:
        return _NUMBER.sub("#", re.sub(r"\s+", " ", re.sub("[─━]+", "─", text))).split(" ")

    if words(anew) != words(shown):
        changed = zip_longest(words(shown), words(anew), fillvalue="nothing")
        return [f"{a!r} is now {b!r}" for a, b in changed if a != b][:5]
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(anew), strict=True)
    return [f"{a} is now {b}" for a, b in pairs if not _alike(a, b)]


def _alike(a: str, b: str) -> bool:
    # Below the rounding of sums of ones, zeros differ from processor to processor.
    step = max(1.01 * max(_last_digit(a), _last_digit(b)), 1e-14)
    return math.isclose(float(a.replace(",", "")), float(b.replace(",", "")), rel_tol=0, abs_tol=step)


def _last_digit(number: str) -> float:
    """What one more in the last digit that is shown is worth."""
    mantissa, _, power = number.partition("e")
    return float(10.0 ** (int(power or 0) - len(mantissa.partition(".")[2])))


def write_cell(folder: Path) -> None:
    """A run `found` of a cell, and a program `scan.src`, in `folder`."""
    synth("blade", folder / "cell", hide=["joint_compliance=3"], views=10, seed=4)
    with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
        try:
            words = ["--effects", "joint_compliance", "--no-recording"]
            stitch(["run", str(folder / "cell"), "-o", str(folder / "found"), *words])
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError("the run of the example failed") from None
    (folder / "scan.src").write_text(PROGRAM, encoding="utf-8")


def tool_errors(folder: Path, name: str) -> Array:
    """(K,) mm from where the program `scan.src` meant the tool to where the true arm takes it for that of a name."""
    arm, tool = load_scene("blade").arm, np.eye(4)
    tool[2, 3] = float(TOOL.split(",")[2])
    hidden = json.loads((folder / "cell.truth.json").read_text())["hidden"]["joint_compliance"]

    def commanded(program: str) -> Array:
        out: list[Array] = []
        for point in read_program(folder / program, BASE, TOOL).points:
            if point.T_frame_tool is None:
                joints = point.joints
            else:
                joints = kinematics.inverse(arm, point.T_frame_tool @ np.linalg.inv(tool), out[-1])
            assert joints is not None
            out.append(joints)
        return np.array(out)

    meant = kinematics.flange(arm, commanded("scan.src")) @ tool
    reached = true_flanges("joint_compliance", hidden, arm, commanded(name)) @ tool
    return np.linalg.norm((reached - meant)[:, :3, 3], axis=1)


def truth(folder: Path) -> str:
    """One sentence."""
    errors = [tool_errors(folder, name) for name in ("scan.src", "scan-compensated.src")]
    missed, misses = (f"{e.min():.2f} to {e.max():.2f} mm" for e in errors)
    return (
        f"The cell is simulated, so its true arm can be asked: it missed the tool's poses by {missed}\n"
        f"with `scan.src`, and misses them by {misses} with the copy."
    )


def moved_line(folder: Path) -> str:
    """One of the program's targets, as the copy has it."""
    copy = (folder / "scan-compensated.src").read_text(encoding="utf-8")
    return next(line for line in copy.splitlines() if "; along" in line)


def raw_scans(folder: Path) -> None:
    """Scans of a blade whose scanner measures too long, and a robot's poses in degrees, in `folder`/scans."""
    cell = folder / "cell"
    synth("blade-table", cell, hide=["range_scale=3"], views=8, seed=3)
    raw_folder(cell, folder / "scans", Convention("ZYX", degrees=True, angles_first=False), "robot_poses.txt")


def small_session(folder: Path) -> None:
    """A session of three views, in `folder`/blade-17."""
    synth("blade", folder / "blade-17", views=3, seed=1)


def planned_views(folder: Path) -> None:
    """Eight poses of a scanner on an arm that nobody has scanned from yet, in `folder`/planned."""
    planned = folder / "planned"
    synth("blade-table", planned, views=8, seed=3)
    shutil.rmtree(planned / "clouds")


def own_effect(folder: Path) -> None:
    """The effect of the page as `folder`/mine.py."""
    page = ROOT / "docs" / "effects.md"
    text = next(block.text for block in blocks(page) if block.language == "python")
    (folder / "mine.py").write_text(text, encoding="utf-8")


def calibrations(folder: Path) -> None:
    """Scans of a sphere, a tracker's frames, a program of a FANUC: sphere, tracker, SCAN1.LS in `folder`."""
    write_spheres(sphere_cell(3, pose_noise=0.03), folder / "sphere")
    probe, *_ = labelled_cell(4, views=30, probe=True)
    write_labelled(folder / "tracker", probe, "frames")
    arm = load_scene("blade").arm
    joints = np.radians([[10, -60, 110, 0, 40, 0], [20, -65, 105, 5, 45, 10]])
    poses = [kinematics.flange(arm, q[None])[0] for q in joints]
    (folder / "SCAN1.LS").write_text(program("fanuc", [], poses), encoding="utf-8")


def tracked_arm(folder: Path) -> None:
    """An arm with two joints a little off, tracker reflectors on its flange: arm and other-poses in `folder`."""
    offset = np.array([0, 1e-3, -1.5e-3, 0, 0, 0])
    for name, seed in (("arm", 2), ("other-poses", 3)):
        session, *_ = labelled_cell(seed, views=40, offset=offset)
        write_labelled(folder / name, session)


def examples_folder(folder: Path) -> None:
    """The project's `examples`, which the pages of the cells speak of."""
    (folder / "examples").symlink_to(ROOT / "examples")


PREPARE: dict[str, Callable[[Path], None]] = {
    "back-into-the-cell": write_cell,
    "base-to-base": examples_folder,
    "calibrate": calibrations,
    "drilling": examples_folder,
    "effects": own_effect,
    "own-data": raw_scans,
    "panel": examples_folder,
    "plan": planned_views,
    "points": tracked_arm,
    "session": small_session,
    "window": examples_folder,
}


def compensated(text: str, folder: Path) -> str:
    """The page of programs with the line that moved and what the true arm does."""
    text = re.sub(r"(?m)^LIN .*; along$", moved_line(folder), text)
    between = re.compile(r"(?<=<!-- truth: begin -->\n).*?(?=\n<!-- truth: end -->)", re.DOTALL)
    return between.sub(truth(folder), text)


AFTER: dict[str, Callable[[str, Path], str]] = {"back-into-the-cell": compensated}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str  # from the root of the project
    language: str
    text: str
    not_run: str | None  # why


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in their order."""
    name, text = str(page.relative_to(ROOT)), page.read_text(encoding="utf-8")
    return [Block(name, language, body, why) for why, language, body in _BLOCK.findall(text)]


def commands(example: str) -> list[str]:
    """The command lines of a `console` block, in order."""
    return [line.removeprefix("$ ") for line in example.splitlines() if line.startswith("$ ")]


def examples(page: Path) -> list[str]:
    """What the `console` blocks of a page show, without those that are not run."""
    return [b.text for b in blocks(page) if b.language == "console" and not b.not_run]


@cache
def _stitch() -> Any:
    return typer.main.get_command(build())


def refused(line: str, named_only: bool = False) -> str | None:
    """Why the command line `stitch …` does not parse, or None: unknown commands, options, too few or many words.

    Values are not looked at: they may be words in capitals that stand for what one has oneself.

    Args:
        named_only: it stands in a sentence, where words that the command needs may lack, behind an option too.
    """
    # Brackets say that something may be left out.
    words = shlex.split(re.sub(r"\[=[^]]*\]|[][]", "", line.replace("…", "X")), comments=True)[1:]
    command = _stitch()
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        if words[0] not in command.commands:
            return f"no command {words[0]!r}"
        command = command.commands[words.pop(0)]
    if named_only and words and words[-1].startswith("-"):
        known = {option for p in command.params for option in (*p.opts, *p.secondary_opts)}
        return None if words[-1] in {*known, "--help", "--version"} else f"no option {words[-1]}"
    try:
        values, left, _ = command.make_parser(typer.Context(command)).parse_args(list(words))
    except Exception as error:
        return str(error)
    lacking = [p.name for p in command.params if p.required and values.get(p.name) in (None, ())]
    asked = named_only or {"--help", "--version"}.intersection(words)
    if left or (lacking and not asked):
        return f"left over {left}, lacking {lacking}"
    return None


if __name__ == "__main__":
    main()
