"""Run the commands that the pages show, and write what they print.

Run: python -m bench.docs.page_examples [PAGE …] [--check]

Tests run them too and compare. What a page needs before its first command is made by `bench/docs/page_folders.py`.
"""

import argparse
import io
import math
import os
import re
import shlex
import subprocess
import tempfile
import textwrap
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from itertools import zip_longest
from pathlib import Path

from bench.docs.page_blocks import PAGES, ROOT, commands, examples
from bench.docs.page_folders import AFTER, PREPARE
from stitch.cli.main import main as stitch
from stitch.effects.contract import EFFECTS

WIDTH = 110
# Seconds are the machine's own.
_SECONDS = re.compile(r"(│ +)(\d+\.\d\d)( │)$", re.MULTILINE)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")


def printed(page: Path, folder: Path) -> list[str]:
    """The examples of a page anew: every block with what its commands print, run in a folder made ready for them."""
    PREPARE.get(page.stem, lambda _: None)(folder)
    with chdir(folder), _narrow():
        return ["\n".join(f"$ {line}\n{_output(line)}" for line in commands(shown)) for shown in examples(page)]


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


def rewritten(page: Path, folder: Path) -> str:
    """The page with its examples run anew in an empty folder."""
    text = page.read_text(encoding="utf-8")
    for shown, anew in zip(examples(page), printed(page, folder), strict=True):
        text = text.replace(f"```console\n{shown}```", f"```console\n{anew}```")
    return AFTER.get(page.stem, lambda text, _: text)(text, folder)


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


if __name__ == "__main__":
    main()
