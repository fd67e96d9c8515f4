"""A folder that stands as it was or as it shall be, whatever ends the process in between.

The new content is made in a scratch folder beside the old one. What in the old one is a person's own is linked
into it, then the two exchange their places in one step. Where a folder itself has to stay (a mount, or somebody
stands in it), a list of what goes is written first, and whoever opens the folder next carries it out.
"""

import ctypes
import glob
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stitch.errors import BusyError

try:
    from fcntl import LOCK_EX, LOCK_NB, flock
except ImportError:
    from msvcrt import LK_NBLCK, locking  # type: ignore[attr-defined, unused-ignore]

    ON_WINDOWS = True
else:
    ON_WINDOWS = False

_AT_FDCWD = -100  # AT_FDCWD of Linux
_RENAME_EXCHANGE = 2  # RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS
_COMMIT = ".stitch-commit"
_GOES = ".goes.json"
Ours = Callable[[Path], bool]  # True for a path, relative to the folder, that may go
_held: dict[Path, int] = {}  # locks of this process and how many blocks hold each


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a scratch file beside `path` that takes its place if the block succeeds, and goes if it fails."""
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


@contextmanager
def rewrite_folder(path: Path, ours: Ours) -> Iterator[Path]:
    """Yield a scratch folder that takes the place of `path` if the block succeeds, and goes if it fails.

    A link stays one: what it points to is rewritten. What in `path` is not `ours` is kept.

    Raises:
        InputError: another process writes there.
    """
    asked, path = path, path.resolve()
    with claim_folder(asked) as home:
        with report_errors_as(asked):
            scratch = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=home))
        try:
            yield scratch
            umask = os.umask(0)  # which is told only in exchange for another
            os.umask(umask)
            scratch.chmod(0o777 & ~umask)
            sync_to_disk(scratch)
            _commit(scratch, path, ours)
        except OSError as error:
            # The scratch folder is gone when somebody reads this.
            place = str(error.filename or path).replace(str(scratch), str(path))
            raise OSError(error.errno, error.strerror or str(error), place) from None
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def claim_folder(path: Path) -> Iterator[Path]:
    """Hold a folder as its only writer, in the state of its last writer; yields where its scratch folders go.

    Raises:
        InputError: another process writes there.
    """
    asked, path = path, path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.parent if os.access(path.parent, os.W_OK) or not path.is_dir() else path
    with only_writer(beside / f".{path.name}.lock", asked):
        # A new folder is made beside the old one, or in it where that must stay.
        here = Path.cwd()
        home = path if path in (here, *here.parents) or os.path.ismount(path) else beside
        _recover(home, path)
        yield home


def _prefix(path: Path) -> str:
    return f".{path.name}.stitch-"


def _recover(home: Path, path: Path) -> None:
    """Finish or clear away what a process that was ended has left."""
    if (path / _COMMIT).is_dir():
        _finish_commit(path)
    old = home / f"{_prefix(path)}old"
    if old.is_dir() and not path.exists():
        old.rename(path)
    for left in home.glob(f"{glob.escape(_prefix(path))}*"):
        shutil.rmtree(left, ignore_errors=True)


def _commit(scratch: Path, path: Path, ours: Ours) -> None:
    """Put a scratch folder in the place of `path`; whoever is killed meanwhile leaves the old one or the new.

    Files that are not ours stay. A scratch folder inside `path` first says which files go, and is renamed: from then on
    it counts (`_recover` finishes it). One beside `path` takes over what is not ours, and changes places with it.

    Args:
        ours: whether a file, by its path inside `path`, is one that we write.
    """
    if scratch.parent == path:
        goes = [str(f.relative_to(path)) for f in _list_files(path) if ours(f.relative_to(path))]
        (scratch / _GOES).write_text(json.dumps(goes), encoding="utf-8")
        scratch.rename(path / _COMMIT)
        _finish_commit(path)
    elif not path.exists():
        scratch.rename(path)
    else:
        for file in _list_files(path):
            inside = file.relative_to(path)
            if not ours(inside) and not (scratch / inside).exists():
                _preserve_file(file, scratch / inside)
        if not exchange_paths(scratch, path):
            old = scratch.with_name(f"{_prefix(path)}old")
            path.rename(old)
            scratch.rename(path)
            shutil.rmtree(old, ignore_errors=True)


def _finish_commit(path: Path) -> None:
    """Delete what a commit inside `path` says that goes, and move its files to their places; twice does the same."""
    commit = path / _COMMIT
    new = {file.relative_to(commit) for file in _list_files(commit)} - {Path(_GOES)}
    if (commit / _GOES).is_file():
        for name in json.loads((commit / _GOES).read_text(encoding="utf-8")):
            if Path(name) not in new and not (path / name).is_dir():
                (path / name).unlink(missing_ok=True)
        (commit / _GOES).unlink()
    for inside in sorted(new):
        (path / inside).parent.mkdir(parents=True, exist_ok=True)
        (commit / inside).replace(path / inside)
    shutil.rmtree(commit, ignore_errors=True)


def _list_files(folder: Path) -> Iterator[Path]:
    """Yield everything in a folder but its folders, links and empty folders included, scratch folders left out."""
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith((f".{folder.name}.stitch-", f".{folder.name}.lock", _COMMIT)):
            continue
        if entry.is_dir() and not entry.is_symlink() and any(entry.iterdir()):
            yield from _list_files(entry)
        else:
            yield entry


def _preserve_file(file: Path, place: Path) -> None:
    """Make `place` the same file, link or empty folder as `file`: linked where the file system can, else copied."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if file.is_dir() and not file.is_symlink():
        place.mkdir(exist_ok=True)
        return
    try:
        os.link(file, place, follow_symlinks=ON_WINDOWS)
    except OSError:
        if file.is_symlink():
            place.symlink_to(file.readlink())
        else:
            shutil.copy2(file, place)


