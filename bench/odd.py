"""Large and odd sessions against the truth, and commands that are killed in the middle of each write.

Blades in cells of known truth: many views; views that stand in clusters; thousands of poses with labelled points; rows
of two sessions in one, whose parts stood at different places; poses that are read ever later, as by a clock that runs
fast. What is said of each, how far its hand-eye is off, and by how much of its U. Kills: a moment after each time that
a command opens, makes, renames or removes something in its folder. Used up: 9100 to 9106.
"""

import resource
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np

from bench.fault_room import killed_at
from bench.harness import Parts, Row, Table, grouped, markdown
from data_synth import kinematics
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.quiet_scenes import clean, plan_for
from data_synth.simulate import Measured, simulate
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import diagnose_state
from stitch.errors import StitchError
from stitch.model.model import displacement
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.session import SessionData

KINDS = ("clusters", "clock runs fast", "two sessions mixed", "2,000 labelled poses", "200 views")
_CLUSTERS, _IN_CLUSTER, _NEAR = 4, 8, 0.02  # rad within a cluster
_LATE = 0.02  # of the way to the next view, at the last one
_AFTER = 0.001  # s, from an event to the kill


def jobs(seeds: range, kills: int) -> Iterator[Row]:
    """Every kind once a seed of two in turn, then kills at events from the first on."""
    yield from ({"part": "odd", "seed": seed, "kind": kind} for kind in KINDS for seed in seeds)
    yield from ({"part": "killed", "command": c, "event": k} for k in range(1, kills + 1) for c in ("run", "add"))


def _clusters(seed: int) -> tuple[SessionData, Array, Array]:
    """Views that stand at four places, eight at each."""
    scene = clean("blade", rays=60)
    plan, rail = plan_for(scene, seed, _CLUSTERS)
    again = np.repeat(np.arange(_CLUSTERS), _IN_CLUSTER)
    plan = replace(plan, **{f.name: np.asarray(getattr(plan, f.name))[again] for f in fields(plan) if f.name != "arm"})
    near = np.random.default_rng([seed, 9]).uniform(-_NEAR, _NEAR, plan.joints.shape)
    scene = replace(scene, repeatability=(20e-6, 0.02))
    return _with_truth(simulate(scene, {}, seed, planned=(replace(plan, joints=plan.joints + near), rail[again])))


def _late(seed: int) -> tuple[SessionData, Array, Array]:
    """Poses that are read on the way to the next view, the later the farther."""
    measured = measured_blade(seed, views=16, pixels=60)
    joints = measured.plan.joints
    late = _LATE * np.linspace(0, 1, len(joints))[:, None]
    on_the_way = joints + late * (np.roll(joints, -1, axis=0) - joints)
    true, read = (kinematics.flange(measured.scene.arm, q) for q in (joints, on_the_way))
    return _with_truth(replace(measured, T_base_flange=measured.T_base_flange @ frames.inverse(true) @ read))


def _mixed(seed: int) -> tuple[SessionData, Array, Array]:
    """Rows of two sessions in turn; between them somebody moved the part."""
    one, two = (measured_blade(seed, views=12, pixels=60, plan_seed=plan) for plan in (seed, seed + 500))
    moved = frames.exp(np.random.default_rng([seed, 8]).normal(size=6) * np.repeat([0.1, 40.0], 3))
    scanner_rides = one.scene.mount == "eye_in_hand"
    T = two.T_base_flange @ (np.eye(4) if scanner_rides else moved)
    sessions = session_of(one), session_of(replace(two, T_base_flange=T))
    pairs = zip(sessions[0].views, sessions[1].views, strict=True)
    views = [replace(view, name=f"m{k}", time_s=None) for k, view in enumerate(v for pair in pairs for v in pair)]
    return replace(sessions[0], views=tuple(views)), one.T_mount, _middle(one)


def _labelled(seed: int) -> tuple[SessionData, Array, Array]:
    session, T_mount, _ = labelled_cell(seed, views=2000)
    return session, T_mount, np.zeros(3)


def _with_truth(measured: Measured) -> tuple[SessionData, Array, Array]:
    return session_of(measured), measured.T_mount, _middle(measured)


def _middle(measured: Measured) -> Array:
    """(3,) of what the scanner sees, in its frame."""
    return np.array([0.0, 0.0, measured.scene.scanner.standoff])


_MAKE: dict[str, Any] = {
    "clusters": _clusters,
    "clock runs fast": _late,
    "two sessions mixed": _mixed,
    "2,000 labelled poses": _labelled,
    "200 views": lambda seed: _with_truth(measured_blade(seed, views=200, pixels=40)),
}


def odd_trial(job: Row) -> Row:
    """What is said, and how far the hand-eye is off at the part."""
    session, T_mount, middle = _MAKE[job["kind"]](job["seed"])
    row: Row = {"views": len(session.views), "said": "", "verdict": "", "off": None, "U": None}
    try:
        state = run(session)
        row["verdict"] = diagnose_state(state).verdict
    except StitchError as error:
        return row | {"verdict": "refused", "said": str(error)[:300]}
    xi = frames.log(frames.inverse(state.T_mount) @ T_mount)
    row["said"] = " ".join(state.doubts)[:300]
    row["left_out"] = len(state.left_out)
    row["off"] = float(np.linalg.norm(xi[3:] + np.cross(xi[:3], middle)))
    row["U"] = displacement(state.mount_covariance, middle)
    row["gigabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return row


def odd_summary(rows: list[Row]) -> list[str]:
    """A line a session."""
    lines = []
    for row in rows:
        off, U = ("–", "–") if row["off"] is None else (f"{row['off']:.3f}", f"{row['U']:.3f}")
        said = row["said"].split("; to fix")[0].split(": ", 1)[-1][:110].replace("|", "/") or "–"
        lines.append([row["kind"], row["views"], row["verdict"], row.get("left_out", "–"), off, U, said])
    head = "session | views | verdict | left out | hand-eye off, mm | U, mm | first words of a refusal or doubt"
    return markdown(head, lines)


def killed_trial(job: Row) -> Row:
    """Kill a command a moment after one of its changes of the folder."""
    return killed_at(job["command"], job["event"], _AFTER)


def killed_summary(rows: list[Row]) -> list[str]:
    """A sentence a command."""
    sentences = []
    for command, group in grouped([row for row in rows if row["killed"]], "command").items():
        left = Counter(row["left"] for row in group)
        failed = sum(not row["works"] for row in group)
        last = max(row["event"] for row in group)
        sentences.append(
            f"`{command}` killed {len(group)} times, 1 ms after one of the changes 1 to {last} "
            f"of its folder: {left['old']} times the old run is left, {left['new']} times the new one, "
            f"{left['neither']} times neither; {failed} times the next command fails."
        )
    return sentences


_PARTS = Parts({"odd": (odd_trial, odd_summary), "killed": (killed_trial, killed_summary)})
TABLE = Table(jobs, _PARTS.trial, _PARTS.summary, range(9100, 9102), "limits", "odd", settings={"kills": 25})
