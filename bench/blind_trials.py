"""Trials of the blind benchmark: one simulated session each, a flat row of what came of it."""

import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from zlib import crc32

from blind_cells import (
    OUTSIDE,
    drawn,
    hand_eye_chi_square,
    hand_eye_error,
    hand_eye_sigma,
    in_session_units,
    measure,
    smallest,
    user_effect,
)

from data_synth.fixtures.in_memory import session_of
from data_synth.moment import Plan
from data_synth.nature import LAWS
from data_synth.simulate import Measured
from stitch.api.pipeline import change, diagnose, run
from stitch.api.stepwise import suggest
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.validation import CrossValidation
from stitch.effects import EFFECTS
from stitch.errors import StitchError
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.system.threads import library_threads_off

Row = dict[str, Any]
CLIMATE = ("part_growth", "robot_thermal_growth", "scanner_thermal_scale")
# The beams of brackets are written in other numbers than the library's droop (`bench/mount_droop.py` asks for them).
LIBRARY = tuple(name for name in LAWS if name in EFFECTS and not name.endswith("_droop"))


def pin(core: int) -> None:
    """One core a worker: a trial is too small to share out."""
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[core % len(os.sched_getaffinity(0))]})
    library_threads_off()


def trial(job: Row) -> Row:
    """Run one job {"part", "scene", "seed", …}; its row holds the job too."""
    start = time.perf_counter()
    try:
        row = _PARTS[job["part"]](job)
    except StitchError as error:
        row = {"verdict": f"no result: {error}", "named": [], "follows": []}
    return {**job, **row, "seconds": round(time.perf_counter() - start, 2)}


@dataclass(frozen=True)
class EmptyCell:
    """A cell with nothing hidden: what can be seen in it."""

    plan: Plan
    linear: LinearModel


@lru_cache(maxsize=8)
def cell_without(scene: str, seed: int, chance: int | None = None) -> EmptyCell:
    """The cell of a scene and a seed, with nothing hidden; `chance` as in `measure`."""
    measured = measure(scene, seed, {}, chance=chance)
    calm = run(session_of(measured))
    return EmptyCell(measured.plan, linear_model_of(calm))


def _chance(job: Row) -> int:
    """A seed of the job's own: trials in one cell must not share their noise."""
    return 10_000 + crc32(json.dumps(job, sort_keys=True).encode()) % 1_000_000


def _sizes(job: Row, laws: list[str]) -> dict[str, float] | None:
    """Amplitudes of the laws at the job's multiple of their smallest detectable size."""
    # What follows a covariate shows as well as that one's course of the day, which is drawn too.
    own = any(law in OUTSIDE or law in CLIMATE for law in laws)
    cell = cell_without(job["scene"], job["seed"], _chance(job) if own else None)
    true = drawn(job["scene"], cell.plan, cell.linear.measurement, laws, _chance(job))
    out = {}
    for law in laws:
        effect = user_effect(law) if law in OUTSIDE else law
        found = smallest(cell.linear, effect, true[law])
        if law in OUTSIDE:
            del EFFECTS[effect]
        if found is None:
            return None
        out[law] = found * job["multiple"]
    return out


def _diagnosed(job: Row, hidden: dict[str, float], how: str = "") -> tuple[Measured, RunData, Diagnosis, Row]:
    measured = measure(job["scene"], job["seed"], hidden, how, tuple(job.get("useful", ())), _chance(job))
    first = run(session_of(measured))
    found = diagnose(first)
    ranked = [s.name for s in found.candidates if s.ranked.score.observable]
    row = {
        "hidden": {name: measured.hidden[name] for name in hidden}, "verdict": found.verdict,
        "named": list(found.effects), "first": ranked[0] if ranked else None,
        "p": min((s.ranked.adjusted for s in found.candidates if s.name in found.effects), default=1.0),
        "follows": [d.covariate for d in found.depends_on[:3] if d.p_value < 0.05], "notes": list(found.notes),
        "scatter": [found.rotation * 1e6, found.translation * 1e3],
        "top": [(s.name, round(s.ranked.score.log_bayes_factor, 2), s.ranked.adjusted) for s in found.candidates[:3]],
        "left": [_left(s.cross_validation) for s in found.candidates[:3]],
        "hand_eye_chi_square": hand_eye_chi_square(measured, first),
    }  # fmt: skip
    return measured, first, found, row


