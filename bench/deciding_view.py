"""Does the proposed view decide? Cells whose views cannot tell two laws apart, and the view that `stitch next` names.

A session of few views is simulated with one law and diagnosed. Where it ends in "cannot tell" with the true law in the
group, or a joint without a law explains the views as well as that law, the proposed pose is driven in the same cell
(same arm, hand-eye, climate; scans and scatter of their own), after the wait that is asked for, and the session is
diagnosed anew; up to three times, each time at the pose that is proposed then. Counted is what is named after one view
and after three, beside the probability that was stated. Development seeds 0 to 99 and 1500 to 1519; held-out ones, run
once: from 1300 to 1339 and from 1400 to 1439, each law its own; take others.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bench.harness import Row, Table, grouped, markdown, share
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for, small_scene
from data_synth.moment import Plan
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from stitch.api.verbs import diagnose, run
from stitch.diagnosis.deciding_view import MOST_VIEWS
from stitch.diagnosis.diagnosis import Diagnosis, Proposal
from stitch.numerics.frames import Array

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


TABLE = Table(jobs, trial, summary, range(100), page="diagnosis", block="deciding-view", settings={"cells": 4})
