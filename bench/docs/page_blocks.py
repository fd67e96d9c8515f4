"""Blocks of code in the pages: which are run, which are only parsed, which can be neither, and why.

| block | what the tests do with it |
|---|---|
| `console` | lines behind `$ ` are run, in one folder for each page; what they print stands below them |
| `sh` | forms of commands, with words in capitals for what one has oneself: every `stitch` among them has to parse |
| `python` | run, from the first of the page to the last |
| toml, csv, text, diff, mermaid | looked at by tests of their own, or by nobody |

A block below a line `<!-- not run: why -->` is left alone.
"""

import re
import shlex
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import typer

from stitch.cli.main import build

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md")))
LANGUAGES = ("console", "sh", "python", "toml", "csv", "text", "diff", "yaml", "sql")
_BLOCK = re.compile(r"(?:^<!-- not run: ([^\n]+) -->\n)?^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


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
