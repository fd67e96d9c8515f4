"""Covariances between views: how alike two views err that are near in time, near in pose, or the same pose."""

from dataclasses import dataclass

import numpy as np

from stitch.numerics.frames import Array, Mask

# Poses that differ by less, in rad and as a share of their distance from the base, are the same stop.
_SAME = 1e-4
# How far in its own unit (a radian, a turn's 57°) an error of a joint stays alike, and what a tooth does to it.
REACH, SHORT_REACH = 1.0, 0.2


def rbf_joints(joints: Array, others: Array | None = None, reach: float = REACH) -> Array:
    """Return covariances (V, O) between views of a smooth random function of all joint angles, of variance 1.

    The product over joints of (1 + k)/2, with k = exp((cos Δ − 1)/reach²) a Gaussian on the circle. So the function is
    a sum of functions of every set of joints, equally large (analysis-of-variance kernel; Durrande et al. 2013,
    J. Multivariate Analysis 115:57; periodic: MacKay 1998).

    Args:
        joints: (V, n) rad.
        others: (O, n) rad; None: the same views, O = V.
        reach: angle over which the function changes little, rad.
    """
    others = joints if others is None else others
    out = np.ones((len(joints), len(others)))
    # One joint after the other: of thousands of views all factors at once would take a gigabyte.
    for joint in range(joints.shape[1]):
        out *= joint_kernel_factors(joints[:, [joint]], others[:, [joint]], reach)[..., 0]
    return out


def joint_kernel_factors(some: Array, others: Array, reach: float = REACH) -> Array:
    """Return the factors (S, O, n) of `rbf_joints`, (1 + k)/2 with k = exp((cos Δ − 1)/reach²) for each of n joints.

    Args:
        some, others: (S, n) and (O, n) joint angles, rad.
        reach: angle over which a function changes little, rad.
    """
    # cos(a − b) = 1 − 2 sin²((a − b)/2), from sines and cosines of each angle alone.
    alike = np.cos(some)[:, None] * np.cos(others) + np.sin(some)[:, None] * np.sin(others)
    return (1 + np.exp((alike - 1) / reach**2)) / 2


def short_range_kernel(some: Array, others: Array) -> Array:
    """Return covariances (S, O) of a random function of one joint's angle that may change within a few degrees.

    A Gaussian on the circle of reach `SHORT_REACH`.

    Args:
        some, others: (S,) and (O,) angles, rad.
    """
    return 2 * joint_kernel_factors(some[:, None], others[:, None], SHORT_REACH)[..., 0] - 1


def periodic_kernel(some: Array, others: Array, period: float) -> Array:
    """Return covariances (S, O) of a smooth random function of one joint's angle that repeats after `period`, rad.

    MacKay 1998.

    Args:
        some, others: (S,) and (O,) angles, rad.
    """
    phase = np.pi * (some[:, None] - others[None, :]) / period
    return np.exp(-2 * np.sin(phase) ** 2)


def two_joint_kernel(one: Array, other: Array) -> Array:
    """Return covariances (V, V) of a smooth random function of the angles of two joints together, (V,) rad each."""
    both = np.column_stack([one, other])
    return (2 * joint_kernel_factors(both, both) - 1).prod(axis=2)


def direction_kernel(joint: Array, travel: Array) -> Array:
    """Return covariances (V, V) of a random function of one joint's angle and of its last move, of variance 1.

    Smooth in the angle; in the move continuous and no more (Ornstein–Uhlenbeck), as play, friction and settling are.

    Args:
        joint: (V,) angle, rad.
        travel: (V,) signed move that led to the view, rad.
    """
    return rbf_joints(joint[:, None]) * exponential_kernel(travel, travel, direction_reach(joint))


def exponential_kernel(some: Array, others: Array, reach: float) -> Array:
    """Return covariances (S, O) of a continuous random function of one number: exp(−|Δ|/reach) (Ornstein–Uhlenbeck).

    Args:
        some, others: (S,) and (O,) values of the number, as times.
        reach: difference at which the covariance has fallen to 1/e, in the unit of the numbers.
    """
    return np.exp(-np.abs(some[:, None] - others[None, :]) / reach)


def load_kernel(torques: Array) -> Array:
    """Return covariances (V, V) of a continuous random function of the torques that bend one joint: exp(−mean |Δ|).

    Each torque counts as a share of its range over the views (Ornstein–Uhlenbeck).

    Args:
        torques: (V, m) N m, none of them constant over the views.
    """
    share = torques / np.ptp(torques, axis=0)
    return np.exp(-np.abs(share[:, None] - share[None]).mean(axis=2))


def direction_reach(joint: Array) -> float:
    """Return how far a move may differ and still have nearly the same effect, rad: the range of the joint (V,) rad."""
    return max(float(np.ptp(joint)), 1e-9)


def same_stop(T_base_flange: Array) -> Mask:
    """Return (V, V) True where two views were taken from the same pose, within `_SAME`.

    Args:
        T_base_flange: (V, 4, 4). Lengths are compared with the mean distance of the flange from the base.
    """
    turned = np.abs(T_base_flange[:, None, :3, :3] - T_base_flange[None, :, :3, :3]).max(axis=(2, 3))
    away = np.linalg.norm(T_base_flange[:, None, :3, 3] - T_base_flange[None, :, :3, 3], axis=2)
    reach = float(np.linalg.norm(T_base_flange[:, :3, 3], axis=1).mean())
    return (turned < _SAME) & (away < _SAME * max(reach, 1e-300))


@dataclass(frozen=True)
class SmoothErrors:
    """Errors of all poses by P smooth random functions of the views, each of one joint: twists f_p(view)·column_p.

    Of several of one joint at most one is in the model at a time.
    """

    columns: Array  # (6V, P) twists of the views per unit of each process
    kernel: Array  # (V, V) covariance of each, or (P, V, V) where they differ
    joints: tuple[int, ...]  # (P,) that each is of, counted from 0
    others: tuple[int, ...] = ()  # (P,) whose angle it follows beside the joint's own, counted from 0; () if none
    periods: tuple[float, ...] = ()  # (P,) after which it repeats, rad; () if it does not

    def of_joint(self, joint: int) -> list[int]:
        """Return the indices p of the functions of a joint; joints are counted from 0."""
        return [p for p, of_process in enumerate(self.joints) if of_process == joint]

    def twist_covariance(self, process: int) -> Array:
        """Return the covariance (6V, 6V) of the twists by one process alone, given by its index."""
        return process_covariance(self.columns[:, [process]], self.kernel_of(process))

    def kernel_of(self, process: int) -> Array:
        """Return the covariance (V, V) between views of a process, given by its index."""
        return self.kernel if self.kernel.ndim == 2 else np.asarray(self.kernel[process])


def process_covariance(columns: Array, kernel: Array) -> Array:
    """Return the covariance (6V, 6V) of Σ_p f_p(view)·column_p, with independent random functions f_p.

    Args:
        columns: (6V, P) twists of the views, (rotation, translation) in rad and length_unit, per unit of each f_p.
        kernel: (V, V) covariance of every f_p between views.
    """
    views = len(kernel)
    unit = (columns @ columns.T).reshape(views, 6, views, 6)
    return (unit * kernel[:, None, :, None]).reshape(6 * views, 6 * views)
