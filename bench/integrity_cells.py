"""Cells in memory with and without one mistake, and what linkage, data snooping and the deep check say of them."""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from integrity_faults import Fault, faults, in_base_frame

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated, with_part
from data_synth.scene import load_scene
from data_synth.simulate import Measured
from stitch.api.pipeline import run
from stitch.errors import StitchError
from stitch.fit.correct import icp_hand_eye
from stitch.model.model import Model
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.screening.deep_check import apply_displacement_limits, deep_check
from stitch.screening.snooping import Snooping, snoop_views
from stitch.screening.view_model import UsualEffects
from stitch.session.capture import Capture, prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.session import SessionData

PARTS: dict[str, dict[str, Any]] = {
    "blade": {},
    "curved_drill_plate": {"length": 150.0, "width": 120.0, "pitch": 36.0, "radius": 150.0},
    "sphere_plate": {},
}
MOUNTS = {"eye_to_hand": "blade", "eye_in_hand": "blade-table"}
VIEWS, RAYS = 14, 120
# Effects that a model may lack while a session is good: they must not cost it a view.
_HIDDEN: tuple[dict[str, float], ...] = (
    {},
    {},
    {"joint_compliance": 2.0},
    {"scanner_thermal_scale": 0.5},
    {"joint_offset": 2.0},
    {"backlash": 3.0},
    {"link_geometry": 2.0, "gear_eccentricity": 2.0},
)
_JOINT_SCATTER = 30e-6  # rad
_START_GATE = 6.0  # mm: the hand-eye starts near its end


def measured(
    part: str, mount: str, seed: int, hidden: dict[str, float] | None = None, joint_scatter: float = 0.0
) -> Measured:
    """One cell; its joints scatter by so many rad from view to view."""
    scene = load_scene(MOUNTS[mount])
    scene = replace(scene, scanner=replace(scene.scanner, columns=RAYS, rows=RAYS), joint_repeatability=joint_scatter)
    if part != "blade":
        scene = with_part(scene, part, **PARTS[part])
    return simulated(scene, hidden or {}, seed, VIEWS)


def snooped(session: SessionData, T_mount: np.ndarray) -> tuple[Capture, np.ndarray, Snooping]:
    """What a run would see: hand-eye corrected, views freed, tests."""
    own = prepare_capture(session)
    T_mount, overlaps, _ = icp_hand_eye([own], T_mount, [_START_GATE])
    freed = unconstrained_poses(own, own.poses(T_mount), overlaps[0].gate)
    usual = UsualEffects(measurement_of(session, own), Model(T_mount))
    return own, T_mount, apply_displacement_limits(session, snoop_views(own, T_mount, overlaps[0].gate, freed, usual))


def scattering(part: str, mount: str, seed: int) -> Iterator[dict[str, Any]]:
    """A session without a mistake whose joints scatter."""
    yield from _unfaulted(measured(part, mount, seed, joint_scatter=_JOINT_SCATTER), "joints scatter")


def good(part: str, mount: str, seed: int) -> Iterator[dict[str, Any]]:
    """A session without a mistake."""
    hidden = _HIDDEN[seed % len(_HIDDEN)]
    yield from _unfaulted(measured(part, mount, seed, hidden), "+".join(hidden))


def _unfaulted(m: Measured, kind: str) -> Iterator[dict[str, Any]]:
    """What is left out wrongly."""
    start = time.perf_counter()
    session = session_of(m)
    _, _, found = snooped(session, m.T_mount)
    steps = [step.start for step in found.steps]
    # A step that an effect may be is left to the diagnosis: what a run leaves out is what costs anybody anything.
    out = [item.view for item in run(session).left_out] if found.left_out else []
    yield {
        "case": f"good {kind}", "tested_out": list(found.left_out), "left_out": out, "steps": steps,
        "suspected": [m.view for m in found.suspected],
        "groups": len(found.disconnected), "seconds": time.perf_counter() - start,
    }  # fmt: skip


def kinds(part: str, mount: str, seed: int, done: set[str], share: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """The mistakes of the table in one session; with share (k, n) every n-th of them, from k on."""
    m = measured(part, mount, seed)
    session = session_of(m)
    own = prepare_capture(session)
    table = {"nothing": Fault(lambda s: s, ())}
    table |= faults(VIEWS, np.random.default_rng([seed, 8])) | {
        "clouds in base frame": in_base_frame(own.poses(m.T_mount))
    }
    for number, (case, fault) in enumerate(table.items()):
        if case not in done and (number + share[0]) % share[1] == 0:
            yield {"case": case} | judged(fault.apply(session), fault)


def judged(session: SessionData, fault: Fault) -> dict[str, Any]:
    """What the deep check says of a session with a mistake."""
    start = time.perf_counter()
    try:
        found = [(p.kind, list(p.views), p.fix) for p in deep_check(session)]
    except StitchError as error:
        found = [("refused", [], str(error))]
    culprits = {session.views[v].name for v in fault.views}
    named = any(kind in fault.kinds and (not culprits or culprits & set(views)) for kind, views, _ in found)
    touched = set().union(*(set(views) for _, views, _ in found)) if found else set()
    return {
        "said": found, "silent": not found, "named": named, "culprit": culprits <= touched,
        "seconds": time.perf_counter() - start,
    }  # fmt: skip
