"""Many sessions, each run once into a folder of its own; rows come in the order in which they are finished.

Sessions and runs may lie in object storage (s3://, gs://, memory://, file://), by fsspec: fetched, run, and put back. A
store has no folder that appears at once: the mark of a run is written last, and a run without its mark is none. The
mark says of which state of the session the run is: names, sizes and the store's own tags.
"""

import csv
import hashlib
import json
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stitch.api.pipeline import run
from stitch.api.run import fitted_hand_eye
from stitch.errors import BusyError, InputError, NoResultError, StitchError
from stitch.numerics.units import MICROMETRES
from stitch.output import run_folder
from stitch.output.json_file import require_free, sessions_in, write_json
from stitch.output.run_folder import call_entry_points
from stitch.output.stored_run import read_ledger, read_result
from stitch.plugins.watch.batch.cluster import joined_client, local_client, sessions_at_once
from stitch.recorder import RecorderMemory
from stitch.run_data import RunData
from stitch.session.reading.session_folder import UNKNOWN, content_hash, load_session, measured_files
from stitch.session.reading.text_files import read_toml
from stitch.system.files import claim_folder, whole_file
from stitch.system.packages import import_extra
from stitch.system.threads import share_cores

MARK = "batch-mark.json"
_FORMAT = "stitch-batch-mark/1"
# A worker that was given up may still be at work on a session: its successor waits for it, this long (s).
LOCK_WAIT_SECONDS = 3600.0
_RETRY_SECONDS = 0.5
# Beside the runs: for programs, and for people.
DOCUMENT = "batch.json"
PAGE = "batch.html"
TABLE = "batch.parquet"
# It runs what it has bound here.
_BOUNDS = "stitch.plugins.watch.batch.bounds"
BATCH_FORMAT = "stitch-batch/1"
_WORKERS_DIED = NoResultError(
    "workers died over it, also when it ran alone; to fix: give it more memory, or thin its scans, and start the batch "
    "again"
)
_SCHEDULER_GONE = NoResultError("the scheduler has gone; to fix: start the same batch again")
# What a store says of a file that changes with it.
_TAGS = ("size", "ETag", "etag", "md5Hash", "mtime", "created", "LastModified")


@dataclass(frozen=True)
class BatchJob:
    """What a worker needs to know; all paths absolute, for it may stand elsewhere."""

    session: Path
    run: Path
    batch: str  # name of this batch, unlike that of any other
    force: bool = False  # run it although it is finished, and replace the run of another session
    recording: bool = True
    at_once: int = 1  # sessions that share the cores of the machine
    place: str = ""  # of the run among those of the batch, where it is more than its folder's name
    source: str = ""  # of the session, and
    target: str = ""  # of the run, in a store
    small: bool = False  # keep the numbers of a run: no cloud, residuals, page or recording
    seconds: float = 0.0  # after which a session is ended, 0: never; and
    memory: int = 0  # bytes beyond which it is

    @property
    def name(self) -> str:
        """What the run is called in the batch."""
        return self.place or self.run.name


def session_content_hash(session: Path) -> str | None:
    """Return a hash of all that a run reads of a session: tables, clouds, and the files that session.toml names.

    None where they cannot be read: such a session is never finished.
    """
    session = session.resolve()
    try:
        named = [session / text for text in _document_texts(read_toml(session / "session.toml", ""))]
        files = [*measured_files(session), *(file for file in named if file.is_file())]
    except (OSError, ValueError, csv.Error, InputError):
        return None
    digest = content_hash(Path(session.anchor), files)
    return None if digest == UNKNOWN else digest


def write_mark(job: BatchJob, content: str | None, folder: Path, U: Sequence[float] | None = None) -> None:
    """Write into a folder that becomes the run's of which content it is, and U in mm and mrad; all at once."""
    mark = {"format": _FORMAT, "batch": job.batch, "content": content, "began_with": _first_step_hash(folder), "U": U}
    with whole_file(folder / MARK) as file:
        file.write_text(json.dumps(mark) + "\n", encoding="utf-8")


