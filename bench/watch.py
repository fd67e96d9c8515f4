"""A cell over days: false alarms, what is named and when, coverage, time and size; then a real arm over hours.

The
real arm is the UR10's series A: 11,911 poses with a tracker, their times and the temperature of the air. Every block is
a session of its own, run with joint offsets and link geometry as effects, and appended to the history of a cell.
"""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from bench.harness import SHARED_DATA, Parts, Row, Table, grouped, markdown
from data_synth.cell_history import HAND_EYE, CellHistory, CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from stitch.api.pipeline import run
from stitch.model.model_toml import ModelFile
from stitch.numerics.units import length_text
from stitch.output.result_document import model_of
from stitch.output.run_folder import write_with_page
from stitch.plugins.watch import control_charts, state_bank
from stitch.plugins.watch.history import HISTORY_FILE, open_history, read_record
from stitch.plugins.watch.report import CellReport, cell_report, cell_trend
from stitch.plugins.watch.update import DAY_SECONDS, RUN_LENGTH, append_runs, regressor_prior_sigmas, regressors
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData
from viz.watch.cell_page import write_page

THERMAL = (1.0, 4.0)  # cycles, in sigmas
HALLS, CELLS_OF_HALL = 50, 50
MONTHS = 8
GROWTH_FROM = (0.0, 8.0)  # days
SIZES = (100, 1_000, 10_000)
BLOCKS, POSES, EFFECTS = 24, 120, ["joint_offset", "link_geometry"]
HOURS = ((0, 2), (2, 4), (8, 10), (10, 12), (14, 18), (48, 58), (66, 80))
HOUR = 3600.0
_WORN = "joint_compliance.c2"
_PARAMETERS = 12
_CHANNELS = ["air_temperature_c"]
_Z95 = 1.96
_MORE = 40


def jobs(seeds: range, cells: int) -> Iterator[Row]:
    """A hall of so many cells for every seed, months, sizes, and the real arm."""
    for k, thermal in enumerate(THERMAL):
        yield from ({"part": "silence", "thermal": thermal, "hall": 1000 * k + h, "cells": cells} for h in seeds)
    for start in GROWTH_FROM:
        yield from ({"part": "months", "start": start, "seed": seed} for seed in range(min(MONTHS, len(seeds))))
    yield from ({"part": "size", "sessions": sessions} for sessions in SIZES)
    yield {"part": "real"}


def _silence(job: Row) -> Row:
    """False alarms where nothing happens but a thermal cycle and noise."""
    return {"alarms": _alarms(job["hall"], job["thermal"], job["cells"])}


def _alarms(hall: int, thermal: float, cells_of_hall: int) -> int:
    """Alarms of cells that share hours and air; a parameter that alarmed begins anew with its charts."""
    plan = CellPlan(knock_day=None, growth=0.0, thermal=thermal)
    cells = [cell_history(10_000 * hall + k, plan, hall=hall) for k in range(cells_of_hall)]
    times, air = cells[0].time, cells[0].air_temperature_c
    values = np.hstack([c.found for c in cells])
    sigma = np.concatenate([c.sigma for c in cells])
    covariates = regressors(times, (air - air[0])[:, None], _CHANNELS)
    still = (state_bank.MEMBERS[state_bank.STILL], state_bank.MEMBERS[state_bank.STEADY])
    bank = state_bank.with_parameters(
        state_bank.empty_bank(covariates.shape[1], still), values[0], sigma, regressor_prior_sigmas(_CHANNELS), still
    )
    charts, limit, alarms = (
        control_charts.empty_charts(values.shape[1]),
        control_charts.chart_limits(RUN_LENGTH, _PARAMETERS),
        0,
    )
    sloped = np.zeros(values.shape[1], bool)
    days = np.diff(times, prepend=times[0]) / DAY_SECONDS
    for k in range(len(times)):
        bank, innovations = state_bank.updated_bank(
            state_bank.predicted_bank(bank, days[k]), values[k], sigma, covariates[k]
        )
        charts = control_charts.updated_charts(charts, innovations)
        odds = state_bank.slope_odds(bank, 0, 1) / state_bank.odds_limit(_PARAMETERS)
        new, sloped = (odds >= 1) & ~sloped, sloped | (odds >= 1)
        hit = (control_charts.limit_shares(charts, limit).max(axis=1) >= 1) | new
        alarms += int(hit.reshape(cells_of_hall, -1).any(axis=1).sum())
        charts = type(charts)(np.where(hit[:, None, None], 0.0, charts.cusums), np.where(hit, 0.0, charts.ewma))
    return alarms


