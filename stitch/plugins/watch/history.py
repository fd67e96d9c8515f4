"""The history of a cell: one SQLite file in its folder that several processes may append to.

Write-ahead logging lets pages be read while a run is appended; whoever appends holds the file from reading the last
state to writing the next. Tables are plain, for those who ask by SQL: runs, estimates (a row per run and parameter),
covariates, alarms; `states` are the filter's own.

The hand-eye of a run stands there as six numbers that can be compared from day to day, a twist about the part: about
the scanner's own origin a turn of the mount and a shift of it are hardly told apart, since their errors go together;
about the middle of what the scanner looks at they are, since the shift is what moves there. So the mount's motion since
the first run is counted about that point, in the axes of the frame that carries the scanner (base or flange).
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.fit.coarse import REUSED
from stitch.model.model_toml import read_model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.stored_run import read_result
from stitch.plugins.watch.run_record import Estimate, RunRecord
from stitch.session.reading.csv_files import is_number, read_csv_rows
from stitch.session.reading.views_table import covariate_names

# A time_s beyond counts seconds since 1970 (this is 2001); below, since the session began.
_EPOCH = 1e9
TWIST_NAMES = ("rx", "ry", "rz", "x", "y", "z")
# Tables by which a session is known again; its clouds may be gigabytes.
_TABLES = ("session.toml", "views.csv", "points.csv", "frames.csv", "targets.csv")
HISTORY_FILE = "history.sqlite"
HISTORY_FORMAT = "stitch-history/1"
_WAIT = 60.0  # s for another process to finish its append
_SCHEMA = """
CREATE TABLE cell (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE runs (id INTEGER PRIMARY KEY, time REAL NOT NULL, time_from TEXT NOT NULL, name TEXT NOT NULL,
    run TEXT NOT NULL, session TEXT NOT NULL, run_hash TEXT NOT NULL UNIQUE, session_hash TEXT NOT NULL UNIQUE,
    numbers_hash TEXT NOT NULL UNIQUE, hand_eye TEXT NOT NULL, covariance TEXT NOT NULL, numbers TEXT NOT NULL);
CREATE INDEX runs_in_time ON runs (time, id);
CREATE TABLE parameters (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, unit TEXT NOT NULL);
CREATE TABLE estimates (run INTEGER NOT NULL, parameter INTEGER NOT NULL, value REAL NOT NULL, sigma REAL NOT NULL,
    PRIMARY KEY (run, parameter)) WITHOUT ROWID;
CREATE TABLE covariates (run INTEGER NOT NULL, name TEXT NOT NULL, value REAL NOT NULL,
    PRIMARY KEY (run, name)) WITHOUT ROWID;
CREATE TABLE alarms (id INTEGER PRIMARY KEY, parameter INTEGER NOT NULL, onset INTEGER NOT NULL,
    raised INTEGER NOT NULL, chart TEXT NOT NULL);
CREATE TABLE states (run INTEGER PRIMARY KEY, time REAL NOT NULL, number INTEGER NOT NULL, data BLOB NOT NULL);
"""


def session_conditions(session: Path, result: Path) -> tuple[float, str, dict[str, float]]:
    """What views.csv says; where it has gone, the time of a run's result.json.

    Returns:
        The time, s since 1970, UTC, how that is known, and the covariates' means over the views.

    Raises:
        InputError: views.csv is no table.
    """
    file = session / "views.csv"
    if not file.is_file():
        return result.stat().st_mtime, "file time of result.json", {}
    header, rows = read_csv_rows(file)
    if not rows:
        raise InputError(f"{file}: no views; write one row per scan")
    names = [*covariate_names(header, rows), *(["time_s"] if "time_s" in header else [])]
    cells = {name: [float(row[name]) for row in rows if is_number(row[name])] for name in names}
    columns = {name: [x for x in numbers if np.isfinite(x)] for name, numbers in cells.items()}
    times = columns.pop("time_s", [])
    covariates = {name: float(np.mean(numbers)) for name, numbers in columns.items() if numbers}
    if times and min(times) > _EPOCH:
        return float(np.mean(times)), "time_s of views.csv", covariates
    return file.stat().st_mtime, "file time of views.csv", covariates


def mount_twist(T_mount: Array, T_mount_first: Array, centre_scanner: Array) -> Array:
    """(6,) log of the mount's motion since the first run: rad, length_unit; axes of the mount frame, about the centre.

    Args:
        centre_scanner: (3,) the middle of what the first run saw, scanner frame.
    """
    about = _watch_frame(T_mount_first, centre_scanner)
    return frames.log(frames.inverse(about) @ T_mount @ frames.inverse(T_mount_first) @ about)


def twist_covariance(covariance: Array, T_mount: Array, T_mount_first: Array, centre_scanner: Array) -> Array:
    """(6, 6) of `mount_twist` from that of the right perturbation T_mount·exp(ξ), to first order."""
    J = frames.adjoint(frames.inverse(_watch_frame(T_mount_first, centre_scanner)) @ T_mount)
    return J @ covariance @ J.T


def _watch_frame(T_mount_first: Array, centre_scanner: Array) -> Array:
    """(4, 4) axes of the mount frame at the centre."""
    return frames.make(np.eye(3), frames.transform(T_mount_first, centre_scanner[None])[0])


def read_record(folder: Path, at: float | None = None) -> RunRecord:
    """What a run folder says.

    Args:
        at: s since 1970, when the session was measured; default: what its files say.

    Raises:
        InputError: no run of one session, damaged, or one that used the model of another run as it is.
    """
    document, model = read_result(folder), read_model(folder)
    reused = any(REUSED in stage.get("note", "") for stage in document["stages"][:1])
    if reused and np.array_equal(model.T_mount, model.T_mount_coarse):
        raise InputError(
            f"{folder}: uses the hand-eye of another run as it is, so nothing was measured anew; to fix: run its "
            "session without --hand-eye"
        )
    session = Path(document["session"])
    time, time_from, covariates = session_conditions(session, folder / "result.json")
    run_hash = _files_hash([folder / "model.toml", folder / "result.json"])
    tables = [session / name for name in _TABLES if (session / name).is_file()]
    repeatability = document["repeatability"]
    estimates = (
        Estimate(f"{effect}.{name}", p.unit, p.value, p.sigma)
        for effect, parameters in model.effects.items()
        for name, p in parameters.items()
        if np.isfinite(p.value) and np.isfinite(p.sigma) and p.sigma > 0
    )
    return RunRecord(
        path=folder.resolve(),
        session=document["session"],
        name=document.get("name") or session.name,
        run_hash=run_hash,
        session_hash=_files_hash(tables) if tables else run_hash,
        time=time if at is None else at,
        time_from=time_from if at is None else "stated",
        length_unit=model.length_unit,
        mount=model.mount,
        T_mount=model.T_mount,
        covariance=model.covariance,
        estimates=tuple(estimates),
        covariates=covariates,
        numbers={name: document[name] for name in ("residual_rms", "noise_floor")}
        | {f"repeatability_{name}": repeatability[name] for name in ("rotation", "translation")},
        document=document,
    )


def _files_hash(files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def scanned_middle(record: RunRecord) -> tuple[Array, float]:
    """(3,) where on average the scanner has the middle of what a run saw, and how far the points lie from it, rms."""
    points = _seen_points(record)
    middle = points.mean(axis=0)
    poses = np.array([view["pose"] for view in record.document["views"]], float)
    in_scanner = frames.transform(frames.inverse(poses), middle[None])[:, 0].mean(axis=0) if len(poses) else np.zeros(3)
    return in_scanner, float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))


def _seen_points(record: RunRecord) -> Array:
    """(n, 3) of the stitched cloud, or the targets; reference frame."""
    targets = record.document.get("targets") or []
    if targets:
        return np.array([target["position"] for target in targets], float)
    if not (record.path / "stitched.ply").is_file():
        return np.zeros((1, 3))
    # The libraries that read clouds are asked for once in the life of a cell.
    from stitch.output.stored_run import fused_cloud

    return fused_cloud(record.path / "stitched.ply").points


class History:
    """An open history; `sql` asks it."""

    def __init__(self, folder: Path, connection: sqlite3.Connection) -> None:
        self.folder = folder
        self._connection = connection

    def sql(self, text: str, *values: Any) -> list[tuple[Any, ...]]:
        """All rows of a statement."""
        return self._connection.execute(text, values).fetchall()

    def many(self, text: str, rows: Sequence[tuple[Any, ...]]) -> None:
        """A statement for each row."""
        self._connection.executemany(text, rows)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the history as its only writer; all of the block is written, or nothing."""
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._connection.rollback()
            raise
        self._connection.commit()

    def stated(self, key: str) -> Any:
        """What is stated of the cell under a key; None where nothing is."""
        rows = self.sql("SELECT value FROM cell WHERE key = ?", key)
        return json.loads(rows[0][0]) if rows else None

    def state(self, values: Mapping[str, Any]) -> None:
        """Write what is stated of the cell."""
        rows = [(key, json.dumps(value)) for key, value in values.items()]
        self.many("INSERT INTO cell VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value", rows)


@contextmanager
def open_history(folder: Path, new: bool = False) -> Iterator[History]:
    """The history of a cell folder.

    Args:
        new: begin one where there is none.

    Raises:
        InputError: no cell folder, or its history is none.
        NoResultError: another process holds it for long.
    """
    file = folder / HISTORY_FILE
    if file.exists() and not file.is_file():
        raise InputError(f"{file}: is no file; to fix: move it away, or name another folder for the cell")
    begun = not file.exists()
    if begun:
        if not new:
            raise InputError(f"{folder}: no cell with a history; to fix: stitch watch {folder} --add RUN begins one")
        _require_free(folder)
        folder.mkdir(parents=True, exist_ok=True)
    connection = sqlite3.connect(file, timeout=_WAIT, isolation_level=None)
    try:
        _prepare(file, connection)
        yield History(folder, connection)
    except sqlite3.OperationalError as error:
        if "locked" in str(error) or "busy" in str(error):
            raise NoResultError(f"{file}: another process has been writing there for {_WAIT:g} s; try again") from None
        raise InputError(f"{file}: {error}; to fix: see that the folder may be written and its disk has room") from None
    except sqlite3.DatabaseError as error:
        raise InputError(f"{file}: damaged ({error}); to fix: put a copy back, or begin a new cell folder") from None
    finally:
        empty = begun and not _any_runs(connection)
        connection.close()
        if empty:
            file.unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()


def _any_runs(connection: sqlite3.Connection) -> bool:
    try:
        return bool(connection.execute("SELECT EXISTS (SELECT 1 FROM runs)").fetchone()[0])
    except sqlite3.Error:
        return True


def _require_free(folder: Path) -> None:
    """Refuse a place that is something else."""
    for name, what in (("session.toml", "a session"), ("result.json", "a run"), ("model.toml", "a run")):
        if (folder / name).exists():
            raise InputError(f"{folder}: is {what}, no cell; to fix: name the folder of the cell first, then the runs")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; to fix: name a folder for the cell")
    for above in folder.resolve().parents:
        if (above / "session.toml").exists():
            raise InputError(f"{folder}: lies in the session {above}, which is only read; to fix: name another folder")


def _prepare(file: Path, connection: sqlite3.Connection) -> None:
    _require_history(file, connection)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    if connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'cell'").fetchone()[0]:
        return
    connection.execute("BEGIN IMMEDIATE")
    # Another process may have been first.
    if not connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'cell'").fetchone()[0]:
        for statement in _SCHEMA.split(";"):
            connection.execute(statement)
        connection.execute("INSERT INTO cell VALUES ('format', ?)", (json.dumps(HISTORY_FORMAT),))
    connection.commit()


def _require_history(file: Path, connection: sqlite3.Connection) -> None:
    """Refuse a database of something else, and a history in another form."""
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    if not tables:
        return
    stated = connection.execute("SELECT value FROM cell WHERE key = 'format'").fetchall() if "states" in tables else []
    if stated != [(json.dumps(HISTORY_FORMAT),)]:
        raise InputError(
            f"{file}: is no history in the form {HISTORY_FORMAT}; to fix: name another folder for the cell"
        )


def matrix_json(matrix: Array) -> str:
    """A matrix as JSON with all digits."""
    return json.dumps(matrix.tolist())


def insert_run(history: History, record: RunRecord, numbers_hash: str) -> int:
    """A row of `runs`; its number."""
    row: list[Any] = [record.time, record.time_from, record.name, str(record.path), record.session, record.run_hash]
    row += [record.session_hash, numbers_hash, matrix_json(record.T_mount), matrix_json(record.covariance)]
    columns = "time, time_from, name, run, session, run_hash, session_hash, numbers_hash, hand_eye, covariance, numbers"
    text = f"INSERT INTO runs ({columns}) VALUES ({', '.join('?' * 11)}) RETURNING id"
    return int(history.sql(text, *row, json.dumps(record.numbers))[0][0])


def known_run_hash(history: History, run: Path, added: Sequence[RunRecord]) -> str:
    """The hash of a run that is in the history, or will be.

    Raises:
        InputError: it is not.
    """
    run_hash = read_record(run).run_hash
    known = history.sql("SELECT 1 FROM runs WHERE run_hash = ?", run_hash)
    if not known and run_hash not in {record.run_hash for record in added}:
        raise InputError(f"{run}: is not in the history of {history.folder}; to fix: append it with --add first")
    return run_hash


def measured_at(text: str) -> float:
    """Seconds since 1970 of an ISO 8601 time; without a zone it is UTC.

    Raises:
        InputError: no such time.
    """
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--at {text}: no time; to fix: write 2026-03-01T06:30+01:00") from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
