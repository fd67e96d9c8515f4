"""The history of a cell: one SQLite file in its folder that several processes may append to.

Write-ahead logging lets pages be read while a run is appended; whoever appends holds the file from reading the last
state to writing the next. Tables are plain, for those who ask by SQL: runs, estimates (a row per run and parameter),
covariates, alarms; `states` are the filter's own.
"""

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.watch.run_record import RunRecord

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
    own = connection.execute("SELECT value FROM cell WHERE key = 'format'").fetchall() if "states" in tables else []
    if own != [(json.dumps(HISTORY_FORMAT),)]:
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
