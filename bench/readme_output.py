"""Run the example of README.md and write what it prints: python bench/readme_output.py.

The commands are those of the page itself, between its markers; a test runs them too and compares.
"""

import argparse
import io
import os
import re
import shlex
import tempfile
import textwrap
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from stitch.cli.main import main as stitch

PAGE = Path(__file__).resolve().parents[1] / "README.md"
BEGIN, END = "<!-- example: begin -->\n```console\n", "```\n<!-- example: end -->"
WIDTH = 110
# Seconds are the machine's own.
_SECONDS = re.compile(r"(│ +)(\d+\.\d\d)( │)$", re.MULTILINE)


def shown(page: Path = PAGE) -> str:
    """The example as the page shows it: commands behind `$ `, and what they print.

    Raises:
        ValueError: the page has lost its markers.
    """
    return page.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]


def commands(example: str) -> list[str]:
    """The command lines of an example, in order."""
    return [line.removeprefix("$ ") for line in example.splitlines() if line.startswith("$ ")]


def printed(lines: list[str], folder: Path) -> str:
    """The example anew: every command with what it prints, run in `folder`."""
    parts = []
    with chdir(folder), _narrow():
        for line in lines:
            parts.append(f"$ {line}\n{_output(shlex.split(line)[1:])}\n")
    return "\n".join(parts)


def _output(arguments: list[str]) -> str:
    """What a command prints for people, without colours and without the time it took."""
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out):
        try:
            stitch(arguments)
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError(f"stitch {' '.join(arguments)}: {out.getvalue()}") from None
    text = _SECONDS.sub(lambda m: m[1] + "…".rjust(len(m[2])) + m[3], out.getvalue())
    return "\n".join(_wrapped(line.rstrip()) for line in text.rstrip().splitlines())


def _wrapped(line: str) -> str:
    """A long sentence over several lines, as a terminal shows it."""
    if len(line) <= WIDTH:
        return line
    margin = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(line, WIDTH, subsequent_indent=margin, break_on_hyphens=False)


@contextmanager
def _narrow() -> Iterator[None]:
    """A page's width for tables, whatever the terminal has."""
    before = {name: os.environ.get(name) for name in ("COLUMNS", "NO_COLOR")}
    os.environ.update(COLUMNS=str(WIDTH), NO_COLOR="1")
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def main() -> None:
    """Write the example into the page; with --check, only say whether it is there already."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, end with 1 where the page differs")
    check = parser.parse_args().check
    example = shown()
    with tempfile.TemporaryDirectory() as folder:
        anew = printed(commands(example), Path(folder))
    if check:
        raise SystemExit(int(anew != example))
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text.replace(BEGIN + example + END, BEGIN + anew + END), encoding="utf-8")


if __name__ == "__main__":
    main()
