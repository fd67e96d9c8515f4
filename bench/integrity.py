"""What `stitch check --deep` and data snooping find in sessions with one mistake, and in sessions without any.

Usage: python bench/integrity.py good|sizes|kinds|real FILE [--seeds 0 5] [--minutes 30] [--every 6]

`real` puts mistakes into measured scans (folder in STITCH_SHARED_DATA), and runs them too.

Rows are appended to FILE (a JSON line each) as they come; what stands there already is not computed again.
Seeds 0 to 99 were used while the code was written, 1000 and above are run once.
"""

import argparse
import json
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from integrity_faults import Fault, displaced, faults, in_base_frame

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated, with_part
from data_synth.scene import load_scene
from data_synth.simulate import Measured
from stitch.errors import StitchError
from stitch.integrity.arm_limits import judged_by_size
from stitch.integrity.deep_check import deep_check
from stitch.integrity.reliability import blunder_sizes, normal_blocks
from stitch.integrity.snooping import Snooping, snoop
from stitch.integrity.usual_effects import usual_twists
from stitch.measurement.capture import Capture, capture
from stitch.measurement.measurement import measurement_of
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import free_poses
from stitch.pipeline import run
from stitch.reading.session_folder import load_session
from stitch.stages.correct import close_in
from stitch.system.threads import library_threads_off

PARTS: dict[str, dict[str, Any]] = {
    "blade": {},
    "curved_drill_plate": {"length": 150.0, "width": 120.0, "pitch": 36.0, "radius": 150.0},
    "sphere_plate": {},
}
MOUNTS = {"eye_to_hand": "blade", "eye_in_hand": "blade-table"}
REAL = (
    "two exchanged",
    "shifted by 1",
    "reversed",
    "inverse",
    "mount",
    "euler ZYX as xyz",
    "euler XYZ as ZYX",
    "euler xyz as XYZ",
    "poses in inches",
    "poses in m",
    "clouds scaled 1.0254",
    "clouds mirrored",
)
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
_START_GATE = 6.0  # mm: the hand-eye starts near its end


def measured(part: str, mount: str, seed: int, hidden: dict[str, float] | None = None) -> Measured:
    """One cell."""
    scene = load_scene(MOUNTS[mount])
    scene = replace(scene, scanner=replace(scene.scanner, columns=RAYS, rows=RAYS))
    if part != "blade":
        scene = with_part(scene, part, **PARTS[part])
    return simulated(scene, hidden or {}, seed, VIEWS)


def snooped(session: Session, T_mount: np.ndarray) -> tuple[Capture, np.ndarray, Snooping]:
    """What a run would see: hand-eye corrected, views freed, tests."""
    own = capture(session)
    T_mount, overlaps, _ = close_in([own], T_mount, [_START_GATE])
    freed = free_poses(own, own.poses(T_mount), overlaps[0].gate)
    usual = partial(usual_twists, measurement_of(session, own), Model(T_mount))
    return own, T_mount, judged_by_size(session, snoop(own, T_mount, overlaps[0].gate, freed, usual))


def good(part: str, mount: str, seed: int) -> Iterator[dict[str, Any]]:
    """A session without a mistake: what is left out wrongly."""
    hidden = _HIDDEN[seed % len(_HIDDEN)]
    m = measured(part, mount, seed, hidden)
    start = time.perf_counter()
    _, _, found = snooped(session_of(m), m.T_mount)
    block = None if found.block is None else found.block.start
    yield {
        "case": f"good {'+'.join(hidden)}", "left_out": list(found.left_out), "block": block,
        "suspected": [m.view for m in found.suspected],
        "groups": len(found.disconnected), "seconds": time.perf_counter() - start,
    }  # fmt: skip


