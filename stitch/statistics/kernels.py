"""Covariances between views: how alike two views err that are near in time, near in pose, or the same pose."""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array

# How far in its own unit (a radian, a turn's 57°) an error of a joint stays alike.
_REACH = 1.0
# Correlation times in steps from view to view: half of the wandering is quick, half slow.
_QUICK, _SLOW = 2.0, 10.0


def alike_in_joints(joints: Array) -> Array:
    """(V, V) of a smooth function of all joints (V, n) rad: of each alone, of pairs, …, of all, equally likely.

    The product over joints of (1 + k)/2, with k a Gaussian on the circle (analysis-of-variance kernel; Durrande et
    al. 2013, J. Multivariate Analysis 115:57; periodic: MacKay 1998).
    """
    return np.asarray(np.prod(alike_joint_by_joint(joints, joints), axis=2))


def alike_joint_by_joint(some: Array, others: Array) -> Array:
    """(S, O, n) factors of that product between joints (S, n) and (O, n), rad."""
    apart = some[:, None, :] - others[None, :, :]
    return np.asarray((1 + np.exp(-2 * np.sin(apart / 2) ** 2 / _REACH**2)) / 2)


def alike_in_time(time: Array) -> Array:
    """(V, V) of a process that forgets (Ornstein–Uhlenbeck), quick and slow; time (V,) in steps from view to view."""
    apart = np.abs(time[:, None] - time[None, :])
    return np.asarray(0.5 * np.exp(-apart / _QUICK) + 0.5 * np.exp(-apart / _SLOW))


@dataclass(frozen=True)
class SmoothErrors:
    """Errors Σ_p f_p(view)·column_p of all views, with smooth processes f_p that nobody wrote down."""

    columns: Array  # (6V, P) twists of the views per unit of each process
    alike: Array  # (V, V) covariance of each

    def of(self, p: int) -> Array:
        """(6V, 6V) covariance of the twists by process p alone."""
        return spread_over(self.columns[:, [p]], self.alike)


def spread_over(columns: Array, alike: Array) -> Array:
    """(6V, 6V) covariance of Σ_p f_p(view)·column_p with independent processes f_p of covariance `alike` (V, V).

    Args:
        columns: (6V, P) twists of the views per unit of each process.
    """
    views = len(alike)
    own = (columns @ columns.T).reshape(views, 6, views, 6)
    return np.asarray((own * alike[:, None, :, None]).reshape(6 * views, 6 * views))