def _month(job: Row) -> Row:
    """What is said of one cell with a knocked mount and a joint that wears after its month, and coverage."""
    start = job["start"]
    plan = CellPlan(growth_day=start)
    cell = cell_history(job["seed"] + int(100 * start), plan)
    with tempfile.TemporaryDirectory() as folder, open_history(Path(folder) / "cell", new=True) as history:
        append_runs(history, list(records_of(cell)))
        report = cell_report(history)
        trend = cell_trend(history, report)
    truth = cell.truth.copy()
    truth[:, : len(HAND_EYE)] -= cell.found[0, : len(HAND_EYE)]
    off = trend.smoothed - truth
    common = np.array([p.common_sigma for p in report.parameters])
    alone = np.sqrt(np.maximum(trend.smoothed_sigmas**2 - common**2, 0.0))
    return _named(cell, plan, report) | {
        "coverage": float((np.abs(off) < _Z95 * trend.smoothed_sigmas).mean()),
        "own": float((np.abs(off - cell.common) < _Z95 * alone)[1:].mean()),
    }


def _named(cell: CellHistory, plan: CellPlan, report: CellReport) -> dict[str, float]:
    """Distances in sessions and days between what happened and what is said; NaN where it is not said."""
    assert plan.knock_day is not None
    days = (cell.time - 1.79e9) / 86400
    knocked = int(np.argmax(days >= plan.knock_day))
    number = {run: int(name[1:]) for run, name in report.run_names.items()}
    changes = [(p.name, c) for p in report.parameters for c in p.changes]
    mount = [
        (p.name, c) for p in report.parameters for c in p.changes if p.name.startswith("hand_eye") and c.kind == "step"
    ]
    clearest = min((c for _, c in mount), key=lambda c: c.p_value, default=None)
    first = min((number[c.raised] for _, c in mount if number[c.raised] >= knocked), default=None)
    worn = [c for name, c in changes if name == _WORN]
    true_axes = {f"hand_eye.{axis}" for axis, moved in zip(HAND_EYE, plan.knock, strict=True) if moved}
    return {
        "onset": np.nan if clearest is None else float(number[clearest.since] - knocked),
        "delay": np.nan if first is None else float(first - knocked + 1),
        "growth": float(min((days[number[c.raised]] for c in worn), default=np.nan) - plan.growth_day),
        "drift": float(any(c.kind == "drift" for c in worn)),
        "others": sum(name not in true_axes | {_WORN} for name, _ in changes),
    }