def exchange_paths(first: Path, second: Path) -> bool:
    """Exchange two existing paths of one file system; False where the system or the file system cannot.

    Source: renameat2(2) of Linux, renamex_np(2) of macOS.
    """
    a, b = os.fsencode(first), os.fsencode(second)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            return bool(libc.renamex_np(a, b, ctypes.c_uint(_RENAME_EXCHANGE)) == 0)
        return bool(libc.renameat2(_AT_FDCWD, a, _AT_FDCWD, b, ctypes.c_uint(_RENAME_EXCHANGE)) == 0)
    except (AttributeError, OSError, TypeError):
        return False


@contextmanager
def only_writer(lock: Path, what: Path) -> Iterator[None]:
    """Hold the file `lock` while the block runs; the system lets it go when the process ends, however it ends.

    A block inside a block of the same process holds it with it.

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
        _let_go(lock, descriptor)


def _let_go(lock: Path, descriptor: int) -> None:
    """Close and remove a lock that this process holds, so that no other process gets one that is gone."""
    if ON_WINDOWS:  # where no open file can be removed, and one that the next writer has opened stays
        os.close(descriptor)
        with suppress(PermissionError):
            lock.unlink(missing_ok=True)
    else:
        lock.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(lock: Path, what: Path) -> int:
    """Return the descriptor of a lock, once this process alone holds it.

    Raises:
        BusyError: another process holds it, and writes `what`.
    """
    while True:
        with report_errors_as(what, lock):
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if ON_WINDOWS:
                locking(descriptor, LK_NBLCK, 1)
            else:
                flock(descriptor, LOCK_EX | LOCK_NB)
        except (BlockingIOError, PermissionError):
            os.close(descriptor)
            raise BusyError(
                f"{what}: another stitch is writing there; wait until it has ended, or name another folder"
            ) from None
        except OSError:
            return descriptor  # a file system that knows no locks
        # Its holder may have removed the file between our opening and our locking it.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), lock.stat()):
                return descriptor
        os.close(descriptor)


@contextmanager
def report_errors_as(stated: Path, hidden: Path | None = None) -> Iterator[None]:
    """Let errors at `hidden`, a file made for what a person asked for, name `stated`; without `hidden` all do."""
    try:
        yield
    except OSError as error:
        if hidden is None or str(error.filename) == str(hidden):
            error.filename = str(stated)
        raise


def sync_to_disk(path: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk: after a power cut no name is empty."""
    if path.is_symlink():
        return
    if path.is_dir():
        for entry in path.iterdir():
            sync_to_disk(entry)
    try:
        # Windows waits only for a file that is open for writing.
        descriptor = os.open(path, os.O_RDWR if ON_WINDOWS else os.O_RDONLY)
    except OSError:  # folders cannot be opened everywhere, files without the right to write not on Windows
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
