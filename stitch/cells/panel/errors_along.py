"""Error of the slaves against the master along a motion: what the global model's uncertainty makes of it.

For a pure translation d the slave errs by (δR)·d, so the position error grows with the distance and the direction
error does not change; for a pure turn the relative positions of the flanges enter too (source, eqs. 19-24).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.cells.panel.global_model import RobotModel
from stitch.cells.panel.panel_motion import follow
from stitch.frames import Array


@dataclass(frozen=True)
class MotionErrors:
    """Rms over the draws, for D distances or angles along each of the three axes of the master's base."""

    steps: Array  # (D,) mm or rad
    position: Array  # (3, D, N) mm, contact frame of each robot against the master's
    angle: Array  # (3, D, N) rad


def errors_along_motion(
    models: Sequence[RobotModel], T_base_flange: Array, master: int, steps: Array, *, turn: bool, draws: int = 200
) -> MotionErrors:
    """Rms change of the relative pose of each slave's contact frame, per axis and step.

    The true cell is drawn about the model from each robot's covariance; commands come from the model alone.

    Args:
        T_base_flange: (N, 4, 4) where the robots stand.
        steps: (D,) distances in mm, or angles in rad if `turn`; a turn is about the master's flange.
    """
    T_world_base = _stacked_models(models)[0]
    true_base, true_contact = _draw_models(models, draws)

    def relative(flanges: Array) -> Array:
        contact = true_base @ flanges @ true_contact
        return np.asarray(frames.inverse(contact[:, master : master + 1]) @ contact)

    before = frames.inverse(relative(T_base_flange))
    out = np.zeros((2, 3, len(steps), len(models)))
    for axis in range(3):
        for k, step in enumerate(steps):
            T_master = _moved_flanges(T_base_flange[master], axis, step, turn)
            change = frames.log(before @ relative(follow(T_world_base, T_base_flange, master, T_master)))
            for part, columns in enumerate((change[..., 3:], change[..., :3])):
                out[part, axis, k] = np.sqrt((columns**2).sum(axis=-1).mean(axis=0))
    return MotionErrors(np.asarray(steps, float), out[0], out[1])


def errors_by_master(models: Sequence[RobotModel], T_base_flange: Array, distance: float, angle: float) -> Array:
    """(N, 2) worst rms position error (mm) of any slave after a distance (mm) and an angle (rad), per master."""
    rows = []
    for master in range(len(models)):
        args = models, T_base_flange, master
        shift, turn = (
            errors_along_motion(*args, np.array([distance]), turn=False),
            errors_along_motion(*args, np.array([angle]), turn=True),
        )
        rows.append([shift.position.max(), turn.position.max()])
    return np.array(rows)


def _stacked_models(models: Sequence[RobotModel]) -> tuple[Array, Array]:
    return np.array([m.T_world_base for m in models]), np.array([m.T_flange_contact for m in models])


def _draw_models(models: Sequence[RobotModel], draws: int) -> tuple[Array, Array]:
    """True bases and clamps (draws, N, 4, 4) that the covariances allow."""
    rng = np.random.default_rng(0)
    xi = np.stack([rng.multivariate_normal(np.zeros(12), m.covariance, draws, "ignore") for m in models], axis=1)
    bases, clamps = _stacked_models(models)
    return bases @ frames.exp(xi[..., :6]), clamps @ frames.exp(xi[..., 6:])


def _moved_flanges(T_base_flange: Array, axis: int, step: float, turn: bool) -> Array:
    """The flange moved along, or turned about its own origin with, an axis of its base."""
    motion = np.zeros(6)
    motion[axis if turn else 3 + axis] = step
    T = frames.exp(motion)
    moved = T_base_flange.copy()
    moved[:3, :3] = T[:3, :3] @ moved[:3, :3]
    moved[:3, 3] += T[:3, 3]
    return moved
