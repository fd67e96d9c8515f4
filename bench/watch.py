"""A cell over days: false alarms, what is named and when, coverage, time and size."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from bench.harness import Parts, Row, Table, grouped, markdown
from data_synth.cell_history import HAND_EYE, CellHistory, CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from stitch.plugins.watch import control_charts, state_bank
from stitch.plugins.watch.history import HISTORY_FILE, open_history
from stitch.plugins.watch.report import CellReport, cell_report, cell_trend
from stitch.plugins.watch.update import DAY_SECONDS, RUN_LENGTH, append_runs, regressor_prior_sigmas, regressors
from viz.watch.cell_page import write_page

THERMAL = (1.0, 4.0)  # cycles, in sigmas
HALLS, CELLS_OF_HALL = 50, 50
MONTHS = 8
GROWTH_FROM = (0.0, 8.0)  # days
SIZES = (100, 1_000, 10_000)
_WORN = "joint_compliance.c2"
_PARAMETERS = 12
_CHANNELS = ["air_temperature_c"]
_Z95 = 1.96
_MORE = 40


def jobs(seeds: range, cells: int) -> Iterator[Row]:
    """A hall of so many cells for every seed, months, sizes."""
    for k, thermal in enumerate(THERMAL):
        yield from ({"part": "silence", "thermal": thermal, "hall": 1000 * k + h, "cells": cells} for h in seeds)
    for start in GROWTH_FROM:
        yield from ({"part": "months", "start": start, "seed": seed} for seed in range(min(MONTHS, len(seeds))))
    yield from ({"part": "size", "sessions": sessions} for sessions in SIZES)


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


PARTS = Parts(
    {
        "silence": (_silence, _silence_table),
        "months": (_month, _months_table),
        "size": (_size, _size_table),
    }
)
TABLE = Table(
    jobs, PARTS.trial, PARTS.summary, range(HALLS), page="watch", block="tables", settings={"cells": CELLS_OF_HALL}
)
