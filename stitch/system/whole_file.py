"""Files that are there whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stitch.system.named_errors import report_errors_as


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A scratch file beside `path` that takes its place if the block succeeds, and goes if it fails."""
    scratch = path.with_name(f".{path.name}.new")
    # One that a stranger has put there may be a link to elsewhere.
    with report_errors_as(path, scratch):
        scratch.unlink(missing_ok=True)
        try:
            yield scratch
            sync_to_disk(scratch)
            scratch.replace(path)
        finally:
            scratch.unlink(missing_ok=True)


def sync_to_disk(path: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk: after a power cut no name is empty."""
    if path.is_symlink():
        return
    if path.is_dir():
        for entry in path.iterdir():
            sync_to_disk(entry)
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:  # folders cannot be opened everywhere
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
