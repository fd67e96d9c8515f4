"""Sessions and runs in object storage (s3://, gs://, memory://, file://), by fsspec: fetched, run, and put back.

A store has no folder that appears at once: the mark of a run is written last, and a run without its mark is none. The
mark says of which state of the session the run is: names, sizes and the store's own tags.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stitch.plugins.watch.batch.run_batch import MARK, BatchJob, SessionRow, failed_row, row_of_document, run_session
from stitch.system.packages import import_extra

# What a store says of a file that changes with it.
_TAGS = ("size", "ETag", "etag", "md5Hash", "mtime", "created", "LastModified")


def is_remote(place: str) -> bool:
    """Return whether a session or a folder lies in a store."""
    return "://" in place


def run_stored(job: BatchJob) -> SessionRow:
    """Run a session of a store into a store, unless its run stands there; what goes wrong is part of the answer."""
    try:
        files, source = _store(job.source)
        runs, target = _store(job.target)
        state = _state(files, source)
        if (row := _finished(job, runs, target, state)) is not None:
            return row
        with TemporaryDirectory(prefix="stitch-store-") as scratch:
            session, run = Path(scratch) / "in" / Path(source).name, Path(scratch) / "run"
            files.get(source + "/", f"{session}/", recursive=True)
            row = run_session(replace(job, session=session, run=run, source="", target=""))
            if row.error is None:
                _put(runs, run, target, state, job.source)
        error = None if row.error is None else row.error.replace(str(session), job.source)
        return replace(row, session=job.source, run=None if error else job.target, error=error)
    except Exception as error:  # whatever befalls one session, the others go on
        return failed_row(job.source, job.name, error)


def put_summary(folder: Path, target: str) -> None:
    """Write the files of a batch beside its runs."""
    store, place = _store(target)
    for file in folder.iterdir():
        _write(store, f"{place}/{file.name}", file.read_bytes())


def _finished(job: BatchJob, runs: Any, target: str, state: str) -> SessionRow | None:
    """Return the row of a run of this very state; None where there is none."""
    if job.force or not runs.exists(f"{target}/{MARK}"):
        return None
    mark = json.loads(runs.cat(f"{target}/{MARK}"))
    if mark.get("stored") != state:
        return None
    row = row_of_document(json.loads(runs.cat(f"{target}/result.json")), job.source, job.name, U=mark.get("U"))
    return replace(row, run=job.target, skipped=True)


def _put(runs: Any, run: Path, target: str, state: str, source: str) -> None:
    """Write a run into its store, the mark last; it names the session where it lies."""
    mark = json.loads((run / MARK).read_text(encoding="utf-8")) | {"stored": state}
    result = run / "result.json"
    document = json.loads(result.read_text(encoding="utf-8")) | {"session": source}
    result.write_text(json.dumps(document, indent=1), encoding="utf-8")
    for file in sorted(file for file in run.rglob("*") if file.is_file() and file.name != MARK):
        _write(runs, f"{target}/{file.relative_to(run).as_posix()}", file.read_bytes())
    _write(runs, f"{target}/{MARK}", json.dumps(mark).encode())


def _write(store: Any, place: str, data: bytes) -> None:
    store.makedirs(place.rpartition("/")[0], exist_ok=True)
    store.pipe(place, data)


def _state(files: Any, source: str) -> str:
    """Return a hash of names, sizes and tags of a session's files.

    Raises:
        FileNotFoundError: there are none.
    """
    found = files.find(source, detail=True)
    if not found:
        raise FileNotFoundError(f"{source}: nothing there; to fix: correct the address")
    known = [(name[len(source) :], [str(info.get(tag)) for tag in _TAGS]) for name, info in sorted(found.items())]
    return hashlib.sha256(repr(known).encode()).hexdigest()[:16]


def _store(place: str) -> tuple[Any, str]:
    """Return a store and the path in it."""
    store, path = import_extra("fsspec", place, "cluster").core.url_to_fs(place)
    return store, str(path).rstrip("/")
