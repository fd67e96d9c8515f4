"""Errors of the file system name what a person asked for, not a hidden file that is made for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def report_errors_as(stated: Path, hidden: Path | None = None) -> Iterator[None]:
    """Let errors at `hidden` name `stated`; without `hidden` every error does."""
    try:
        yield
    except OSError as error:
        if hidden is None or str(error.filename) == str(hidden):
            error.filename = str(stated)
        raise
