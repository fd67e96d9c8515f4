"""Views that are proposed: does the one of `stitch next` decide, and how many does a driven cell need?

DECIDING: cells whose views cannot tell two laws apart, and the view that `stitch next` names.

A session of few views is simulated with one law and diagnosed. Where it ends in "cannot tell" with the true law in the
group, or a joint without a law explains the views as well as that law, the proposed pose is driven in the same cell
(same arm, hand-eye, climate; scans and scatter of their own), after the wait that is asked for, and the session is
diagnosed anew; up to three times, each time at the pose that is proposed then. Counted is what is named after one view
and after three, beside the probability that was stated. Development seeds 0 to 99 and 1500 to 1519; held-out ones, run
once: from 1300 to 1339 and from 1400 to 1439, each law its own; take others.

DRIVEN: a cell that is driven until U is reached, with faults of its command; beside it how few views the best of
random sets needs.
"""

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import stitch
from bench.harness import Row, Table, grouped, markdown, share
from data_synth import kinematics
from data_synth.cells.driven_cell import new_cell
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for, small_scene
from data_synth.moment import Plan
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from stitch.api.verbs import diagnose, run
from stitch.diagnosis.deciding_view import MOST_VIEWS
from stitch.diagnosis.diagnosis import Diagnosis, Proposal
from stitch.errors import NoResultError
from stitch.numerics.frames import Array
from stitch.plugins.metrology.planning.drive import DrivenCell, drive
from stitch.plugins.metrology.planning.expected_model import cell_of_state, simulate_views
from stitch.plugins.metrology.planning.plan import KnownPlace, PossibleViews, candidate_joints, place_lever, with_views

# A law, its amplitude, the joint (from 0) that it is in, how many views there are, and the scene; of a law in a joint
# those views in which the joint turns least, of 36. Of an arm's other laws nature draws the joint.
LAWS = {
    "gear once a turn": ("gear_eccentricity", 2.5, None, 9, "blade"),
    "gear twice a turn": ("gear_harmonic", 2.5, None, 9, "blade"),
    "gear of joint 3, little turned": ("gear_eccentricity", 3.0, 2, 10, "blade"),
    "mount drifts": ("mount_drift", 1.5, None, 12, "blade"),
    "mount warms up": ("mount_warmup", 1.5, None, 12, "blade"),
    "mount creeps": ("mount_creep", 2.0, None, 9, "blade"),
    "fixture droops": ("fixture_droop", 2.0, None, 9, "blade"),
    "carried mount droops": ("mount_droop", 2.0, None, 9, "blade-table"),
    "joints give way": ("joint_compliance", 1.0, None, 7, "blade"),
    "backlash": ("backlash", 1.0, None, 7, "blade"),
}
_PLANNED = 36
# U that is asked, mm; faults of the command by the seed; views at the most, of the part's longest side.
_UNTIL, _MOST, _SIZE = 0.2, 20, 250.0
_FAULTS = ((), ("fail",), ("lose",), ("far",), ("fail", "lose", "far"), ("hang",))
_SETS, _POOL = 200, 40


def jobs(seeds: range, cells: int = 4) -> Iterator[Row]:
    """Yield every law with seeds of its own."""
    for at, law in enumerate(LAWS):
        for k in range(cells):
            yield {"law": law, "seed": seeds.start + at * cells + k}


def trial(job: Row) -> Row:
    """Return what a cell says before and after the proposed views."""
    law, amplitude, joint, count, scene = LAWS[job["law"]]
    seed = job["seed"]
    plan, rail = plan_for(load_scene(scene), seed, _PLANNED)
    keep = np.arange(count)
    if joint is not None:
        plan = replace(plan, useful=(joint,))
        angle = plan.joints[:, joint]
        keep = np.sort(np.argsort(np.abs(angle - np.median(angle)), kind="stable")[:count])
    # As many moments in every world, so that chance draws the same cell.
    keep = np.append(keep, np.repeat(keep[-1], MOST_VIEWS))
    plan = replace(plan, **{key: getattr(plan, key)[keep] for key in ("joints", "torque", "velocity")})
    hidden = {law: amplitude}
    waits = np.zeros(len(keep))
    found = _diagnosed(_measured(scene, hidden, seed, plan, rail[keep], waits), count)
    row: Row = {"verdict": found.verdict, "named": list(found.effects)}
    proposed = _deciding(found, law)
    if proposed is None and not (found.verdict == "cannot_tell" and law in found.effects):
        return row
    row["rivals"] = " / ".join(found.effects or (*proposed.separates, "no law") if proposed else found.effects)
    row["probability"] = None if proposed is None else proposed.probability
    for k in range(MOST_VIEWS):
        if proposed is not None:
            plan = _at(plan, count + k, np.radians(np.array(proposed.joints_deg)))
            waits[count + k] = proposed.wait_s
            found = _diagnosed(_measured(scene, hidden, seed, plan, rail[keep], waits), count + k + 1)
            proposed = _deciding(found, law)
        row[f"after_{k + 1}"] = _told(found, law)
    return row


