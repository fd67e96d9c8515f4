"""What `stitch batch` does: a job a session, and what is said of them."""

from contextlib import closing
from pathlib import Path
from uuid import uuid4

from stitch.batch.job import BatchJob
from stitch.batch.results import run_jobs
from stitch.batch.session_row import SessionRow
from stitch.batch.summary import DOCUMENT, PAGE, batch_document, batch_sentence, write_summary
from stitch.cli.terminal.batch_table import show_files, show_row, show_table
from stitch.cli.terminal.streams import emit
from stitch.errors import InputError, NoResultError
from stitch.reading.session_toml import read_session_document as session_document
from stitch.reading.session_toml import session_name
from stitch.system.console import console
from stitch.system.steps import steps
from stitch.writing.json_file import to_json


def run_batch(
    sessions: list[Path], output: Path, workers: int, scheduler: str, *, force: bool, recording: bool, as_json: bool
) -> None:
    """Run sessions into a folder, tell each as it is finished, and all at the end.

    Raises:
        InputError, NoResultError: as `stitch batch` ends.
    """
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; to fix: name a folder for the runs with -o")
    jobs, stood = _batch_jobs(sessions, output, force, recording), output.exists()
    rows: dict[str, SessionRow] = {}
    try:
        # Whatever ends the loop ends the workers.
        with closing(run_jobs(jobs, workers, scheduler, console().print)) as coming:
            for row in steps("sessions", coming, len(jobs)):
                rows[row.name] = row
                show_row(row, len(rows), len(jobs))
    except KeyboardInterrupt:
        raise NoResultError(
            f"stopped with {len(rows)} of {len(jobs)} sessions told; what is finished is kept, and the same command "
            "goes on from there"
        ) from None
    if not stood and output.is_dir() and not any(output.iterdir()):
        # Workers claim their places before they read: where nothing came of it, nothing is left.
        output.rmdir()
    _finish_batch([rows[job.run.name] for job in jobs], output, as_json)


def _batch_jobs(sessions: list[Path], output: Path, force: bool, recording: bool) -> list[BatchJob]:
    """A job a session.

    Raises:
        InputError: two sessions, or a session and a file of the batch, would have the same place.
    """
    names = [_session_name(path) for path in sessions]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InputError(f"two of the sessions are named {twice!r}; run them with -o of their own")
    if taken := {DOCUMENT, PAGE} & set(names):
        raise InputError(f"a session is named {taken.pop()!r}, as a file of the batch is; give it another name")
    here, token = output.resolve(), uuid4().hex
    return [
        BatchJob(path.resolve(), here / name, token, force, recording)
        for path, name in zip(sessions, names, strict=True)
    ]


def _session_name(session: Path) -> str:
    """What the session is called; a session that cannot be read is refused when it is its turn."""
    try:
        file = session / "session.toml"
        return session_name(file, session_document(file))
    except InputError:
        return session.resolve().name


def _finish_batch(rows: list[SessionRow], output: Path, as_json: bool) -> None:
    """Tables, files, and how it ends.

    Raises:
        InputError, NoResultError: sessions have no result.
    """
    failed = [row for row in rows if row.error is not None]
    if len(failed) < len(rows):
        write_summary(rows, output)
    if as_json:
        emit(to_json(batch_document(rows)))
    else:
        show_table(rows)
        console().print(batch_sentence(rows), soft_wrap=True, style="bold")
        show_files(output, (PAGE, DOCUMENT))
    if failed:
        kind = InputError if all(row.bad_input for row in failed) else NoResultError
        raise kind(f"{len(failed)} of {len(rows)} sessions have no result; their lines say why")
