"""Which joint angle, corrected, puts a displaced view where the surfaces want it: a wrong digit, a neighbour's row."""

import numpy as np
from scipy.optimize import minimize_scalar

from stitch import frames
from stitch.frames import Array
from stitch.integrity.snooping import MisplacedView
from stitch.measurement.capture import Capture
from stitch.measurement.robot import forward
from stitch.measurement.session import Session

# One joint explains a displacement if it leaves less than this share of it.
_MAX_REMAINING_SHARE = 0.1


def find_wrong_joint(
    session: Session, capture: Capture, T_mount: Array, m: MisplacedView
) -> tuple[str, float, float, bool] | None:
    """The joint that alone explains a displacement: name, degrees stated and that fit, whether a neighbour's."""
    robot, joints = session.robot, session.views[m.view].joints
    if robot is None or joints is None or m.T is None:
        return None
    points = capture.scans[m.view].points[::50]
    there = frames.transform(m.T, points)

    def off(q: Array) -> float:
        T = forward(robot, q)
        T = frames.inverse(T) if session.mount == "eye_to_hand" else T
        return float(np.sqrt(((frames.transform(T @ T_mount, points) - there) ** 2).sum(axis=1).mean()))

    start = off(joints)
    best: tuple[float, int, float] = (np.inf, 0, 0.0)
    for j in range(len(joints)):
        unit = np.eye(len(joints))[j]
        grid = np.linspace(-np.pi, np.pi, 181)
        near = grid[int(np.argmin([off(joints + a * unit) for a in grid]))]
        for a in (near, 0.0):
            fit = minimize_scalar(lambda x, u=unit: off(joints + x * u), bracket=(a - 0.02, a + 0.02))
            best = min(best, (float(fit.fun), j, float(fit.x)))
    left, j, turn = best
    if left > _MAX_REMAINING_SHARE * start:
        return None
    fits = joints[j] + turn
    others = [session.views[r].joints for r in (m.view - 1, m.view + 1) if 0 <= r < len(session.views)]
    neighbour = any(q is not None and abs(q[j] - joints[j]) < 1e-9 for q in others)
    return f"j{j + 1}_deg", float(np.degrees(joints[j])), float(np.degrees(fits)), neighbour
