"""A cell that is driven until U is reached, with faults of its command; how few views the best of random sets needs."""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import stitch
from bench.harness import Row, Table, markdown, share
from data_synth.cells.driven_cell import new_cell
from stitch.errors import NoResultError
from stitch.plugins.metrology.planning.drive import DrivenCell, drive
from stitch.plugins.metrology.planning.expected_model import cell_of_state, simulate_views
from stitch.plugins.metrology.planning.plan import KnownPlace, PossibleViews, place_lever
from stitch.plugins.metrology.planning.planned_views import candidate_joints, with_views

# U that is asked, mm; faults of the command by the seed; views at the most, of the part's longest side.
_UNTIL, _MOST, _SIZE = 0.2, 20, 250.0
_FAULTS = ((), ("fail",), ("lose",), ("far",), ("fail", "lose", "far"), ("hang",))
_SETS, _POOL = 200, 40


def jobs(seeds: range) -> Iterator[Row]:
    """Yield every trial."""
    for seed in seeds:
        yield {"seed": seed, "faults": list(_FAULTS[seed % len(_FAULTS)])}


def trial(job: Row) -> Row:
    """Return how many views were driven to, how many calls that took, and how many the best of random sets needs."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "cell"
        start = np.radians(new_cell(folder, job["seed"]))
        program = f"{sys.executable} -m data_synth.cells.driven_cell {job['seed']} {' '.join(job['faults'])}"
        cell, told, ended, lost = DrivenCell(folder, size=_SIZE, start=start, most=_MOST), [], 0, False
        while ended <= len(job["faults"]):
            try:
                drive(cell, _UNTIL, program, 20.0, lambda views, U: told.append((views, U)))
                break
            except NoResultError:
                ended += 1
                there = len(stitch.load_session(folder, scans=False).views) if (folder / "views.csv").is_file() else 0
                lost |= bool(told) and there < told[-1][0]
        views, U = told[-1]
        return {"views": views, "U": U, "ended": ended, "lost": lost, "least": _least_random(folder, job["seed"])}


def _least_random(folder: Path, seed: int) -> int:
    """Return the fewest views of which the best of many random sets is expected to have a U as small as those driven
    to, all expected alike; the first view is in every set."""
    run = stitch.run(stitch.load_session(folder))
    planned = cell_of_state(run, run.fused.points, run.fused.normals)
    assert planned.fitted_scatter is not None
    driven = len(run.session.views)
    pool = candidate_joints(run.session, planned.cell, _POOL)
    every = with_views(run.session, list(pool), in_turn=False)
    possible = PossibleViews(every, planned.cell, simulate_views(every, planned.cell), planned.fitted_scatter.believed)
    channel = possible.channel()
    goal = KnownPlace(channel, place_lever(possible.simulated.field_middle(), channel.columns.shape[1]), float("nan"))
    asked = float(goal.U(channel.normal(range(driven))))
    rng = np.random.default_rng(seed)
    for count in range(3, driven + 1):
        sets = [[0, *rng.choice(np.arange(driven, len(every.views)), count - 1, False)] for _ in range(_SETS)]
        if min(float(goal.U(channel.normal(chosen))) for chosen in sets) <= asked:
            return count
    return driven + 1


def _lines(rows: list[Row]) -> list[str]:
    reached = [row for row in rows if row["U"] is not None and row["U"] <= _UNTIL]
    within = share(row["views"] <= 2 * row["least"] for row in reached)
    lost = share(bool(row["lost"]) for row in rows)
    few = f"{np.median([row['views'] for row in reached]):.0f}, {np.median([row['least'] for row in reached]):.0f}"
    ended = str(sum(row["ended"] for row in rows))
    head = "cells | U reached | views, best random set (median) | within twice that | calls cut short | views lost"
    return markdown(head, [(str(len(rows)), share(row in reached for row in rows), few, within, ended, lost)])


TABLE = Table(jobs, trial, _lines, range(500, 520), page="plan", block="driven")
