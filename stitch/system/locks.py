"""One writer at a time: locks that the operating system lets go when their process ends, however it ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stitch.errors import BusyError
from stitch.system.named_errors import report_errors_as

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_held: dict[Path, int] = {}  # locks of this process and how many blocks hold each


@contextmanager
def only_writer(lock: Path, what: Path) -> Iterator[None]:
    """Hold the file `lock` while the block runs; a block inside a block of the same process holds it with it.

    Args:
        what: what is written, for the message.

    Raises:
        BusyError: another process holds it.
    """
    if lock in _held:
        _held[lock] += 1
        try:
            yield
        finally:
            _held[lock] -= 1
        return
    descriptor = _locked(lock, what)
    _held[lock] = 1
    try:
        yield
    finally:
        del _held[lock]
        lock.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(lock: Path, what: Path) -> int:
    while True:
        with report_errors_as(what, lock):
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise BusyError(
                f"{what}: another stitch is writing there; wait until it has ended, or name another folder"
            ) from None
        except OSError:
            return descriptor  # a file system that knows no locks
        if _is_same_file(descriptor, lock):
            return descriptor
        # Its holder has removed the file between our opening and our locking it.
        os.close(descriptor)


def _is_same_file(descriptor: int, lock: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), lock.stat())
    except FileNotFoundError:
        return False
