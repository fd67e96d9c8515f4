"""Standard output carries results alone; what libraries and a user's effects print goes to standard error."""

import codecs
import os
import sys
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from functools import wraps
from typing import IO, Any, TextIO, TypeVar

Command = TypeVar("Command", bound=Callable[..., Any])
_REPLACEMENTS = {
    "µ": "u",
    "μ": "u",
    "–": "-",
    "—": "-",
    "±": "+-",
    "×": "x",
    "·": "*",
    "…": "...",
    "→": "->",
    "°": " deg",
}
_results: list[IO[str]] = []


def stdout_for_results(command: Command) -> Command:
    """The command with standard output kept for `emit`."""

    @wraps(command)
    def apart(*arguments: Any, **options: Any) -> Any:
        with _stdout_redirected():
            return command(*arguments, **options)

    return apart  # type: ignore[return-value]


def results_stream() -> IO[str]:
    """Standard output, for results."""
    return _results[-1] if _results else sys.stdout


def emit(text: str) -> None:
    """Write a result, and a line end, on standard output."""
    print(text, file=results_stream(), flush=True)


@contextmanager
def _stdout_redirected() -> Iterator[None]:
    with _descriptor_redirected(sys.stdout) as stream:
        _results.append(stream)
        try:
            with redirect_stdout(sys.stderr):
                yield
        finally:
            _results.pop()


@contextmanager
def _descriptor_redirected(out: TextIO) -> Iterator[IO[str]]:
    """What compiled libraries write to descriptor 1 goes to 2 as well."""
    try:
        out.flush()
        real = out.fileno() == 1
    except (OSError, ValueError):
        real = False
    if not real:
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
    """Spell what a terminal's encoding does not have: um for µm."""
    codecs.register_error("stitch-spell", _replace_unencodable)
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError):
            if (stream.encoding or "").lower().replace("-", "") != "utf8":
                stream.reconfigure(errors="stitch-spell")  # type: ignore[union-attr]


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    told = ""
    for letter in error.object[error.start : error.end]:
        plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
        told += _REPLACEMENTS.get(letter) or plain or "?"
    return told, error.end
