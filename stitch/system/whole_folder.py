"""A folder that stands as it was or as it shall be, whatever ends the process in between.

The new content is made in a scratch folder beside the old one. What in the old one is a person's own is linked
into it, then the two exchange their places in one step. Where a folder itself has to stay (a mount, or somebody
stands in it), a list of what goes is written first, and whoever opens the folder next carries it out.
"""

import glob
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from stitch.system.exchange import exchange_paths
from stitch.system.locks import only_writer
from stitch.system.named_errors import report_errors_as
from stitch.system.whole_file import sync_to_disk

Ours = Callable[[Path], bool]  # True for a path, relative to the folder, that may go
_COMMIT = ".stitch-commit"
_GOES = ".goes.json"


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
        home = _scratch_parent(path, beside)
        _recover(home, path)
        yield home


@contextmanager
def rewrite_folder(path: Path, ours: Ours) -> Iterator[Path]:
    """A scratch folder that takes the place of `path` if the block succeeds, and goes if it fails.

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
            scratch.chmod(0o777 & ~_umask())
            sync_to_disk(scratch)
            _commit(scratch, path, ours)
        except OSError as error:
            # The scratch folder is gone when somebody reads this.
            place = str(error.filename or path).replace(str(scratch), str(path))
            raise OSError(error.errno, error.strerror or str(error), place) from None
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def _scratch_parent(path: Path, parent: Path) -> Path:
    """Where a new folder is made: beside the old one, or in it where that must stay."""
    here = Path.cwd()
    return path if path in (here, *here.parents) or os.path.ismount(path) else parent


def _prefix(path: Path) -> str:
    return f".{path.name}.stitch-"


def _old_folder(home: Path, path: Path) -> Path:
    return home / f"{_prefix(path)}old"


def _recover(home: Path, path: Path) -> None:
    """Finish or clear away what a process that was ended has left."""
    if (path / _COMMIT).is_dir():
        _finish_commit(path)
    old = _old_folder(home, path)
    if old.is_dir() and not path.exists():
        old.rename(path)
    for left in home.glob(f"{glob.escape(_prefix(path))}*"):
        shutil.rmtree(left, ignore_errors=True)


def _commit(scratch: Path, path: Path, ours: Ours) -> None:
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
            path.rename(_old_folder(scratch.parent, path))
            scratch.rename(path)
            shutil.rmtree(_old_folder(scratch.parent, path), ignore_errors=True)


def _finish_commit(path: Path) -> None:
    """What was committed takes its place; done twice it does the same."""
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
    """Everything in a folder but its folders, links and empty folders included, scratch folders left out."""
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith((f".{folder.name}.stitch-", f".{folder.name}.lock", _COMMIT)):
            continue
        if entry.is_dir() and not entry.is_symlink() and any(entry.iterdir()):
            yield from _list_files(entry)
        else:
            yield entry


def _preserve_file(file: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    if file.is_dir() and not file.is_symlink():
        place.mkdir(exist_ok=True)
        return
    try:
        os.link(file, place, follow_symlinks=False)
    except OSError:
        if file.is_symlink():
            place.symlink_to(file.readlink())
        else:
            shutil.copy2(file, place)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