def _deciding(found: Diagnosis, law: str) -> Proposal | None:
    """Return the pose that is proposed to decide between the true law and others; any, where nothing has a name."""
    poses = [proposal for proposal in found.next if proposal.joints_deg is not None]
    asked = found.verdict != "missing_effect" and poses and (law in poses[0].separates or not poses[0].separates)
    return poses[0] if asked else None


def _measured(scene: str, hidden: dict[str, float], seed: int, plan: Plan, rail: Array, waits: Array) -> Measured:
    return simulate(small_scene(scene), hidden, seed, planned=(plan, rail), waits=waits)


def _at(plan: Plan, view: int, joints: Array) -> Plan:
    """Return the plan with one view at other joint angles (n,), at rest."""
    every, velocity = plan.joints.copy(), plan.velocity.copy()
    every[view], velocity[view] = joints, 0.0
    return replace(plan, joints=every, velocity=velocity, torque=kinematics.gravity_torques(plan.arm, every))


def _diagnosed(measured: Measured, views: int) -> Diagnosis:
    session = session_of(measured)
    return diagnose(run(replace(session, views=session.views[:views])))


def _told(found: Diagnosis, law: str) -> str:
    if found.verdict == "missing_effect":
        return "right" if found.effects == (law,) else f"wrong: {found.effects[0]}"
    told = "cannot tell" if law in found.effects else "not among"
    return f"{told}: {' / '.join(found.effects)}" if found.verdict == "cannot_tell" else found.verdict


def summary(rows: list[Row]) -> list[str]:
    """Return what was decided, by law, and by what the first views left open."""
    asked = [row for row in rows if "after_1" in row]
    kinds = {"which of several": "cannot_tell", "a law, or none": "unknown_effect"}
    groups = grouped(asked, "law") | {words: [r for r in asked if r["verdict"] == kinds[words]] for words in kinds}
    lines = markdown(
        "law | ambiguous cells | stated, one view | right | wrong | right after three | wrong",
        [
            (
                law,
                len(some),
                _stated(some),
                share(r["after_1"] == "right" for r in some),
                sum(r["after_1"].startswith("wrong") for r in some),
                share(r["after_3"] == "right" for r in some),
                sum(r["after_3"].startswith("wrong") for r in some),
            )
            for law, some in (groups | {"all": asked}).items()
        ],
    )
    stated = [row for row in asked if row["probability"] is not None]
    lost = sum(row[f"after_{MOST_VIEWS}"].startswith("not among") for row in asked)
    told = f"{len(rows)} cells, {len(asked)} ambiguous; in {len(asked) - len(stated)} of them the view had no odds. "
    told += f"After three views {lost} ended in a group without the true law."
    return [told, "", *lines, "", *_odds(stated)]


def _stated(rows: list[Row]) -> str:
    """Return the mean of what was stated."""
    stated = [row["probability"] for row in rows if row["probability"] is not None]
    return f"{np.mean(stated):.2f}" if stated else "–"


def _odds(rows: list[Row]) -> list[str]:
    """Return how often one view decided, by what was stated."""
    bands = {"0 … 0.5": (0.0, 0.5), "0.5 … 0.8": (0.5, 0.8), "0.8 … 1": (0.8, 1.01)}
    within = {words: [r for r in rows if low <= r["probability"] < high] for words, (low, high) in bands.items()}
    told = [(words, _stated(some), share(r["after_1"] == "right" for r in some)) for words, some in within.items()]
    return markdown("stated | mean | decided", told)


DECIDING = Table(jobs, trial, summary, range(100), page="diagnosis", block="deciding-view", settings={"cells": 4})


def driven_jobs(seeds: range) -> Iterator[Row]:
    """Yield every trial."""
    for seed in seeds:
        yield {"seed": seed, "faults": list(_FAULTS[seed % len(_FAULTS)])}


def driven_trial(job: Row) -> Row:
    """Return how many views were driven to, how many calls that took, and how many the best of random sets needs."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "cell"
        start = np.radians(new_cell(folder, job["seed"]))
        program = f"{sys.executable} -m data_synth.cells.driven_cell {job['seed']} {' '.join(job['faults'])}"
        cell, told, ended, lost = DrivenCell(folder, size=_SIZE, start=start, most=_MOST), [], 0, False
        while ended <= len(job["faults"]):
            try:
                drive(cell, _UNTIL, program, 20.0, lambda views, U, _: told.append((views, U)))
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


def driven_summary(rows: list[Row]) -> list[str]:
    reached = [row for row in rows if row["U"] is not None and row["U"] <= _UNTIL]
    within = share(row["views"] <= 2 * row["least"] for row in reached)
    lost = share(bool(row["lost"]) for row in rows)
    few = f"{np.median([row['views'] for row in reached]):.0f}, {np.median([row['least'] for row in reached]):.0f}"
    ended = str(sum(row["ended"] for row in rows))
    head = "cells | U reached | views, best random set (median) | within twice that | calls cut short | views lost"
    return markdown(head, [(str(len(rows)), share(row in reached for row in rows), few, within, ended, lost)])


DRIVEN = Table(driven_jobs, driven_trial, driven_summary, range(500, 520), page="plan", block="driven")
