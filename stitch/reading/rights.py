"""What may not be read says so."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stitch.errors import InputError


@contextmanager
def readable(place: Path | None = None) -> Iterator[None]:
    """Refuse a file or folder whose rights forbid to read it, while the block runs.

    Args:
        place: what is read, where the error itself does not name it.

    Raises:
        InputError: names it, and how to fix it.
    """
    try:
        yield
    except PermissionError as error:
        name = error.filename or place or "a file"
        raise InputError(f"{name}: may not be read; to fix: change its rights, or name another") from None
