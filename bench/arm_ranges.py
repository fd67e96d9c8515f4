"""Tables of links calibrated in one half of the joints' ranges, judged in the other half and in the whole.

Run: python bench/arm_ranges.py [--arms 20] [--seed 500] [--write]; writes the table of docs/points.md. Every arm is
ordinary (data_synth/ordinary_arm.py: offsets, links and gears) and bends by gravity. It is calibrated on 60 poses of
three reflectors with joints 1 to 3 in one half of their ranges; joint 1 of every fourth arm turns 43° in all. Judged
are true places of a reflector at 400 other poses, base and tool fitted anew, beside the best size of the prior.
"""

import argparse
from pathlib import Path

import numpy as np
from batch import into_page
from blind_trials import pin
from scipy.spatial.transform import Rotation

from data_synth.arms import ARMS
from data_synth.kinematics import gravity_torques
from data_synth.ordinary_arm import draw_arm
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.metrology.calibrate.robot import LINK_TRUSTS, link_table, observe_links
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.robot import Robot, forward
from stitch.session.session import Scanner, SessionData, Sighting, View

PAGE = Path(__file__).resolve().parents[1] / "docs" / "points.md"
_TARGETS = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0]])
_VIEWS, _JUDGED, _NOISE, _BEND = 60, 400, 0.01, 2e-6
_SCATTER = np.repeat([2e-5, 0.02], 3)  # of the poses, rad and mm
_MECA = np.radians(43.0)


class SimulatedArm:
    """One arm, where it truly goes, and a tracker before it."""

    def __init__(self, seed: int) -> None:
        """Draw it."""
        self.rng = np.random.default_rng(seed)
        self.arm = ARMS["ABB IRB 120"]
        self.wrong = draw_arm(self.arm.joints, 1.0, self.rng)
        self.low, self.high = np.maximum(self.arm.lower, -2.0), np.minimum(self.arm.upper, 2.0)
        if seed % 4 == 0:
            self.low[0], self.high[0] = -_MECA / 2, _MECA / 2
        self.upper = self.rng.random(3) < 0.5  # the half in which it is calibrated
        rows = zip(self.arm.a, np.degrees(self.arm.alpha), self.arm.d, np.degrees(self.arm.theta), strict=True)
        keys = ("a", "alpha_deg", "d", "theta_deg")
        table = [dict(zip(keys, map(float, row), strict=True)) for row in rows]
        self.nominal = robot_from_dh("arm", "standard", table, None, np.array([0, 0, -9.81]), "mm")

    def joints(self, count: int, half: str) -> Array:
        """(count, 6) rad in the half of the calibration, the other one, or the whole."""
        q = self.rng.uniform(self.low, self.high, (count, len(self.low)))
        middle = (self.low + self.high)[:3] / 2
        above = self.upper if half == "calibrated" else ~self.upper
        if half != "whole":
            q[:, :3] = np.where((q[:, :3] > middle) == above, q[:, :3], 2 * middle - q[:, :3])
        return q

    def true_flange(self, q: Array) -> Array:
        """(V, 4, 4)."""
        return self.wrong.flange(self.arm, q + _BEND * gravity_torques(self.arm, q))

    def session(self) -> SessionData:
        """What the tracker saw in the half of the calibration."""
        q = self.joints(_VIEWS, "calibrated")
        T = self.true_flange(q) @ frames.exp(_SCATTER * self.rng.normal(size=(_VIEWS, 6)))
        X = frames.make(Rotation.random(rng=self.rng).as_matrix(), 1500 * self.rng.normal(size=3))
        seen = frames.transform(frames.inverse(X) @ T, np.broadcast_to(_TARGETS, (_VIEWS, 3, 3)))
        seen = seen + _NOISE * self.rng.normal(size=seen.shape)
        names, sigma = ("t0", "t1", "t2"), np.full(3, _NOISE)
        nominal = forward(self.nominal, q)
        views = [
            View(f"v{i}", None, nominal[i], q[i], np.zeros(6), None, {}, Sighting(names, seen[i], sigma))
            for i in range(_VIEWS)
        ]
        scanner = Scanner(None, _NOISE, None, np.array([0, 0, 1.0]), "tracker")
        return SessionData(
            Path("arm"), "arm", "mm", "eye_to_hand", scanner, self.nominal, None, None, None, tuple(views)
        )

    def error(self, robot: Robot, q: Array) -> float:
        """Rms distance of a reflector from where the table has it, mm, base and tool fitted anew to the first order."""
        true, told = self.true_flange(q), forward(robot, q)
        place = told[:, :3, :3] @ _TARGETS[0] + told[:, :3, 3]
        off = true[:, :3, :3] @ _TARGETS[0] + true[:, :3, 3] - place
        turned = [np.cross(axis, place)[..., None] for axis in np.eye(3)]
        still = np.tile(np.eye(3), (len(q), 1, 1))
        A = np.concatenate([*turned, still, told[:, :3, :3]], axis=2).reshape(-1, 9)
        left = off.ravel() - A @ np.linalg.lstsq(A, off.ravel(), rcond=None)[0]
        return float(np.sqrt(3 * np.mean(left**2)))


def row_of(seed: int) -> tuple[str, bool, float]:
    """A line of the table, whether it is better than the nominal arm everywhere, and its share of the best ridge."""
    made = SimulatedArm(seed)
    session = made.session()
    found, seen = link_table(session), observe_links(session)
    every = np.ones(len(seen.joints), bool)
    cells, better, shares = [], True, []
    for half in ("other", "whole"):
        q = made.joints(_JUDGED, half)
        nominal, own = made.error(made.nominal, q), made.error(found.robot, q)
        best = min(made.error(seen.table(made.nominal, scale, every), q) for scale in LINK_TRUSTS)
        cells += [f"{nominal:.3f}", f"{own:.3f}", f"{best:.3f}"]
        better, shares = better and own < nominal, [*shares, own / best]
    meca = "43°" if seed % 4 == 0 else "half"
    return f"| {seed} | {meca} | {' | '.join(cells)} |", better, max(shares)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--write", action="store_true", help="put the table into docs/points.md")
    given = parser.parse_args()
    pin(0)
    told = ["| arm | joint 1 | other half: nominal | table | best ridge | whole: nominal | table | best ridge |"]
    told, better, near = [*told, "|---|---|---:|---:|---:|---:|---:|---:|"], 0, 0
    for seed in range(given.seed, given.seed + given.arms):
        line, is_better, share = row_of(seed)
        told, better, near = [*told, line], better + is_better, near + (share < 1.3)
        print(line, f"{share:.2f}", flush=True)
    told += ["", f"Better than the nominal arm: {better} of {given.arms}; within 1.3 of the best ridge: {near}."]
    printed = "\n".join(told)
    print(printed)
    if given.write:
        into_page("ranges", printed.split("\n"), PAGE)


if __name__ == "__main__":
    main()
