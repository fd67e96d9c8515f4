"""Simulated months with a knocked mount and a joint that wears: what is named, with which session, how soon."""

import tempfile
from pathlib import Path

import numpy as np

from data_synth.cell_history import HAND_EYE, CellHistory, CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from stitch.plugins.watch.history import open_history
from stitch.plugins.watch.report import CellReport, cell_report, cell_trend
from stitch.plugins.watch.update import append_runs

CELLS = 8
_Z95 = 1.96
_WORN = "joint_compliance.c2"


def months() -> list[str]:
    """Two plans: growth from the first day on, and from the eighth."""
    lines = [f"**A month** of 20 sessions a day, knock on day 17, {CELLS} cells each", ""]
    heads = ["growth from", "onset of the knock off by (worst)", "knock seen with session (median, worst)"]
    heads += ["growth seen after days (median, worst)", "named a drift", "other names", "coverage of 95 %"]
    lines += ["| " + " | ".join([*heads, "without the common part"]) + " |", "|---|" + "---:|" * len(heads)]
    for start in (0.0, 8.0):
        rows = [one(seed + int(100 * start), CellPlan(growth_day=start)) for seed in range(CELLS)]
        t = {key: np.array([row[key] for row in rows], float) for key in rows[0]}
        cells = [f"day {start:g}", f"{np.nanmax(np.abs(t['onset'])):.0f} sessions"]
        cells += [f"{np.nanmedian(t['delay']):.0f}, {np.nanmax(t['delay']):.0f}"]
        cells += [f"{np.nanmedian(t['growth']):.1f}, {np.nanmax(t['growth']):.1f}"]
        cells += [f"{int(t['drift'].sum())} of {CELLS}", f"{int(t['others'].sum())}"]
        lines.append("| " + " | ".join([*cells, f"{t['coverage'].mean():.3f}", f"{t['own'].mean():.3f}"]) + " |")
    return lines


def one(seed: int, plan: CellPlan) -> dict[str, float]:
    """What is said of one cell after its month."""
    cell = cell_history(seed, plan)
    with tempfile.TemporaryDirectory() as folder, open_history(Path(folder) / "cell", new=True) as history:
        append_runs(history, list(records_of(cell)))
        report = cell_report(history)
        course = cell_trend(history, report)
    truth = cell.truth.copy()
    truth[:, : len(HAND_EYE)] -= cell.found[0, : len(HAND_EYE)]
    off = course.smoothed - truth
    common = np.array([p.common_sigma for p in report.parameters])
    own = np.sqrt(np.maximum(course.smoothed_sigmas**2 - common**2, 0.0))
    return named(cell, plan, report) | {
        "coverage": float((np.abs(off) < _Z95 * course.smoothed_sigmas).mean()),
        "own": float((np.abs(off - cell.common) < _Z95 * own)[1:].mean()),
    }


def named(cell: CellHistory, plan: CellPlan, report: CellReport) -> dict[str, float]:
    """Distances in sessions and days between what happened and what is said; NaN where it is not said."""
    assert plan.knock_day is not None
    days = (cell.time - 1.79e9) / 86400
    knocked = int(np.argmax(days >= plan.knock_day))
    number = {run: int(name[1:]) for run, name in report.run_names.items()}
    changes = [(p.name, c) for p in report.parameters for c in p.changes]
    mount = [(p.name, c) for p, c in _pairs(report) if p.name.startswith("hand_eye") and c.kind == "step"]
    clearest = min((c for _, c in mount), key=lambda c: c.p_value, default=None)
    first = min((number[c.raised] for _, c in mount if number[c.raised] >= knocked), default=None)
    worn = [c for name, c in changes if name == _WORN]
    true_axes = {f"hand_eye.{axis}" for axis, moved in zip(HAND_EYE, plan.knock, strict=True) if moved}
    return {
        "onset": np.nan if clearest is None else number[clearest.since] - knocked,
        "delay": np.nan if first is None else first - knocked + 1,
        "growth": min((days[number[c.raised]] for c in worn), default=np.nan) - plan.growth_day,
        "drift": float(any(c.kind == "drift" for c in worn)),
        "others": sum(name not in true_axes | {_WORN} for name, _ in changes),
    }


def _pairs(report: CellReport) -> list:
    return [(p, c) for p in report.parameters for c in p.changes]
