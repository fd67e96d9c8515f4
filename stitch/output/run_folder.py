"""The run folder on disk: written whole or not at all."""

import csv
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from importlib.metadata import entry_points
from itertools import chain
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from stitch.effects import EFFECTS
from stitch.effects.user_source import EFFECTS_FILE
from stitch.errors import InputError
from stitch.model.model_toml import read_model, write_model
from stitch.numerics.frames import Array
from stitch.observations.surfaces.matching import Match
from stitch.output.comparison.model_history import model_history
from stitch.output.json_file import FILES, FITS, SCANS, is_run_file, require_free, write_json
from stitch.output.result_document import (
    effects_source,
    ledger,
    model_of,
    residual_columns,
    result_document,
    scanner_documents,
)
from stitch.recorder import Recorder
from stitch.run_data import FusedCloud, RunData
from stitch.session.kept_scans import write_scans
from stitch.session.reading.session_folder import measured_files
from stitch.session.session import SessionData
from stitch.system.files import claim_folder, rewrite_folder
from stitch.system.packages import arrow_alone, stitch_version, unless_missing
from stitch.system.ply_file import ply_header
from stitch.system.threads import release_mapped

# Rows that are in memory at a time.
_ROWS = 1_000_000
_PLACE = ("x", "y", "z", "nx", "ny", "nz")
_NUMBERS = (*_PLACE, "residual", "heldout")
_RESERVED_COLUMNS = {"view", "partner", *_NUMBERS, "time_s"}
# Fits that a run has had are kept by links; beyond so many bytes the oldest go.
_KEPT_BYTES = 1e9


def recordings(folder: Path) -> list[Recorder]:
    """Return what other packages record of a run into its folder, by the entry-point group `stitch.recorders`."""
    found: list[Recorder] = []
    for entry in entry_points(group="stitch.recorders"):
        with unless_missing():
            found.append(entry.load()(folder / "recording.rrd"))
    return found


def write_cloud(cloud: FusedCloud, path: Path) -> None:
    """Write a cloud as binary PLY with normals, `residual` and `views`, the number of views that support a point.

    It is written in blocks of `_ROWS`, so that a memory-mapped cloud is never in memory as a whole.
    """
    names = (*_PLACE, "residual")
    layout = np.dtype([(name, "<f4") for name in names] + [("views", "<u2")])
    with path.open("wb") as out:
        out.write(ply_header({"vertex": (layout, len(cloud.points))}))
        for start in range(0, len(cloud.points), _ROWS):
            part = slice(start, start + _ROWS)
            columns = np.column_stack([cloud.points[part], cloud.normals[part], cloud.residual[part]])
            vertex = np.empty(len(columns), layout)
            for name, column in zip(names, columns.T, strict=True):
                vertex[name] = column
            vertex["views"] = cloud.count[part]
            vertex.tofile(out)
            for values in vars(cloud).values():
                release_mapped(values)


def write_residuals(run: RunData, path: Path) -> None:
    """Write the table of residuals as Parquet."""
    import pyarrow.parquet as pq

    table = residual_table(run)
    # Dictionary encoding of numbers that never repeat takes four times as long as plain writing, and more room.
    repeated = [name for name in table.column_names if name not in _NUMBERS]
    pq.write_table(table, path, compression="zstd", use_dictionary=repeated)


def residual_table(run: RunData) -> Any:
    """Return a pyarrow.Table with a row per residual of the model, before the register stage moves single views.

    `time_s` is NaN where unknown; a covariate with the name of another column becomes `covariate_NAME`. Scalars of the
    clouds, such as intensity, are columns too: NAME of the view's point, `partner_NAME` of its partner's.
    """
    pa = arrow_alone()
    session = _without_reserved_covariates(run.session)
    of_views = {key for view in session.views for key in view.covariates}
    of_points = {key for view in session.views if view.cloud is not None for key in view.cloud.scalars}
    parts = [] if run.overlaps is None else [_columns(session, m, of_views, of_points) for m in run.overlaps.matches]
    if run.targets is not None:
        parts.append(residual_columns(run.targets, session))
    # Beside clouds, labelled points have the columns of these.
    common = [key for key in (parts or [{}])[0] if all(key in part for part in parts)]
    return pa.table({key: _joined(pa, [part[key] for part in parts]) for key in common})


def _joined(pa: Any, parts: Sequence[Array]) -> Any:
    """Return arrays, one a pair of views, joined to one pyarrow column; strings become a dictionary-encoded one.

    Args:
        pa: the module pyarrow.
        parts: numbers, or names; names repeated by `np.broadcast_to` have stride 0 and are encoded only once.
    """
    if not parts or parts[0].dtype.kind != "U":
        return pa.array(np.concatenate(parts))
    encoded = [
        pa.array(names).dictionary_encode()
        if names.strides[0]
        else pa.DictionaryArray.from_arrays(np.zeros(len(names), np.int32), names[:1])
        for names in parts
    ]
    return pa.chunked_array(encoded).unify_dictionaries().combine_chunks()


