"""Refusals of a folder: what is wrong, and as data what leads on, options of `stitch init` or a change of a file."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stitch.errors import InputError


@dataclass(frozen=True)
class Fix:
    """One way on. An option whose value is in capitals is for a person to fill in."""

    words: str
    options: Mapping[str, str] = field(default_factory=dict)  # by name, `cloud_unit`; empty: asked again without it
    file: Path | None = None  # to be changed as the words say
    shows: tuple[str, ...] = ()  # lines that a person has to see to answer

    def command(self, folder: Path) -> str:
        """What is typed then."""
        flags = (f"--{name.replace('_', '-')} {shlex.quote(value)}" for name, value in self.options.items() if value)
        return " ".join(["stitch init", shlex.quote(str(folder)), *flags])

    def python(self, folder: Path) -> str:
        """The same from Python."""
        options = (f"{name}={value!r}" for name, value in self.options.items() if value)
        return f"stitch.init({', '.join([repr(str(folder)), *options])})"

    def as_dict(self, folder: Path) -> dict[str, object]:
        """As `stitch init --json` prints it."""
        return {
            "words": self.words,
            "options": dict(self.options),
            "file": str(self.file) if self.file else None,
            "command": self.command(folder),
            "python": self.python(folder),
            "shows": list(self.shows),
        }


class Refusal(InputError):
    """Bad input of a folder, with what leads on as data.

    Args:
        found: guesses, inventory … of `stitch init --json`, as far as they are known by then.
    """

    def __init__(self, what: str, *fixes: Fix, found: Mapping[str, Any] | None = None) -> None:
        typed, passed = ", or ".join(fix.words for fix in fixes), ", or ".join(map(_passed, fixes))
        super().__init__(what, fix_cli=typed, fix_python=passed)
        self.fixes = fixes
        self.found: Mapping[str, Any] = found or {}
        # "--rotation xyz: to fix: …"
        if what.endswith(":"):
            self.what, self.fix_cli, self.fix_python = f"{what} to fix: {self.fix_cli}", "", ""

    def named(self, scratch: Path, folder: Path) -> "Refusal":
        """Return the same with a passing folder called by the name of the one that it stands for."""

        def told(text: str) -> str:
            return text.replace(str(scratch), str(folder))

        fixes = [replace(f, words=told(f.words), file=f.file and Path(told(str(f.file)))) for f in self.fixes]
        return Refusal(told(self.what), *fixes, found=self.found)

    def as_dict(self, folder: Path) -> dict[str, Any]:
        """As `stitch init --json` prints it: what a session that is written has, and what is asked in its place."""
        options = [dict(fix.options) for fix in self.fixes if fix.options]
        question = {"what": self.what, "options": options} if options else None
        fixes = [fix.as_dict(folder) for fix in self.fixes]
        nothing: dict[str, Any] = {"guesses": [], "inventory": [], "not_used": [], "question": question}
        return {**nothing, **self.found, "refused": self.what, "fixes": fixes}


def _passed(fix: Fix) -> str:
    """The words for a program, where they are none but options."""
    stated = all(not value.isupper() for value in fix.options.values()) and fix.words.startswith("state --")
    return f"pass {', '.join(f'{name}={value!r}' for name, value in fix.options.items())}" if stated else fix.words


def state(**options: str) -> Fix:
    """Return the advice to state options."""
    flags = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in options.items())
    return Fix(f"state {flags}", options)


def change(file: Path | str, words: str) -> Fix:
    """Return the advice to change a file."""
    return Fix(words, file=Path(file))
