"""Mounts that give way under gravity: named, fitted, and told from laws of a mount that no library holds.

Usage: python bench/mount_droop.py [--first SEED] [--parts droop,unknown]

droop: 20 cells of three scenes with the scanner on the arm, a beam (`data_synth/laws/brackets.py`) at amplitudes 1
and 2, its true effect added, the hand-eye against the truth. unknown: ten other laws of the mount
(`bench/mount_laws.py`) in two scenes each, at amplitude 2; then with the law itself offered beside the library, as a
user would write it.
"""

import argparse
import time
from collections import Counter

import mount_laws
import numpy as np
from blind_cells import scene_of

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated
from data_synth.laws.brackets import end_twist
from data_synth.simulate import Measured
from stitch.api.pipeline import change, diagnose, run
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.thresholds import ODDS
from stitch.effects import EFFECTS, effect, twist
from stitch.errors import StitchError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.run_data import RunData
from stitch.session.measurement import Views
from stitch.system.threads import library_threads_off

SCENES = ("blade-table", "drill-plate", "spheres")
CELLS, AMPLITUDES = 20, (1.0, 2.0)
TRUE = "true_law"
# Looking down: there the effect counts as zero.
_DOWN = np.array([0.0, 0.0, 1.0])


def _told(found: Diagnosis) -> str:
    return f"{found.verdict} {' '.join(found.effects)}{'' if found.log_odds_over_nothing > ODDS else ' (perhaps)'}"


def droop(first: int) -> None:
    """Print every cell with a drooping mount, and how often it was named and the hand-eye right."""
    count: Counter[str] = Counter()
    for k in range(CELLS):
        scene, amplitude = SCENES[k % len(SCENES)], AMPLITUDES[k // len(SCENES) % 2]
        measured = simulated(scene_of(scene), {"mount_droop": amplitude}, first + k)
        state = run(session_of(measured))
        found = diagnose(state)
        kind = "group" if "mount_droop" in found.effects else "wrong" if found.effects else found.verdict
        kind = "named" if found.effects == ("mount_droop",) else kind
        off = _hand_eye_sigmas(measured, change(state, ["mount_droop"]))
        count.update([kind, f"{kind} at {amplitude:g}", *(["within 3 sigma"] if off.max() <= 3 else [])])
        print(f"{scene} {first + k} × {amplitude:g}: {_told(found)}; hand-eye {off.max():.1f} sigma", flush=True)
    print(dict(count))


def _hand_eye_sigmas(measured: Measured, found: RunData) -> Array:
    """(6,) error of the hand-eye of a flange that looks down, in its sigmas."""
    true = frames.exp(end_twist(measured.hidden["mount_droop"], _DOWN)) @ measured.T_mount
    error = frames.log(frames.inverse(found.T_mount) @ true)
    return np.asarray(np.abs(error) / np.sqrt(np.diag(found.mount_covariance)))


def unknown(first: int) -> None:
    """Print every cell with a law that no library holds, without and with the law itself among the candidates."""
    mount_laws.register()
    count: Counter[str] = Counter()
    for k, law in enumerate([*mount_laws.COURSES] * 2):
        scene = SCENES[(k + k // len(mount_laws.COURSES)) % len(SCENES)]
        measured = simulated(scene_of(scene), {law: 2.0}, first + k)
        state = run(session_of(measured))
        found = diagnose(state)
        certain = found.verdict == "missing_effect" and found.log_odds_over_nothing > ODDS
        places = {EFFECTS[name].place for name in found.effects if name in EFFECTS}
        kind = found.verdict if not found.effects else "at the mount" if places == {"mount"} else "a wrong name"
        count.update([kind, *(["a wrong name, certain"] if kind == "a wrong name" and certain else [])])
        offered = _with_the_law(state, mount_laws.course_of(measured.hidden[law]))
        left = {c.name: c.cross_validation.heldout for c in offered.candidates if c.cross_validation}
        best = min(left, key=lambda name: left[name])
        kind = "true law" if offered.effects == (TRUE,) else "true law in a group" if TRUE in offered.effects else "not"
        worse = offered.effects and all(left[name] > left[best] for name in offered.effects if name in left)
        count.update([f"offered: {kind}", *(["offered: a worse one named"] if worse else [])])
        share = ", ".join(f"{name} {left[name]:.2f}" for name in sorted(left, key=lambda name: left[name])[:3])
        print(f"{scene} {first + k} {law}: {_told(found)}; offered {_told(offered)}; left {share}", flush=True)
    print(dict(count))


def _with_the_law(state: RunData, course: Array) -> Diagnosis:
    """The diagnosis with the law as a user's effect beside the library."""

    def true_law(views: Views, xi: Array) -> Array:
        """M·exp(ξ·c), c the course"""
        # Views that are yet to be taken go on as the last one.
        return views.at_scanner(np.outer(course[np.minimum(views.number, len(course) - 1)], xi))

    effect("mount", tier="user", xi=twist("", 3e-4, 0.1))(true_law)
    try:
        return diagnose(state)
    finally:
        del EFFECTS[TRUE]


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="seed of the first cell; later ones count on")
    parser.add_argument("--parts", default="droop,unknown")
    options = parser.parse_args()
    with library_threads_off():
        for part in options.parts.split(","):
            try:
                {"droop": droop, "unknown": unknown}[part](options.first)
            except StitchError as error:
                raise SystemExit(f"{part}: {error}") from error
    print(f"{time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