def _without_reserved_covariates(session: SessionData) -> SessionData:
    """Return the session with covariates and scalars of clouds renamed where they are called like a column."""

    def free(values: dict[str, Any]) -> dict[str, Any]:
        return {f"covariate_{key}" if key in _RESERVED_COLUMNS else key: value for key, value in values.items()}

    views = []
    for view in session.views:
        cloud = None if view.cloud is None else replace(view.cloud, scalars=free(view.cloud.scalars))
        views.append(replace(view, covariates=free(view.covariates), cloud=cloud))
    return replace(session, views=tuple(views))


def _columns(session: SessionData, m: Match, of_views: Iterable[str], of_points: Iterable[str]) -> dict[str, Array]:
    """Return columns of one pair of views, a row per correspondence; numbers that are unknown are NaN.

    Args:
        m: the correspondences: M points, indices in both clouds, residuals (length_unit), reference frame.
        of_views: names of covariates.
        of_points: names of the clouds' scalars.
    """
    size = len(m.residual)
    view, partner = session.views[m.v], session.views[m.w]
    columns = {
        "view": np.broadcast_to(np.array(view.name), size),
        "partner": np.broadcast_to(np.array(partner.name), size),
        **dict(zip(_PLACE, (*m.middle.T, *m.normal.T), strict=True)),
        "residual": m.residual,
        "time_s": np.full(size, np.nan if view.time_s is None else view.time_s),
        **{key: np.full(size, view.covariates.get(key, np.nan)) for key in sorted(of_views)},
    }
    for key in sorted(of_points):
        for name, side, index in ((key, view, m.index_v), (f"partner_{key}", partner, m.index_w)):
            # A scalar called like a covariate takes its column where the cloud has it.
            if side.cloud is not None and key in side.cloud.scalars:
                columns[name] = side.cloud.scalars[key][index]
            else:
                columns.setdefault(name, np.full(size, np.nan))
    return columns


@contextmanager
def new_folder(path: Path, sessions: Sequence[Path], force: bool = False) -> Iterator[Path]:
    """Yield a scratch folder: it replaces the run folder `path` if the block succeeds, and is deleted if it fails.

    Only files of an earlier run are replaced; other files in the folder stay.

    Args:
        sessions: folders of the sessions that are run.
        force: replace the run of other sessions too.

    Raises:
        InputError: `path` is no place for this run, or another process writes there.
    """
    require_free(path, sessions, force)
    with rewrite_folder(path, is_run_file(path)) as scratch:
        yield scratch


@contextmanager
def replace_run_files(path: Path) -> Iterator[Path]:
    """Yield a scratch folder: its files replace those of the run in `path` if the block succeeds.

    The replaced files are kept in a hidden folder, from which `restore_fit` takes them if the same effects are asked
    for again.
    """
    with rewrite_folder(path, is_run_file(path)) as scratch:
        yield scratch
        # A file system without links keeps none.
        with suppress(OSError, InputError):
            _keep_fit(path, scratch)


def restore_fit(path: Path, effects: Collection[str], recording: bool) -> bool:
    """Replace a run's files by those of an earlier fit with these effects, and return whether there was one.

    The ledger goes on: it gets a further step. An earlier fit without recording.rrd does not count if `recording` asks
    for that.

    Raises:
        InputError: another process writes there.
    """
    kept = _place_of_fit(path, effects)
    needed = ("ledger.json", "recording.rrd") if recording else ("ledger.json",)
    if kept is None or not all((kept / name).is_file() for name in needed):
        return False
    with lock_run_folder(path), replace_run_files(path) as scratch:
        # No links: who edits model.toml where it stands would edit the kept one.
        shutil.copytree(kept, scratch, dirs_exist_ok=True)
        steps = json.loads((path / "ledger.json").read_text(encoding="utf-8"))
        step = json.loads((kept / "ledger.json").read_text(encoding="utf-8"))[-1] | {"step": len(steps)}
        step.pop("notes", None)
        write_json([*steps, step], scratch / "ledger.json")
    return True


def _place_of_fit(path: Path, effects: Collection[str]) -> Path | None:
    """Return the folder in which a run's fit with these effects is kept, whether it is there or not.

    Its name is a hash of what the fit depends on: stitch's version, the effects, sizes and times of the measured files.
    None where session or model.toml changed after the fit, and for effects of a user's file, which may change.
    """
    try:
        document = json.loads((path / "result.json").read_text(encoding="utf-8"))
        sessions = [Path(session) for session in document.get("sessions", [document["session"]])]
        fitted = (path / "result.json").stat().st_mtime_ns
        edited = (path / "model.toml").stat().st_mtime_ns
        files = [(file.name, file.stat()) for session in sessions for file in measured_files(session)]
    except (OSError, ValueError, LookupError, csv.Error):
        return None
    marks = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in files]
    known = {effect.name for effect in EFFECTS.values() if effect.tier != "user"}
    if max(edited, *(time for _, _, time in marks)) > fitted or not known.issuperset(effects):
        return None
    made_of = json.dumps([stitch_version(), sorted(effects), marks])
    return path / FITS / hashlib.sha256(made_of.encode()).hexdigest()[:16]


