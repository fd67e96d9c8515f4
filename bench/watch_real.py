"""A measured arm over hours, in blocks of time: what moves, what repeats, what a model of the first hours leaves.

The UR10's series A: 11,911 poses with a tracker, their times and the temperature of the air. Every block is a session
of its own, run with joint offsets and link geometry as effects, and appended to the history of a cell.
"""

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from stitch.api.pipeline import run
from stitch.numerics.units import length_text
from stitch.output.result_document import model_of
from stitch.output.run_folder import write_with_page
from stitch.plugins.watch.history import open_history, read_record
from stitch.plugins.watch.report import CellReport, cell_report
from stitch.plugins.watch.update import append_runs
from stitch.run_data import RunData
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData

SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
BLOCKS, POSES, EFFECTS = 24, 120, ["joint_offset", "link_geometry"]
HOUR = 3600.0


def block(session: SessionData, index: np.ndarray, name: str) -> SessionData:
    """Some views as a session of their own."""
    return replace(session, name=name, views=tuple(session.views[i] for i in index))


def blocks(session: SessionData) -> list[np.ndarray]:
    """Views in the order of time, in blocks of equal number; of each as many, evenly spread, as a session has."""
    parts = np.array_split(np.arange(len(session.views)), BLOCKS)
    return [part[np.linspace(0, len(part) - 1, POSES).astype(int)] for part in parts]


def distances(found: RunData) -> np.ndarray:
    """3D distances of the probe from where the model puts it."""
    assert found.targets is not None
    rows = found.targets.rows
    d = rows.distances(rows.residual)
    return d[np.isfinite(d)]


def real() -> list[str]:
    """What the history of the blocks says, and the first two hours judged later."""
    session = load_session(SHARED / "ur10-tmac-A")
    parts = blocks(session)
    times = np.array([float(view.time_s or 0.0) for view in session.views])
    with tempfile.TemporaryDirectory() as folder:
        runs = []
        for k, index in enumerate(parts):
            found = run(block(session, index, f"b{k:02d}"), effects=EFFECTS)
            runs.append(found)
            out = Path(folder) / f"b{k:02d}"
            out.mkdir()
            write_with_page(found, out)
        with open_history(Path(folder) / "ur10", new=True) as history:
            records = []
            for k, index in enumerate(parts):
                record = read_record(Path(folder) / f"b{k:02d}", at=1.6e9 + float(times[index].mean()))
                air = np.mean([session.views[i].covariates["air_temperature_c"] for i in index])
                own = {
                    "session": f"b{k:02d}",
                    "session_hash": f"block {k}",
                    "covariates": {"air_temperature_c": float(air)},
                }
                records.append(replace(record, **own))
            append_runs(history, records)
            report = cell_report(history)
    return [*_moved(report, times), "", *_later(session, times)]


def _moved(report: CellReport, times: np.ndarray) -> list[str]:
    lines = [f"**UR10, series A**: {BLOCKS} blocks of {POSES} poses over {times[-1] / HOUR:.0f} hours", ""]
    lines += [
        "| parameter | scatter of the blocks, stated sigmas | moved | size | follows the air |",
        "|---|---:|---|---:|---|",
    ]
    for p in sorted(report.parameters, key=lambda p: -p.scatter):
        moved = p.changes[0] if p.changes else None
        said = "–" if moved is None else f"{moved.kind} since {report.run_names[moved.since]}"
        size = "–" if moved is None else f"{moved.size:.2g} ± {moved.sigma:.1g} {p.unit}"
        air = ", ".join(f"{f.per_unit:.2g} ± {f.sigma:.1g} {p.unit}/°C" for f in p.follows) or "–"
        lines.append(f"| {p.name} | {p.scatter:.1f} | {said} | {size} | {air} |")
    return lines


def _later(session: SessionData, times: np.ndarray) -> list[str]:
    """The model of the first two hours on later poses, beside a model of their own hours."""
    lines = ["**The first two hours, later**: rms 3D distance of poses that took no part in a fit", ""]
    lines += ["| hours | model of hours 0 to 2 | model of these hours | model of all hours | joints off hours 0 to 2 |"]
    lines += ["|---|---:|---:|---:|---:|"]
    first = _some(np.flatnonzero(times < 2 * HOUR))
    early = model_of(run(block(session, first, "early"), effects=EFFECTS))
    everywhere = model_of(run(block(session, _some(np.arange(len(times))), "all"), effects=EFFECTS))
    for low, high in ((0, 2), (2, 4), (8, 10), (10, 12), (14, 18), (48, 58), (66, 80)):
        own = np.flatnonzero((times >= low * HOUR) & (times < high * HOUR))
        fit_on, judge_on = _some(own[::2]), _some(own[1::2])
        these = model_of(run(block(session, fit_on, "these"), effects=EFFECTS))
        judged = block(session, judge_on, "judged")
        rms = [np.sqrt(np.mean(distances(run(judged, m)) ** 2)) for m in (early, these, everywhere)]
        told = " | ".join(length_text(float(x), "mm") for x in rms)
        lines.append(f"| {low} to {high} | {told} | {joints_off(session, times, low, high):.0f}° |")
    return lines


def joints_off(session: SessionData, times: np.ndarray, low: float, high: float) -> float:
    """Median distance in the space of the joints, degrees, to the nearest other pose of the first two hours."""
    joints = np.degrees(np.array([view.joints for view in session.views]))
    early, own = (joints[(times >= a * HOUR) & (times < b * HOUR)] for a, b in ((0, 2), (low, high)))
    nearest = 2 if low == 0 else 1
    return float(np.median(cKDTree(early).query(own, k=[nearest])[0]))


def _some(index: np.ndarray) -> np.ndarray:
    return index[np.unique(np.linspace(0, len(index) - 1, 2 * POSES).astype(int))]
