"""Covariances between views: how alike two views err that are near in time, near in pose, or the same pose."""

from dataclasses import dataclass

import numpy as np

from stitch.numerics.frames import Array, Mask

# Poses that differ by less, in rad and as a share of their distance from the base, are the same stop.
_SAME = 1e-4
# How far in its own unit (a radian, a turn's 57°) an error of a joint stays alike, and what a tooth does to it.
REACH, SHORT_REACH = 1.0, 0.2


def rbf_joints(joints: Array, others: Array | None = None, reach: float = REACH) -> Array:
    """(V, V) of a smooth function of all joints (V, n) rad: of each alone, of pairs, …, of all, equally likely; or
    (V, O) with other views (O, n). Alike as far as `reach`, rad.

    The product over joints of (1 + k)/2, with k a Gaussian on the circle (analysis-of-variance kernel; Durrande et
    al. 2013, J. Multivariate Analysis 115:57; periodic: MacKay 1998).
    """
    others = joints if others is None else others
    out = np.ones((len(joints), len(others)))
    # One joint after the other: of thousands of views all factors at once would take a gigabyte.
    for joint in range(joints.shape[1]):
        out *= joint_kernel_factors(joints[:, [joint]], others[:, [joint]], reach)[..., 0]
    return out


def joint_kernel_factors(some: Array, others: Array, reach: float = REACH) -> Array:
    """(S, O, n) factors of that product between joints (S, n) and (O, n), rad; alike as far as `reach`, rad."""
    # cos(a − b) = 1 − 2 sin²((a − b)/2), from sines and cosines of each angle alone.
    alike = np.cos(some)[:, None] * np.cos(others) + np.sin(some)[:, None] * np.sin(others)
    return (1 + np.exp((alike - 1) / reach**2)) / 2


def short_range_kernel(some: Array, others: Array) -> Array:
    """(S, O) of a function of one joint's angle alone, (S,) and (O,) rad, that may change within a few degrees."""
    return 2 * joint_kernel_factors(some[:, None], others[:, None], SHORT_REACH)[..., 0] - 1


def periodic_kernel(some: Array, others: Array, period: float) -> Array:
    """(S, O) of a function of one joint's angle, (S,) and (O,) rad, that repeats after a period, rad; smooth within it
    (MacKay 1998)."""
    phase = np.pi * (some[:, None] - others[None, :]) / period
    return np.exp(-2 * np.sin(phase) ** 2)


def two_joint_kernel(one: Array, other: Array) -> Array:
    """(V, V) of a smooth function of the angles of two joints, (V,) rad each."""
    both = np.column_stack([one, other])
    return (2 * joint_kernel_factors(both, both) - 1).prod(axis=2)


def direction_kernel(joint: Array, travel: Array) -> Array:
    """(V, V) of a function of one joint's angle (V,) rad, smooth, and of how far it came, (V,) rad, by any law:
    continuous and no more (Ornstein–Uhlenbeck, over the range of the joint), as play, friction and settling are.
    """
    return rbf_joints(joint[:, None]) * exponential_kernel(travel, travel, direction_reach(joint))


def exponential_kernel(some: Array, others: Array, reach: float) -> Array:
    """Return (S, O) of a continuous function of one number, (S,) and (O,), alike as far as `reach`.

    It is the process that forgets (Ornstein–Uhlenbeck); of time in steps from view to view the reach is its memory.
    """
    return np.exp(-np.abs(some[:, None] - others[None, :]) / reach)


def load_kernel(torques: Array) -> Array:
    """(V, V) of a continuous function of the torques (V, m) that bend one joint, each of which changes
    (Ornstein–Uhlenbeck, over the range of each)."""
    share = torques / np.ptp(torques, axis=0)
    return np.exp(-np.abs(share[:, None] - share[None]).mean(axis=2))


def direction_reach(joint: Array) -> float:
    """How far a move may differ and still do nearly the same, rad: the range of the joint (V,) rad."""
    return max(float(np.ptp(joint)), 1e-9)


def same_stop(T_base_flange: Array) -> Mask:
    """(V, V) views taken from one and the same pose (V, 4, 4), whatever else they saw."""
    turned = np.abs(T_base_flange[:, None, :3, :3] - T_base_flange[None, :, :3, :3]).max(axis=(2, 3))
    away = np.linalg.norm(T_base_flange[:, None, :3, 3] - T_base_flange[None, :, :3, 3], axis=2)
    reach = float(np.linalg.norm(T_base_flange[:, :3, 3], axis=1).mean())
    return (turned < _SAME) & (away < _SAME * max(reach, 1e-300))


@dataclass(frozen=True)
class SmoothErrors:
    """Errors f_p(view)·column_p of all views by a joint, with smooth processes f_p that nobody wrote down; a joint may
    have several, of which one is there."""

    columns: Array  # (6V, P) twists of the views per unit of each process
    kernel: Array  # (V, V) covariance of each, or (P, V, V) where they differ
    joints: tuple[int, ...]  # (P,) that each is of, counted from 0
    others: tuple[int, ...] = ()  # (P,) whose angle it follows beside the joint's own, counted from 0; () if none
    periods: tuple[float, ...] = ()  # (P,) after which it repeats, rad; () if it does not

    def of_joint(self, joint: int) -> list[int]:
        """The processes of a joint, counted from 0."""
        return [p for p, of_process in enumerate(self.joints) if of_process == joint]

    def twist_covariance(self, process: int) -> Array:
        """(6V, 6V) covariance of the twists by one process alone."""
        return process_covariance(self.columns[:, [process]], self.kernel_of(process))

    def kernel_of(self, process: int) -> Array:
        """(V, V) covariance of a process."""
        return self.kernel if self.kernel.ndim == 2 else np.asarray(self.kernel[process])


def process_covariance(columns: Array, kernel: Array) -> Array:
    """(6V, 6V) covariance of Σ_p f_p(view)·column_p with independent processes f_p of covariance `kernel` (V, V).

    Args:
        columns: (6V, P) twists of the views per unit of each process.
    """
    views = len(kernel)
    unit = (columns @ columns.T).reshape(views, 6, views, 6)
    return (unit * kernel[:, None, :, None]).reshape(6 * views, 6 * views)