def _left(left: CrossValidation | None) -> list[float]:
    """Share of the mean square pose error of left-out views, its sigma, steadiness."""
    return [] if left is None else [round(x, 3) for x in (left.poses, left.poses_sigma, left.steadiness)]


def _effect(job: Row) -> Row:
    """One effect of the library; where it is named alone and clear, it is added too."""
    hidden = _sizes(job, [job["effect"]])
    if hidden is None:
        return {"verdict": "not shown"}
    measured, first, found, row = _diagnosed(job, hidden)
    if job["multiple"] >= 2 and job["effect"] in found.effects:
        row["added"] = _added(measured, first, change(first, [job["effect"]]), job)
        if job["multiple"] == 4:
            knowing = run(session_of(measured), effects=[job["effect"]])
            row["added"]["knowing"] = knowing.heldout_rms
    return row


def _added(measured: Measured, first: RunData, added: RunData, job: Row) -> Row:
    """What the change brought: held-out residual, hand-eye against the truth, amplitudes in sigmas."""
    true = in_session_units(measured)[job["effect"]]
    fitted = {p.name: p for p in added.terms[0].parameters if not p.grid and p.name in true}
    return {
        "heldout": [first.heldout_rms, added.heldout_rms],
        "hand_eye": [hand_eye_error(measured, first.T_mount), hand_eye_error(measured, added.T_mount)],
        "hand_eye_sigma": hand_eye_sigma(measured, added.mount_covariance),
        "hand_eye_chi_square": hand_eye_chi_square(measured, added),
        "z": {n: (p.value - true[n]) / p.sigma for n, p in fitted.items() if p.fitted},
        "unseen": [n for n, p in fitted.items() if not p.fitted],
    }


def _empty(job: Row) -> Row:
    """Nothing hidden."""
    return _diagnosed(job, {}, job["noise"])[3]


def _alias(job: Row) -> Row:
    """What these views cannot tell from the hand-eye, at a size of nature's own."""
    _, _, found, row = _diagnosed(job, {job["effect"]: job["amplitude"]}, job["how"])
    suspect = next((s for s in found.candidates if s.name == job["effect"]), None)
    return {**row, "observable": bool(suspect and suspect.ranked.score.observable)}


def _outside(job: Row) -> Row:
    """A law without a name in the library; then its user writes it down."""
    hidden = _sizes(job, [job["effect"]])
    if hidden is None:
        return {"verdict": "not shown"}
    _, first, found, row = _diagnosed(job, hidden)
    if found.verdict == "unknown_effect":
        name = user_effect(job["effect"])
        try:
            again = diagnose(first)
            added = change(first, [name])
        finally:
            del EFFECTS[name]
        floor = run(session_of(measure(job["scene"], job["seed"], {}, chance=_chance(job))))
        row["user"] = {
            "named": list(again.effects), "heldout": [first.heldout_rms, added.heldout_rms, floor.heldout_rms],
            "residual": [first.residual_rms, added.residual_rms, floor.residual_rms],
        }  # fmt: skip
    return row


def _pair(job: Row) -> Row:
    """Two effects at once."""
    hidden = _sizes(job, job["effects"])
    if hidden is None:
        return {"verdict": "not shown"}
    measured = measure(job["scene"], job["seed"], hidden, chance=_chance(job))
    state: RunData = run(session_of(measured))
    result, lines, last = suggest(state, 4)
    return {
        "hidden": dict(measured.hidden), "verdict": last.verdict, "named": list(last.effects),
        "found": [] if result is None else list(result.effects), "lines": lines,
    }  # fmt: skip


_PARTS: dict[str, Callable[[Row], Row]] = {
    "effects": _effect, "empty": _empty, "aliases": _alias, "outside": _outside, "pairs": _pair,
}  # fmt: skip
