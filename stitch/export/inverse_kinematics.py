"""Joint angles for a pose of the nominal arm, found from joint angles nearby; any chain of revolute joints."""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement import robot as kinematics
from stitch.measurement.robot import Robot

# A radian weighs as much as this length, m: about the reach of an arm, so that both parts of a twist count alike.
LEVER = 1.0
_NEWTON_STEPS = 100
# Largest step of a joint (rad): the arm stays on its way to the nearest solution.
_LONGEST = 0.3
_CLOSE = 1e-11


def joint_solutions(robot: Robot, T_base_flange: Array, near: Array) -> Array:
    """(m, n) solutions in rad, each once, that damped Newton steps find from joint angles near (s, n); m may be 0.

    Levenberg-Marquardt on the pose error (Sugihara 2011, IEEE Trans. Robotics 27:984): the damping follows the error.
    """
    q = np.array(near, float)
    weight = np.repeat([1.0, robot.metres_per_unit / LEVER], 3)
    for _ in range(_NEWTON_STEPS):
        off = weight * frames.log(frames.inverse(kinematics.forward(robot, q)) @ T_base_flange)
        size = np.einsum("si,si->s", off, off)
        if (size < _CLOSE**2).all():
            break
        J = weight[:, None] * kinematics.jacobian(robot, q)
        damped = J @ np.swapaxes(J, -1, -2) + (0.5 * size + 1e-14)[:, None, None] * np.eye(6)
        step = np.einsum("sij,si->sj", J, np.linalg.solve(damped, off[..., None])[..., 0])
        longest = np.abs(step).max(axis=1, keepdims=True)
        q = q + step * np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-300))
    off = weight * frames.log(frames.inverse(kinematics.forward(robot, q)) @ T_base_flange)
    found: list[Array] = []
    # A singular pose is closed in slowly; a nanometre and a nanoradian are far below any arm.
    for solution in q[np.linalg.norm(off, axis=1) < 1e-9]:
        if all(np.abs(_principal_angles(solution - other)).max() > 1e-4 for other in found):
            found.append(solution)
    return np.array(found).reshape(-1, robot.n_joints)


def _principal_angles(angle: Array) -> Array:
    """Less whole turns."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