def finished_batch(job: BatchJob, content: str | None) -> str | None:
    """Return the batch that has run a session, if the folder holds a run of its very content; effects may have joined.

    Of a batch that runs all again, only what it has run itself is finished.
    """
    if content is None or sessions_in(job.run) != [str(job.session.resolve())]:
        return None
    try:
        mark = json.loads((job.run / MARK).read_text(encoding="utf-8"))
        # A later `stitch run` leaves the mark, and begins the history of the model anew.
        is_of_run = mark["began_with"] == _first_step_hash(job.run) and mark["format"] == _FORMAT
        counts = is_of_run and mark["content"] == content and (not job.force or mark["batch"] == job.batch)
        return str(mark["batch"]) if counts else None
    except (OSError, ValueError, LookupError, TypeError, InputError):
        return None


def _first_step_hash(folder: Path) -> str:
    """Return a hash of the numbers with which the history of the model begins; remarks may join it later."""
    first = read_ledger(folder)[0]
    numbers = [first[key] for key in ("hand_eye", "residual_rms", "heldout_rms", "noise_floor")]
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:16]


def _document_texts(value: Any) -> Iterator[str]:
    if isinstance(value, str) and value and "\0" not in value:
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _document_texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _document_texts(inner)


@dataclass(frozen=True)
class SessionRow:
    """What became of one session; lengths in µm, None where nothing was measured."""

    session: str
    name: str  # of the run's folder, below that of the batch
    run: str | None = None  # folder; None without a result
    skipped: bool = False  # its run stood there
    error: str | None = None
    bad_input: bool = False
    verdict: str | None = None
    views: int | None = None  # that are fused
    left_out: int | None = None  # views
    coarse_um: float | None = None  # rms before the hand-eye is corrected
    residual_um: float | None = None  # rms with one hand-eye
    registered_um: float | None = None  # rms after every view has a pose of its own
    noise_floor_um: float | None = None
    worst_view: str | None = None  # of the largest rms after register
    worst_view_um: float | None = None
    seconds: float | None = None  # of its stages
    # Mean distance over the same correspondences: before, with one hand-eye, registered; None of labelled points alone.
    same_pairs_um: tuple[float, float, float] | None = None
    length_unit: str | None = None
    hand_eye: list[float] | None = None  # T_mount_scanner, row by row, length_unit
    U_mm: float | None = None  # expanded (k = 2), at the part
    U_mrad: float | None = None
    effects: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # of the session as a whole: alarms

    @property
    def steps_um(self) -> tuple[float | None, float | None, float | None]:
        """How far the views are apart before, with one hand-eye, and registered."""
        return self.same_pairs_um or (self.coarse_um, self.residual_um, self.registered_um)

    def urgency(self) -> tuple[bool, float]:
        """Return what sorts those first that have no result, then those with most above the noise."""
        if self.residual_um is None or not self.noise_floor_um:
            return self.error is None, 0.0
        return True, -self.residual_um / self.noise_floor_um


def finished_row(job: BatchJob, skipped: bool = False) -> SessionRow:
    """Return the row of a session with a run.

    Raises:
        InputError: no run folder of one session, or a damaged one.
    """
    try:
        U = json.loads((job.run / MARK).read_text(encoding="utf-8")).get("U")
    except (OSError, ValueError):
        U = None
    row = row_of_document(read_result(job.run), str(job.session), job.name, U=U)
    return replace(row, run=str(job.run), skipped=skipped)


