"""Sessions of labelled points of ten kinds through `add --suggested`: is a name wrong, idle or named again?

Run: python bench/points_cells.py [--seeds 700 706] [--kinds …]. An ABB IRB 120 of the generator before a tracker: a
ball, three reflectors, a 6D probe; the sensor's kind stated and not; points in the robot's base; sweeps of single
joints; an arm driven by cables; a part that slips; joints that count otherwise in either direction. Wrong: the first
single name is none of the errors that are there. Zero: an effect of the final model that is not there, and no parameter
of which is three sigmas off zero. Weak: one that is there, and whose parameters are only known together. Again: the
closing diagnosis names what was dropped on the way.
"""

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from arm_ranges import SimulatedArm
from blind_trials import pin
from scipy.spatial.transform import Rotation

from data_synth.kinematics import flange, gravity_torques
from stitch.api.pipeline import diagnose, run
from stitch.api.stepwise import suggest
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.robot import forward
from stitch.session.session import SessionData, Sighting, View

_VIEWS, _OFFSET, _SIGMAS = 48, 6e-4, 3.0
_PROBE_TURN = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()


@dataclass(frozen=True)
class Kind:
    """What is measured, and which names are right."""

    right: frozenset[str]
    targets: int = 3
    probe: bool = False
    stated: bool = True  # the sensor's kind
    at_base: bool = False
    sweeps: bool = False
    soft: float = 0.0  # rad/(N m) of every joint
    play: float = 0.0  # rad, by the direction from which joints come
    slip: float = 0.0  # mm, from the middle of the session on


_OFFSETS, _NOTHING = frozenset({"joint_offset"}), frozenset[str]()
KINDS = {
    "ball": Kind(_OFFSETS, targets=1, stated=False),
    "ball, kind stated": Kind(_OFFSETS, targets=1),
    "three reflectors": Kind(_OFFSETS, stated=False),
    "three reflectors, nothing hidden": Kind(_NOTHING, stated=False),
    "6D probe": Kind(_OFFSETS, probe=True, stated=False),
    "points in the base": Kind(_OFFSETS, stated=False, at_base=True),
    "sweeps of single joints": Kind(_OFFSETS, stated=False, sweeps=True),
    "cable arm": Kind(_OFFSETS | {"joint_compliance", "backlash"}, soft=3e-5, play=1e-3),
    "slip by time": Kind(_OFFSETS | {"part_slip"}, slip=0.4),
    "by direction": Kind(_OFFSETS | {"backlash"}, play=6e-4),
}


def session_of_kind(kind: Kind, seed: int) -> SessionData:
    """One session of its own arm."""
    made = SimulatedArm(4 * seed + 1)
    rng, arm = np.random.default_rng([seed, 9]), made.arm
    q = made.joints(_VIEWS, "whole")
    if kind.sweeps:
        q = np.tile(made.joints(1, "whole"), (_VIEWS, 1))
        for joint, rows in enumerate(np.array_split(np.arange(_VIEWS), 6)):
            q[rows, joint] = np.linspace(made.low[joint], made.high[joint], len(rows))
    moved = np.vstack([np.zeros(6), np.sign(np.diff(q, axis=0))])
    wrong = _OFFSET * rng.standard_normal(6) * bool(kind.right)
    true = q + wrong + kind.soft * gravity_torques(arm, q) - kind.play * moved
    T = flange(arm, true) @ frames.exp(np.repeat([2e-5, 0.02], 3) * rng.normal(size=(_VIEWS, 6)))
    X = frames.make(Rotation.random(rng=rng).as_matrix(), 1500 * rng.normal(size=3))
    X = np.eye(4) if kind.at_base else X
    places = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0]])[: kind.targets]
    views, T_sensor_flange = [], frames.inverse(X) @ T
    for i in range(_VIEWS):
        own = places + kind.slip * (i >= _VIEWS // 2) * np.array([1.0, 0.0, 0.0])
        seen = frames.transform(T_sensor_flange[i], own) + 0.01 * rng.normal(size=own.shape)
        sighting = Sighting(tuple(f"t{k}" for k in range(len(own))), seen, np.full(len(own), 0.01))
        if kind.probe:
            R = T_sensor_flange[i, :3, :3] @ _PROBE_TURN @ Rotation.from_rotvec(3e-5 * rng.normal(size=3)).as_matrix()
            sighting = Sighting(("probe",), seen[:1], np.full(1, 0.01), R, 3e-5)
        views.append(_view(i, q[i], moved[i], forward(made.nominal, q[i]), sighting))
    session = replace(made.session(), views=tuple(views))
    return session if kind.stated else replace(session, scanner=replace(session.scanner, kind=None))


def _view(i: int, q: Array, approach: Array, T: Array, sighting: Sighting) -> View:
    return View(f"v{i}", None, T, q, approach, 10.0 * i, {}, sighting)


def main() -> None:
    """Print a line for each session, and what it comes to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(700, 706))
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    given = parser.parse_args()
    pin(0)
    wrong, zero, weak, again, count = 0, 0, 0, 0, 0
    for seed in range(*given.seeds):
        for name in given.kinds:
            began, start = time.process_time(), run(session_of_kind(KINDS[name], seed))
            first = diagnose(start)
            found, _, last = suggest(start, 5)
            final = found or start
            bad = first.verdict == "missing_effect" and first.effects[0] not in KINDS[name].right
            small = {term.name for term in final.terms if term.sigmas_from_zero < _SIGMAS}
            idle, faint = sorted(small - KINDS[name].right), sorted(small & KINDS[name].right)
            named = [effect for effect in last.effects if effect in final.tried]
            wrong, again, count = wrong + bad, again + bool(named), count + 1
            zero, weak = zero + bool(idle), weak + bool(faint)
            told = f"{first.verdict} {','.join(first.effects)} | {','.join(final.effects)} | {last.verdict}"
            marks = f"{'WRONG ' * bad}{f'ZERO {idle} ' if idle else ''}"
            marks += f"{f'WEAK {faint} ' if faint else ''}{f'AGAIN {named}' if named else ''}"
            print(f"{name} {seed} | {told} | {marks} {time.process_time() - began:.0f} s", flush=True)
    print(f"{count} sessions: first single name wrong {wrong}, at zero {zero}, weak {weak}, named again {again}")


if __name__ == "__main__":
    main()