def _keep_fit(path: Path, scratch: Path) -> None:
    """Fill the scratch folder's store of fits: those that the run folder `path` keeps, and its present fit.

    Hard links take no room. The oldest fits are deleted once all together exceed `_KEPT_BYTES`.
    """
    if (path / FITS).is_dir():
        shutil.copytree(path / FITS, scratch / FITS, copy_function=os.link)
    if (place := _place_of_fit(path, read_model(path).effects)) is not None:
        place = scratch / FITS / place.name
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        for name in FILES:
            if (path / name).is_file():
                os.link(path / name, place / name)
    size = 0
    for fit in sorted((scratch / FITS).iterdir(), key=lambda fit: -fit.stat().st_mtime_ns):
        size += sum(file.stat().st_size for file in fit.iterdir())
        if size > _KEPT_BYTES:
            shutil.rmtree(fit)


@contextmanager
def lock_run_folder(path: Path) -> Iterator[None]:
    """Let no other process write into a run folder while the block reads and writes it.

    Nothing is locked where its parent folder does not exist: reading then says what is wrong.

    Raises:
        InputError: another process writes there, or its folder of pictures is a link to elsewhere.
    """
    if not path.parent.is_dir():
        yield
        return
    with claim_folder(path):
        if (path / "pictures").is_symlink():
            raise InputError(f"{path}/pictures: is a link out of the run folder; to fix: remove it")
        yield


def call_entry_points(group: str, *arguments: Any, required: bool = False) -> None:
    """Call every function that installed packages offer under an entry-point group, with these arguments.

    Args:
        required: a missing package is an error; otherwise the function that needs it is left out with a warning.
    """
    for entry in entry_points(group=group):
        with nullcontext() if required else unless_missing():
            entry.load()(*arguments)


def preload_entry_points(*groups: str) -> None:
    """Load the functions of entry-point groups in a further thread, and return at once.

    They are called after the fit, which leaves a core idle; loading the libraries that draw takes a second.
    """

    def load() -> None:
        # What fails here fails again where it is called, and is said there.
        with suppress(Exception):
            for entry in chain.from_iterable(entry_points(group=group) for group in groups):
                entry.load()

    Thread(target=load, daemon=True).start()


def write_with_page(
    run: RunData, folder: Path, tolerance: float | None = None, record: Callable[[Recorder], None] | None = None
) -> None:
    """Write model.toml, result.json, ledger.json, stitched.ply, residuals.parquet and report.html into `folder`.

    Args:
        tolerance: within which the views have to agree on the part, length_unit.
        record: tells a recorder all of the run, to its end: for recording.rrd, which continues one that lies there.
            None: it is not written.
    """
    # Page and recording, which take longest, are made while all else is written. The headline and both wait for the
    # history; the libraries that they draw with take half a second to load, and would hold it up.
    with ThreadPoolExecutor(3) as threads:
        points = threads.submit(_write_points, run, folder)
        model_history(run)
        page = threads.submit(call_entry_points, "stitch.reports", run, folder / "report.html", tolerance)
        recording = threads.submit(_write_recording, folder, record)
        write_numbers(run, folder)
        for written in (page, recording, points):
            written.result()


def write_numbers(run: RunData, folder: Path) -> None:
    """Write model.toml, result.json and ledger.json into `folder`.

    A run of several scanners also gets a folder a session, in which they are those of its scanner alone.
    """
    write_model_with_effects(run, folder)
    document = result_document(run)
    steps = ledger(run)
    write_json(document, folder / "result.json")
    write_json(steps, folder / "ledger.json")
    for name, (own, model) in scanner_documents(run, document).items() if run.session.parts else ():
        (folder / name).mkdir(exist_ok=True)
        write_json(own, folder / name / "result.json")
        write_json(steps, folder / name / "ledger.json")
        write_model(model, folder / name / "model.toml")


def write_model_with_effects(run: RunData, folder: Path) -> None:
    """Write model.toml, and beside it the source of effects that no other file holds."""
    source = effects_source(run)
    if source is not None:
        (folder / EFFECTS_FILE).write_text(source, encoding="utf-8")
    write_model(model_of(run), folder / "model.toml")


def _write_recording(folder: Path, record: Callable[[Recorder], None] | None) -> None:
    """Write recording.rrd into a folder by what `record` tells each recorder; None: nothing is written."""
    if record is not None:
        for recorder in recordings(folder):
            record(recorder)


def _write_points(run: RunData, folder: Path) -> None:
    """Write stitched.ply, the scans' normals and, where pyarrow is installed, residuals.parquet into a folder."""
    write_cloud(run.fused, folder / "stitched.ply")
    clouds = [view.cloud for view in run.session.views if view.cloud is not None]
    if all(cloud.whole is None for cloud in clouds):
        write_scans(run.measurement.capture.scans, [cloud.points for cloud in clouds], folder / SCANS)
    with unless_missing():
        write_residuals(run, folder / "residuals.parquet")