def row_of_document(document: dict[str, Any], session: str, name: str, *, U: Sequence[float] | None) -> SessionRow:
    """Return the row of a run by its result.json.

    Args:
        U: in mm and mrad at the part, which the document does not hold.
    """
    to_um = MICROMETRES[document["length_unit"]]
    rms = {stage["name"]: stage["rms"] for stage in document["stages"]}
    views = [view for view in document["views"] if view["rms"] is not None]
    worst = max(views, key=lambda view: float(view["rms"]), default=None)
    left_out = len(document.get("left_out", ()))

    def um(value: Any) -> float | None:
        return None if value is None else float(value) * to_um

    steps = [float(step["mean"]) * to_um for step in (document.get("disagreement") or {"steps": ()})["steps"]]
    mm, mrad = U or (None, None)
    return SessionRow(
        session=session,
        name=name,
        verdict=document["verdict"],
        views=len(document["views"]) - left_out,
        left_out=left_out,
        coarse_um=um(rms.get("coarse")),
        residual_um=um(document["residual_rms"]),
        registered_um=um(rms.get("register")),
        noise_floor_um=um(document["noise_floor"]),
        worst_view=None if worst is None else worst["view"],
        worst_view_um=None if worst is None else um(worst["rms"]),
        seconds=sum(float(stage["seconds"]) for stage in document["stages"]),
        same_pairs_um=(steps[0], steps[-2], steps[-1]) if len(steps) > 2 else None,
        length_unit=document["length_unit"],
        hand_eye=[float(x) for line in document["hand_eye"] for x in line],
        U_mm=mm,
        U_mrad=mrad,
        effects=tuple(document["effects"]),
        doubts=tuple(document.get("doubts", ())),
    )


def failed_row(session: str, name: str, error: BaseException) -> SessionRow:
    """Return the row of a session without a result: why, in one line."""
    kind = "" if isinstance(error, StitchError) else f"{type(error).__name__}: "
    text = f"{kind}{' '.join(str(error).split())}"
    return SessionRow(session, name, error=text, bad_input=isinstance(error, InputError))


def run_session(job: BatchJob) -> SessionRow:
    """Run a session into its folder unless its run stands there; what goes wrong becomes part of the answer."""
    share_cores(job.at_once)
    if job.source:
        return run_stored(job)
    if job.seconds or job.memory:
        run_bounded: Callable[[BatchJob], SessionRow] = import_module(_BOUNDS).run_bounded
        return run_bounded(job)
    try:
        require_free(job.run, [job.session], job.force)
        with _locked_folder(job.run):
            content = session_content_hash(job.session)
            batch = finished_batch(job, content)
            if batch is None:
                session = load_session(job.session)
                with run_folder.new_folder(job.run, [job.session], job.force) as scratch:
                    memory = RecorderMemory()
                    result = run(session, recorder=memory)
                    if job.small:
                        run_folder.write_numbers(result, scratch)
                    else:
                        record = memory.replay if job.recording else None
                        run_folder.write_with_page(result, scratch, record=record)
                    write_mark(job, content, scratch, uncertainty_at_part(result))
            # A worker may die between a run and its answer; the next finds a run of this batch.
            return finished_row(job, skipped=batch not in (None, job.batch))
    except Exception as error:  # whatever befalls one session, the others go on
        return failed_row(str(job.session), job.name, error)


def uncertainty_at_part(run: RunData) -> tuple[float, float]:
    """Return U (k = 2) of the hand-eye in mm and mrad, at the part."""
    capture = run.measurement.capture
    return fitted_hand_eye(run.session, capture, run.T_mount, run.mount_covariance, unknown=run.unknown).U


@contextmanager
def _locked_folder(folder: Path) -> Iterator[None]:
    """Hold the folder as its only writer, after whoever holds it now."""
    until = time.monotonic() + LOCK_WAIT_SECONDS
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(claim_folder(folder))
                break
            except BusyError:
                if time.monotonic() > until:
                    raise
                time.sleep(_RETRY_SECONDS)
        yield


def batch_document(rows: Sequence[SessionRow]) -> dict[str, Any]:
    """Return batch.json as a dictionary: how many, and a row a session; lengths in µm."""
    failed = sum(row.error is not None for row in rows)
    skipped = sum(row.skipped for row in rows)
    return {
        "format": BATCH_FORMAT,
        "done": len(rows) - failed - skipped,
        "skipped": skipped,
        "failed": failed,
        "sessions": [asdict(row) for row in rows],
    }