def _size(job: Row) -> Row:
    """What one session more costs, how long report and page take, how large the file is, by the processor's clock."""
    sessions = job["sessions"]
    plan = CellPlan(days=(sessions + _MORE) // 20, knock_day=None, growth=0.0)
    records = [replace(r, run_hash=f"{r.run_hash} of {sessions}") for r in records_of(cell_history(1, plan))]
    with tempfile.TemporaryDirectory() as folder, open_history(Path(folder) / "cell", new=True) as history:
        append_runs(history, records[:sessions])
        costs = []
        for record in records[sessions:]:
            begun = time.process_time()
            append_runs(history, [record])
            costs.append(1e3 * (time.process_time() - begun))
        begun = time.process_time()
        report = cell_report(history)
        reported = time.process_time() - begun
        write_page(cell_trend(history, report), Path(folder) / "watch.html")
        page = time.process_time() - begun
        history.sql("PRAGMA wal_checkpoint(TRUNCATE)")
        size = (Path(folder) / "cell" / HISTORY_FILE).stat().st_size / 1e6
    return {"costs": costs, "reported": reported, "page": page, "size": size}


def _real(job: Row) -> Row:
    """What the history of the measured blocks says, and a model of the first two hours judged later."""
    session = load_session(SHARED_DATA / "ur10-tmac-A")
    times = np.array([float(view.time_s or 0.0) for view in session.views])
    # In blocks of equal number; of each as many views, evenly spread, as a session has.
    blocks = np.array_split(np.arange(len(session.views)), BLOCKS)
    blocks = [part[np.linspace(0, len(part) - 1, POSES).astype(int)] for part in blocks]
    with tempfile.TemporaryDirectory() as folder:
        records = []
        for k, index in enumerate(blocks):
            name, out = f"b{k:02d}", Path(folder) / f"b{k:02d}"
            out.mkdir()
            write_with_page(run(_block(session, index, name), effects=EFFECTS), out)
            air = float(np.mean([session.views[i].covariates["air_temperature_c"] for i in index]))
            record = read_record(out, at=1.6e9 + float(times[index].mean()))
            covariates = {"air_temperature_c": air}
            records.append(replace(record, session=name, session_hash=f"block {k}", covariates=covariates))
        with open_history(Path(folder) / "ur10", new=True) as history:
            append_runs(history, records)
            report = cell_report(history)
    return {"hours": times[-1] / HOUR, "moved": _moved(report), "later": _later(session, times)}


def _block(session: SessionData, index: np.ndarray, name: str) -> SessionData:
    """Some views as a session of their own."""
    return replace(session, name=name, views=tuple(session.views[i] for i in index))


def _moved(report: CellReport) -> list[list[str]]:
    lines = []
    for p in sorted(report.parameters, key=lambda p: -p.scatter):
        moved = p.changes[0] if p.changes else None
        kind = "–" if moved is None else f"{moved.kind} since {report.run_names[moved.since]}"
        size = "–" if moved is None else f"{moved.size:.2g} ± {moved.sigma:.1g} {p.unit}"
        air = ", ".join(f"{f.per_unit:.2g} ± {f.sigma:.1g} {p.unit}/°C" for f in p.follows) or "–"
        lines.append([p.name, f"{p.scatter:.1f}", kind, size, air])
    return lines


def _later(session: SessionData, times: np.ndarray) -> list[list[str]]:
    """The model of the first two hours on later poses, beside a model of their own hours."""

    def model(index: np.ndarray) -> ModelFile:
        return model_of(run(_block(session, index, "fitted"), effects=EFFECTS))

    early = model(_some(np.flatnonzero(times < 2 * HOUR)))
    everywhere = model(_some(np.arange(len(times))))
    lines = []
    for low, high in HOURS:
        hours = np.flatnonzero((times >= low * HOUR) & (times < high * HOUR))
        judged = _block(session, _some(hours[1::2]), "judged")
        rms = []
        for fitted in (early, model(_some(hours[::2])), everywhere):
            targets = run(judged, fitted).targets
            assert targets is not None
            distances = targets.rows.distances(targets.rows.residual)
            rms.append(float(np.sqrt(np.mean(distances[np.isfinite(distances)] ** 2))))
        off = f"{joints_off(session, times, low, high):.0f}°"
        lines.append([f"{low} to {high}", *(length_text(x, "mm") for x in rms), off])
    return lines


def joints_off(session: SessionData, times: np.ndarray, low: float, high: float) -> float:
    """Median distance in the space of the joints, degrees, to the nearest other pose of the first two hours."""
    joints = np.degrees(np.array([view.joints for view in session.views]))
    early, later = (joints[(times >= a * HOUR) & (times < b * HOUR)] for a, b in ((0, 2), (low, high)))
    nearest = 2 if low == 0 else 1
    return float(np.median(cKDTree(early).query(later, k=[nearest])[0]))


def _some(index: np.ndarray) -> np.ndarray:
    return index[np.unique(np.linspace(0, len(index) - 1, 2 * POSES).astype(int))]


def _silence_table(rows: list[Row]) -> list[str]:
    lines = []
    for thermal, halls in grouped(rows, "thermal").items():
        alarms, months = sum(row["alarms"] for row in halls), sum(row["cells"] for row in halls)
        low, high = chi2.ppf([0.025, 0.975], [2 * alarms or 1, 2 * alarms + 2]) / 2 / months * 100
        interval = f"{low if alarms else 0:.2f} to {high:.2f}"
        lines.append([f"{thermal:g}", f"{months:,}", alarms, f"{100 * alarms / months:.2f}", interval])
    title = "**Nothing happens**: false alarms in months of 600 sessions; the limits are for one in 200"
    head = "thermal cycle, sigmas | cell-months | false alarms | in 100 cell-months | 95 % interval"
    return [title, "", *markdown(head, lines)]


def _months_table(rows: list[Row]) -> list[str]:
    lines = []
    for start, cells in grouped(rows, "start").items():
        t = {key: np.array([row[key] for row in cells], float) for key in cells[0] if key not in ("part", "start")}
        lines.append(
            [
                f"day {start:g}",
                f"{np.nanmax(np.abs(t['onset'])):.0f} sessions",
                f"{np.nanmedian(t['delay']):.0f}, {np.nanmax(t['delay']):.0f}",
                f"{np.nanmedian(t['growth']):.1f}, {np.nanmax(t['growth']):.1f}",
                f"{int(t['drift'].sum())} of {len(cells)}",
                int(t["others"].sum()),
                f"{t['coverage'].mean():.3f}",
                f"{t['own'].mean():.3f}",
            ]
        )
    head = "growth from | onset of the knock off by (worst) | knock seen with session (median, worst)"
    head += " | growth seen after days (median, worst) | named a drift | other names | coverage of 95 %"
    title = f"**A month** of 20 sessions a day, knock on day 17, {len(cells)} cells each"
    return [title, "", *markdown(f"{head} | without the common part", lines)]


def _size_table(rows: list[Row]) -> list[str]:
    lines = []
    for row in rows:
        more = f"{np.median(row['costs']):.0f}, {max(row['costs']):.0f}"
        rest = [f"{row['reported']:.2f}", f"{row['page']:.2f}", f"{row['size']:.1f}"]
        lines.append([f"{row['sessions']:,}", more, *rest])
    title = "**Growing histories** of 12 parameters, one processor"
    head = "sessions | one more, ms (median, most) | report, s | page with drawings, s | file, MB"
    return [title, "", *markdown(head, lines)]


def _real_tables(rows: list[Row]) -> list[str]:
    [row] = rows
    return [
        f"**UR10, series A**: {BLOCKS} blocks of {POSES} poses over {row['hours']:.0f} hours",
        "",
        *markdown("parameter | scatter of the blocks, stated sigmas | moved | size | follows the air", row["moved"]),
        "",
        "**The first two hours, later**: rms 3D distance of poses that took no part in a fit",
        "",
        *markdown(
            "hours | model of hours 0 to 2 | model of these hours | model of all hours | joints off hours 0 to 2",
            row["later"],
        ),
    ]


PARTS = Parts(
    {
        "silence": (_silence, _silence_table),
        "months": (_month, _months_table),
        "size": (_size, _size_table),
        "real": (_real, _real_tables),
    }
)
TABLE = Table(
    jobs, PARTS.trial, PARTS.summary, range(HALLS), page="watch", block="tables", settings={"cells": CELLS_OF_HALL}
)