def sizes(part: str, mount: str, seed: int) -> Iterator[dict[str, Any]]:
    """One view off by a multiple of its minimal detectable and identifiable blunder, in a random direction."""
    m = measured(part, mount, seed)
    session, rng = session_of(m), np.random.default_rng([seed, 7])
    _, T_mount, clean = snooped(session, m.T_mount)
    normal = normal_blocks(clean.model, clean.found)
    v = int(rng.integers(VIEWS))
    flange = rng.standard_normal(6) * [1, 1, 1, clean.model.lever, clean.model.lever, clean.model.lever]
    # A right twist of the flange, as a left twist of the view about the centre: A·exp(ξ) or, inverted, exp(−ξ)·A⁻¹.
    sign = -1.0 if mount == "eye_to_hand" else 1.0
    detectable, identifiable = blunder_sizes(normal, v, (sign * clean.model.carried[v] @ flange)[None])
    for times, unit, size in [(k, "detectable", detectable[0]) for k in (1, 2, 10)] + [
        (2, "identifiable", identifiable[0])
    ]:
        if not np.isfinite(size):
            yield {"case": f"{times} x {unit}", "skipped": "the others do not hold this direction"}
            continue
        _, _, found = snooped(displaced({v: times * size * flange})(session), T_mount)
        named = (*found.left_out, *(m.view for m in found.suspected))
        yield {"case": f"{times} x {unit}", "detected": bool(named), "named": named == (v,),
               "left_out": found.left_out == (v,),
               "size_mm": float(times * size * np.linalg.norm(flange[3:]))}  # fmt: skip


def kinds(part: str, mount: str, seed: int, done: set[str], share: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """The mistakes of the table in one session; with share (k, n) every n-th of them, from k on."""
    m = measured(part, mount, seed)
    session = session_of(m)
    own = capture(session)
    table = {"nothing": Fault(lambda s: s, ())}
    table |= faults(VIEWS, np.random.default_rng([seed, 8])) | {
        "clouds in base frame": in_base_frame(own.poses(m.T_mount))
    }
    for number, (case, fault) in enumerate(table.items()):
        if case not in done and (number + share[0]) % share[1] == 0:
            yield {"case": case} | judged(fault.apply(session), fault)


def real(folder: Path, done: set[tuple[str, str]]) -> Iterator[dict[str, Any]]:
    """Measured scans with mistakes in their conventions: what is said, and whether a run ends as if all were well."""
    for part in sorted(f.name for f in folder.iterdir() if (f / "session.toml").exists()):
        session = load_session(folder / part)
        table = {"nothing": Fault(lambda s: s, ())} | faults(len(session.views), np.random.default_rng(9))
        for case in ("nothing", *REAL):
            if (part, case) in done:
                continue
            wrong = table[case].apply(session)
            try:
                found = run(wrong)
                ended = f"ran, left out {', '.join(item.view for item in found.left_out) or 'none'}"
            except StitchError as error:
                ended = f"refused: {str(error).split(': ', 1)[1]}"
            yield {"part": part, "mount": session.mount, "seed": 0, "case": case, "ended": ended} | judged(
                wrong, table[case]
            )


def judged(session: Session, fault: Fault) -> dict[str, Any]:
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


def append(file: Path, row: dict[str, Any]) -> None:
    """One line more."""
    with file.open("a") as out:
        out.write(json.dumps(row, default=float) + "\n")


def main() -> None:
    """Run one part of the bench."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("good", "sizes", "kinds", "real"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 1))
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument(
        "--every", type=int, default=1, help="of the mistakes, every n-th in a cell, another in the next"
    )
    given = parser.parse_args()
    library_threads_off()
    end = time.monotonic() + 60 * given.minutes
    rows = [json.loads(line) for line in given.file.read_text().splitlines()] if given.file.exists() else []
    done = {(r["part"], r["mount"], r["seed"], r["case"]) for r in rows}
    if given.what == "real":
        folder = Path(os.environ["STITCH_SHARED_DATA"]) / "reghec"
        for row in real(folder, {(part, case) for part, _, _, case in done}):
            append(given.file, row)
        return
    cells = [(p, m, s) for s in range(*given.seeds) for p in PARTS for m in MOUNTS]
    for number, (part, mount, seed) in enumerate(cells):
        cases = {case for p, m, s, case in done if (p, m, s) == (part, mount, seed)}
        if given.what != "kinds" and cases:
            continue
        found = (
            kinds(part, mount, seed, cases, (number, given.every))
            if given.what == "kinds"
            else globals()[given.what](part, mount, seed)
        )
        for row in found:
            append(given.file, {"part": part, "mount": mount, "seed": seed} | row)
            if time.monotonic() > end:
                return


if __name__ == "__main__":
    main()