def write_summary(rows: Sequence[SessionRow], folder: Path) -> None:
    """Write both into the folder of the runs, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(batch_document(rows), folder / DOCUMENT)
    write_rows(rows, folder / TABLE)
    call_entry_points("stitch.batch_pages", rows, folder / PAGE)


def write_rows(rows: Sequence[SessionRow], file: Path) -> None:
    """Write the rows as a table of Parquet, for whoever asks many batches at once."""
    arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    kinds = {"str": arrow.string(), "bool": arrow.bool_(), "int": arrow.int64(), "float": arrow.float64()}
    kinds |= {"tuple[str, ...]": arrow.list_(arrow.string())}
    hints = {f.name: f.type.__name__ if isinstance(f.type, type) else str(f.type) for f in fields(SessionRow)}
    columns = {name: kinds.get(hint.split(" |")[0], arrow.list_(arrow.float64())) for name, hint in hints.items()}
    table = arrow.Table.from_pylist([asdict(row) for row in rows], schema=arrow.schema(columns))
    with whole_file(file) as scratch:
        parquet.write_table(table, scratch)


def batch_sentence(rows: Sequence[SessionRow]) -> str:
    """Return how many are run, were finished before, have failed."""
    counts = batch_document(rows)
    words = {"done": "run", "skipped": "finished before", "failed": "without a result"}
    parts = [f"{counts[key]} {text}" for key, text in words.items() if counts[key]]
    return f"{len(rows)} {'session' if len(rows) == 1 else 'sessions'}: {', '.join(parts) or 'nothing to do'}."


def run_jobs(
    jobs: Sequence[BatchJob], workers: int = 1, scheduler: str = "", say: Callable[[str], object] = str
) -> Generator[SessionRow]:
    """Run the jobs on this process, on so many, or on those of a scheduler; rows as they come.

    Args:
        say: is told what somebody has to know meanwhile; by default nobody is.

    Raises:
        InputError: the packages for more than one process are missing, or the scheduler does not answer.
    """
    if workers == 1 and not scheduler:
        yield from map(run_session, jobs)
        return
    opened: AbstractContextManager[Any] = (
        joined_client(scheduler) if scheduler else local_client(min(workers, len(jobs)))
    )
    with opened as client:
        if not client.scheduler_info()["workers"]:
            say(f"{scheduler} has no workers yet; waiting for one (dask worker {scheduler})")
        at_once = sessions_at_once(client)
        yield from rows_from(client, [replace(job, at_once=at_once) for job in jobs])


def rows_from(
    client: Any, jobs: Sequence[BatchJob], work: Callable[[BatchJob], SessionRow] = run_session
) -> Iterator[SessionRow]:
    """Yield rows from the workers of a client: all jobs at once; then, one after the other, those whose workers died.

    Who has killed a worker is not certain where several sessions were with it, and what is too large beside another
    may have room alone.
    """
    # One group of tasks: the scheduler keeps them, and hands a worker no second one while it has one.
    keys = [(f"stitch-{job.batch}", job.name) for job in jobs]
    futures = client.map(work, jobs, key=keys, pure=False)
    job_of = dict(zip(futures, jobs, strict=True))
    suspected = []
    for done in import_module("distributed").as_completed(futures).batches():
        # Fetched together: one by one a scheduler would be busy with that alone.
        finished = [future for future in done if future.status == "finished"]
        rows = dict(zip(finished, client.gather(finished), strict=True))
        for future in done:
            job = job_of.pop(future)
            row = rows.get(future) or _row_of_future(future, job)
            # The scheduler need not keep what has been told.
            future.release()
            if row is None:
                suspected.append(job)
            else:
                yield row
    for job in suspected:
        alone = client.submit(work, job, key=(f"stitch-{job.batch}-alone", job.name), pure=False)
        yield _row_of_future(alone, job) or failed_row(str(job.session), job.name, _WORKERS_DIED)


def _row_of_future(future: Any, job: BatchJob) -> SessionRow | None:
    """Return what a future holds; None where workers died."""
    try:
        row: SessionRow = future.result()
        return row
    except Exception as error:  # of the cluster: the session's own are in its row
        match type(error).__name__:
            case "KilledWorker":
                return None
            case "CancelledError" | "FutureCancelledError":
                return failed_row(str(job.session), job.name, _SCHEDULER_GONE)
        return failed_row(str(job.session), job.name, error)


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
