"""Lines for people: none is broken inside a word, a number, or between a number and its unit."""

import os
import re
from typing import Any

from rich.cells import cell_len
from rich.console import Console

# Blanks that hold together: between a number and its unit, and beside a sign ("± 0.02 mm", "p = 1e-46").
_GLUE = re.compile(
    r"(?<=\d) (?=(?:[µnk]?m|[µm]?rad|mm|kg|ms|s|h|min|%|°C?|ppm|points?|views?|σ|sigmas)(?!\w))"
    r"|(?<=[±=<>≤≥×]) | (?=[±=<>≤≥×])"
)
_GLUED = "\N{NO-BREAK SPACE}"


def broken_lines(text: str, width: int, hang: int = 0) -> list[str]:
    """Return a text broken between words into lines of at most `width` columns of a terminal.

    A longer word has a line to itself. Blanks at the beginning of the text indent every line. A number stays with its
    unit.

    Args:
        hang: columns by which all lines but the first are indented further.
    """
    margin = " " * (len(text) - len(text.lstrip(" ")))
    lines, line = [], margin
    for word in _GLUE.sub(_GLUED, text.strip(" ")).split(" "):
        if line.strip() and cell_len(line) + 1 + cell_len(word) > width:
            lines.append(line.rstrip(" "))
            line = margin + " " * hang
        line += f" {word}" if line.strip() else word
    return [finished.replace(_GLUED, " ") for finished in (*lines, line)]


def printable(text: str) -> str:
    """Return a text without what would steer a terminal: names of files and views may hold anything."""
    return "".join(letter if letter.isprintable() or letter == "\n" else "\N{REPLACEMENT CHARACTER}" for letter in text)


class PeopleConsole(Console):
    """A console that breaks long lines between words where `soft_wrap` leaves them to a terminal, which cuts words."""

    def print(self, *objects: Any, soft_wrap: bool | None = None, **options: Any) -> None:
        """Print as rich does, with characters that would steer a terminal replaced in texts of `soft_wrap`.

        On a terminal those texts are broken between words; in a file or a pipe their lines stay as long as they are.
        """

        def whole_words(text: str) -> str:
            """Return a text with its long lines broken between words."""
            lines = printable(text).split("\n")
            return "\n".join(part for line in lines for part in broken_lines(line, self.width))

        if soft_wrap:
            show = whole_words if self.is_terminal else printable
            objects = tuple(show(item) if isinstance(item, str) else item for item in objects)
        super().print(*objects, soft_wrap=soft_wrap, **options)

    def on_broken_pipe(self) -> None:
        """Discard all further output once the reader of a pipe has closed it: the command still writes its files."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())
