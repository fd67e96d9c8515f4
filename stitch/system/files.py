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
    """Yield the path of a scratch file beside `path`: renamed to `path` if the block succeeds, deleted if it fails.

    Errors of the file system at the scratch file name `path`, the file that was asked for.
    """
    scratch = path.with_name(f".{path.name}.new")
    # A file that another user has put there may be a link to elsewhere: it is never written through.
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
    """Yield a scratch folder: it replaces the folder `path` if the block succeeds, and is deleted if it fails.

    A link stays a link: the folder that it points to is replaced.

    Args:
        ours: True for a path, relative to the folder, that this program writes: those go, all others are kept.

    Raises:
        BusyError: another process writes there.
    """
    asked, path = path, path.resolve()
    with claim_folder(asked) as home:
        with report_errors_as(asked):
            scratch = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=home))
        try:
            yield scratch
            umask = os.umask(0)  # the system returns the old value only when a new one is set
            os.umask(umask)
            scratch.chmod(0o777 & ~umask)
            sync_to_disk(scratch)
            _commit(scratch, path, ours)
        except OSError as error:
            # The scratch folder will be deleted, so that the message names the folder that was asked for.
            place = str(error.filename or path).replace(str(scratch), str(path))
            raise OSError(error.errno, error.strerror or str(error), place) from None
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def claim_folder(path: Path) -> Iterator[Path]:
    """Lock a folder for this process while the block runs; yield the folder in which its scratch folders are made.

    Before that, a replacement that an earlier process has begun and not finished is finished or cleared away.

    Args:
        path: the folder; it need not exist yet.

    Raises:
        BusyError: another process writes there.
    """
    asked, path = path, path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.parent if os.access(path.parent, os.W_OK) or not path.is_dir() else path
    with only_writer(beside / f".{path.name}.lock", asked):
        # A new folder is made beside the old one; inside it where that cannot be renamed: a mount, a working folder.
        here = Path.cwd()
        home = path if path in (here, *here.parents) or os.path.ismount(path) else beside
        _recover(home, path)
        yield home


def _prefix(path: Path) -> str:
    return f".{path.name}.stitch-"


def _recover(home: Path, path: Path) -> None:
    """Finish the replacement of `path` that a killed process had committed, and delete scratch folders it has left.

    Args:
        home: the folder that holds scratch folders, `path` itself or the one above.
    """
    if (path / _COMMIT).is_dir():
        _finish_commit(path)
    # Killed between the two renamings of `_commit`: the old folder has left its place, the new one is not there yet.
    old = home / f"{_prefix(path)}old"
    if old.is_dir() and not path.exists():
        old.rename(path)
    for left in home.glob(f"{glob.escape(_prefix(path))}*"):
        shutil.rmtree(left, ignore_errors=True)


def _commit(scratch: Path, path: Path, ours: Ours) -> None:
    """Put a scratch folder in the place of `path`; a process killed meanwhile leaves the old content or the new.

    A scratch folder inside `path` writes down which files are to be deleted, and is renamed to `_COMMIT`. From then on
    the new content counts: the next process finishes it (`_recover`). One beside `path` takes over, as links, the files
    that are not ours; then the two folders exchange their names.

    Args:
        ours: True for a file, by its path relative to `path`, that this program writes; all others are kept.
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
        # Without an exchange in one step there are two, and `_recover` mends what ends between them.
        if not exchange_paths(scratch, path):
            old = scratch.with_name(f"{_prefix(path)}old")
            path.rename(old)
            scratch.rename(path)
            shutil.rmtree(old, ignore_errors=True)


def _finish_commit(path: Path) -> None:
    """Delete the files that the commit folder inside `path` lists, and move its own files to their places in `path`.

    It can be killed anywhere and run again: what is done already is passed over.
    """
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
    """Yield all files, links and empty folders at any depth of a folder, sorted; not our scratch folders and locks."""
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith((f".{folder.name}.stitch-", f".{folder.name}.lock", _COMMIT)):
            continue
        if entry.is_dir() and not entry.is_symlink() and any(entry.iterdir()):
            yield from _list_files(entry)
        else:
            yield entry


def _preserve_file(file: Path, place: Path) -> None:
    """Make `place` the same file, link or empty folder as `file`: a hard link where the file system can, else a copy.

    Args:
        place: a path that does not exist yet; folders above it are made.
    """
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
    """Exchange two existing paths of one file system in one step; return False where that is not possible.

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
    """Hold a lock on the file `lock` while the block runs; the system releases it if the process is killed.

    A block nested in another one of the same process enters at once: the outermost one releases the lock.

    Args:
        lock: file that is made for the lock and removed after it.
        what: path that is written under the lock, for the message.

    Raises:
        BusyError: another process holds the lock.
    """
    if lock in _held:
        _held[lock] += 1
        try:
            yield
        finally:
            _held[lock] -= 1
        return
    descriptor = _acquire_lock(lock, what)
    _held[lock] = 1
    try:
        yield
    finally:
        del _held[lock]
        _release_lock(lock, descriptor)


def _release_lock(lock: Path, descriptor: int) -> None:
    """Remove the file of a lock that this process holds, and release the lock by closing its descriptor."""
    if ON_WINDOWS:
        # No open file can be removed there. One that the next writer has opened stays: it is that writer's lock.
        os.close(descriptor)
        with suppress(PermissionError):
            lock.unlink(missing_ok=True)
    else:
        # Removed while it is locked: whoever opened it before sees, once it has the lock, that the file is gone.
        lock.unlink(missing_ok=True)
        os.close(descriptor)


def _acquire_lock(lock: Path, what: Path) -> int:
    """Return the open descriptor of the file `lock`, locked by this process alone; it never waits for another one.

    On a file system without locks the descriptor comes back unlocked.

    Args:
        what: path that is written under the lock, for the message.

    Raises:
        BusyError: another process holds the lock.
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
        # Its last holder may have removed the file between our opening and our locking it: then open it anew.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), lock.stat()):
                return descriptor
        os.close(descriptor)


@contextmanager
def report_errors_as(stated: Path, hidden: Path | None = None) -> Iterator[None]:
    """Make errors of the file system inside the block name another path, `stated`.

    Args:
        stated: the path that a person asked for.
        hidden: only errors at this path, a scratch file or a lock, are renamed; None: all errors are.
    """
    try:
        yield
    except OSError as error:
        if hidden is None or str(error.filename) == str(hidden):
            error.filename = str(stated)
        raise


def sync_to_disk(path: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk.

    Renamed before that, a file could be empty after a power cut. What cannot be opened is passed over.
    """
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
