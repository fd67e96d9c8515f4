"""A run joins the history of its cell: stored, then followed from the last state on."""

import hashlib
from collections.abc import Sequence

import numpy as np

from stitch.errors import InputError
from stitch.watch.catch_up import catch_up, forget_since
from stitch.watch.history import History, insert_run, matrix_json
from stitch.watch.mount_twist import TWIST_NAMES, mount_twist, twist_covariance
from stitch.watch.read_record import scanned_middle
from stitch.watch.regressors import chosen_channels
from stitch.watch.run_record import Estimate, RunRecord

# One false alarm of the whole cell in so many sessions where nothing happens: two hundred months of 600, so that one in
# a hundred remains where parameters follow temperatures in ways that the regressors do not quite have.
RUN_LENGTH = 120_000.0


def append_runs(history: History, records: Sequence[RunRecord]) -> int:
    """Append runs in the order of time, all or none; those that are there already change nothing. How many were new.

    Raises:
        InputError: a run of another cell, or one that repeats the numbers of another session.
    """
    with history.writing():
        begun = [_store_run(history, record) for record in sorted(records, key=lambda r: r.time)]
        new = [time for time in begun if time is not None]
        if new:
            catch_up(history, min(new))
        return len(new)


def _store_run(history: History, record: RunRecord) -> float | None:
    """Store a run; the time from which the history has to be followed anew, None where the run is there already."""
    if history.sql("SELECT 1 FROM runs WHERE run_hash = ?", record.run_hash):
        return None
    if history.stated("length_unit") is None:
        _begin_cell(history, record)
    _require_same_cell(history, record)
    begun = min(record.time, _replace_former_run(history, record))
    numbers = _numbers_hash(record)
    for (other,) in history.sql("SELECT run FROM runs WHERE numbers_hash = ?", numbers):
        raise InputError(
            f"{record.path}: has the very numbers of {other}: one fit, not two; to fix: run its session for itself"
        )
    run = insert_run(history, record, numbers)
    estimates = [*_hand_eye_estimates(history, record), *record.estimates]
    _insert_parameters(history, record, estimates)
    known = dict(history.sql("SELECT name, id FROM parameters"))
    rows = [(run, known[e.name], e.value, e.sigma) for e in estimates if np.isfinite(e.sigma) and e.sigma > 0]
    if not rows:
        raise InputError(f"{record.path}: states no sigma of anything; to fix: run its session again")
    history.many("INSERT INTO estimates VALUES (?, ?, ?, ?)", rows)
    history.many("INSERT INTO covariates VALUES (?, ?, ?)", [(run, *item) for item in record.covariates.items()])
    if _update_channels(history, record):
        return -np.inf
    return begun


def _replace_former_run(history: History, record: RunRecord) -> float:
    """A session that was run again counts once, as it was run last; the time of the former run, inf without."""
    begun = np.inf
    for run, time, run_hash in history.sql(
        "SELECT id, time, run_hash FROM runs WHERE session_hash = ?", record.session_hash
    ):
        begun = min(begun, float(time))
        forget_since(history, time)
        for table, key in (("runs", "id"), ("estimates", "run"), ("covariates", "run")):
            history.sql(f"DELETE FROM {table} WHERE {key} = ?", run)
        if history.stated("in_use") == run_hash:
            history.state({"in_use": record.run_hash})
    return begun


def _begin_cell(history: History, record: RunRecord) -> None:
    """What the first run fixes for good: units, the mount's place, the point about which it is watched."""
    centre, radius = scanned_middle(record)
    history.state(
        {
            "length_unit": record.length_unit,
            "mount": record.mount,
            "hand_eye_first": record.T_mount.tolist(),
            "centre_scanner": centre.tolist(),
            "radius": radius,
            "first_time": record.time,
            "run_length": RUN_LENGTH,
            "channels": [],
            "channel_references": {},
            "in_use": record.run_hash,
        }
    )


def _require_same_cell(history: History, record: RunRecord) -> None:
    for key, own in (("length_unit", record.length_unit), ("mount", record.mount)):
        if (stated := history.stated(key)) != own:
            raise InputError(
                f"{record.path}: has {key} {own}, the cell {history.folder} {stated}; to fix: name the cell of this run"
            )


def _hand_eye_estimates(history: History, record: RunRecord) -> list[Estimate]:
    first, centre = np.array(history.stated("hand_eye_first")), np.array(history.stated("centre_scanner"))
    values = mount_twist(record.T_mount, first, centre)
    sigmas = np.sqrt(np.maximum(np.diag(twist_covariance(record.covariance, record.T_mount, first, centre)), 0.0))
    units = ["rad"] * 3 + [record.length_unit] * 3
    own = zip(TWIST_NAMES, units, values, sigmas, strict=True)
    return [Estimate(f"hand_eye.{name}", unit, float(value), float(sigma)) for name, unit, value, sigma in own]


def _insert_parameters(history: History, record: RunRecord, estimates: Sequence[Estimate]) -> None:
    units = dict(history.sql("SELECT name, unit FROM parameters"))
    for estimate in estimates:
        if estimate.name not in units:
            history.sql("INSERT INTO parameters (name, unit) VALUES (?, ?)", estimate.name, estimate.unit)
        elif units[estimate.name] != estimate.unit:
            raise InputError(
                f"{record.path}: counts {estimate.name} in {estimate.unit}, the cell in {units[estimate.name]}; "
                "to fix: name the cell of this run"
            )


def _update_channels(history: History, record: RunRecord) -> bool:
    """Whether what parameters may follow is another now: then all is followed anew."""
    before, references = history.stated("channels"), history.stated("channel_references")
    if record.covariates.keys() <= references.keys():
        return False
    references = record.covariates | references
    own = chosen_channels(references)
    history.state({"channels": own, "channel_references": references})
    return bool(before != own)


def _numbers_hash(record: RunRecord) -> str:
    told = (
        matrix_json(record.T_mount)
        + matrix_json(record.covariance)
        + repr([(e.name, e.value) for e in record.estimates])
    )
    return hashlib.sha256(told.encode()).hexdigest()
