"""What a command prints: results on standard output, progress and all else for people on standard error."""

from __future__ import annotations

import codecs
import os
import sys
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, redirect_stdout, suppress
from functools import wraps
from pathlib import Path
from typing import IO, Any, TextIO, TypeVar

Command = TypeVar("Command", bound=Callable[..., Any])
_SPELT = {"µ": "u", "μ": "u", "–": "-", "—": "-", "±": "+-", "×": "x", "·": "*", "…": "...", "→": "->", "°": " deg"}
# Where results go, and whether headlines alone are printed: of the innermost command that runs.
_results: list[IO[str]] = []
_briefly: list[bool] = []


def say(text: str, bold: bool = False, hang: int = 0, stream: IO[str] | None = None) -> None:
    """Print a text for people, on a terminal broken into lines between words.

    Args:
        hang: columns by which all lines but the first are indented.
        stream: where it goes; None is standard error, or standard output inside the block `answers()`.
    """
    from stitch.system.lines import broken_lines, printable
    from stitch.system.process import answer_stream, console

    terminal, text = console(stream or answer_stream()), printable(text)
    lines = broken_lines(text, terminal.width, hang) if terminal.is_terminal else [text]
    terminal.print("\n".join(lines), soft_wrap=True, style="bold" if bold else None)


def answers() -> AbstractContextManager[None]:
    """Send lines and tables for people to standard output while the block lasts, as the result of a command."""
    from stitch.system.process import answers_to

    return answers_to(results_stream)


def show_block(rows: Sequence[tuple[str, str]]) -> None:
    """Print rows (name, text) with the texts aligned; a text of several lines is indented as a whole."""
    from rich.cells import cell_len

    longest = max((cell_len(name) for name, _ in rows), default=0)
    for name, text in rows:
        pad = " " * (longest - cell_len(name))
        for line in text.split("\n"):
            say(f"  {name}{pad}  {line}", hang=longest + 2)
            name, pad = "", " " * longest


def show_table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[str] | None = None
) -> None:
    """Print a table with aligned columns.

    On a terminal that is too narrow, each row becomes a line in which every cell follows its heading.

    Args:
        words: headings of the columns that are aligned to the left; all others to the right. None: the first column.
    """
    from rich.cells import cell_len

    from stitch.system.process import answer_stream, console

    say(title, bold=True)
    widths = [max(map(cell_len, column)) for column in zip(headings, *rows, strict=True)]
    terminal = console(answer_stream())
    if terminal.is_terminal and sum(widths) + 2 * len(widths) > terminal.width:
        for first, *cells in rows:
            named = ", ".join(f"{heading} {cell}" for heading, cell in zip(headings[1:], cells, strict=True))
            say(f"  {first}: {named}", hang=4)
        return
    left = [heading in (headings[:1] if words is None else words) for heading in headings]
    for row in (headings, *rows):
        pads = [" " * (width - cell_len(cell)) for cell, width in zip(row, widths, strict=True)]
        cells = [
            f"{cell}{pad}" if to_left else f"{pad}{cell}" for cell, pad, to_left in zip(row, pads, left, strict=True)
        ]
        say(f"  {'  '.join(cells)}".rstrip())


def show_columns(
    title: str,
    columns: Sequence[tuple[str, Callable[[Any], str]]],
    items: Iterable[Any],
    words: Sequence[str] | None = None,
) -> None:
    """Print a table with a row per item.

    Args:
        columns: (heading, function that returns the text of an item).
        words: headings of the columns that are aligned to the left; None: the first column.
    """
    headings = [heading for heading, _ in columns]
    show_table(title, headings, [[cell(item) for _, cell in columns] for item in items], words)


def show_files(folder: Path, names: Sequence[str]) -> None:
    """Print the paths of those files in a folder that exist."""
    for name in names:
        if (folder / name).exists():
            say(f"  {folder / name}")


def headlines_only() -> AbstractContextManager[None]:
    """Let commands print only headlines and main numbers while the block lasts: their caller prints the rest."""
    from stitch.system.process import held_last

    return held_last(_briefly, True)


def in_full() -> bool:
    """Return whether a command prints all that it has to say."""
    return not _briefly


def show_next(line: str) -> None:
    """Print the line that names the next command, unless another command has called this one."""
    if in_full():
        say(line)


def stdout_for_results(command: Command) -> Command:
    """Return a command that prints only what it `emit`s on standard output; all else goes to standard error."""

    @wraps(command)
    def redirected(*arguments: Any, **options: Any) -> Any:
        with _stdout_redirected():
            return command(*arguments, **options)

    return redirected  # type: ignore[return-value]


def results_stream() -> IO[str]:
    """Standard output, for results."""
    return _results[-1] if _results else sys.stdout


def emit(text: str) -> None:
    """Write a result, and a line end, on standard output."""
    print(text, file=results_stream(), flush=True)


@contextmanager
def _stdout_redirected() -> Iterator[None]:
    """Send to standard error what is printed while the block lasts; `emit` still reaches standard output.

    Python prints to sys.stdout, compiled libraries to file descriptor 1: both are redirected.
    """
    from stitch.system.process import held_last

    with _own_descriptor(sys.stdout) as stream, redirect_stdout(sys.stderr), held_last(_results, stream):
        yield


@contextmanager
def _own_descriptor(out: TextIO) -> Iterator[IO[str]]:
    """Yield a stream to the real standard output, while file descriptor 1 leads to that of standard error, 2.

    If `out`, the present sys.stdout, does not use descriptor 1, as in tests, it is yielded itself.
    """
    try:
        out.flush()
        is_descriptor = out.fileno() == 1
    except (OSError, ValueError):
        is_descriptor = False
    if not is_descriptor:
        yield out
        return
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(kept), "w", encoding=out.encoding, errors=out.errors) as stream:
            yield stream
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def speak_any_terminal() -> None:
    """Let both standard streams replace characters that their encoding lacks: um for µm."""
    codecs.register_error("stitch-spell", _replace_unencodable)
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError):
            if (stream.encoding or "").lower().replace("-", "") != "utf8":
                stream.reconfigure(errors="stitch-spell")  # type: ignore[union-attr]


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    """Return a replacement in ASCII for characters that an encoding lacks, and the index where encoding goes on.

    It is a handler as `codecs.register_error` takes it.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = ""
    for letter in error.object[error.start : error.end]:
        plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
        text += _SPELT.get(letter) or plain or "?"
    return text, error.end
