"""The uncertainty of a hand-eye in the frame in which it is printed.

Its covariance Σ belongs to a right perturbation T·exp(ξ) in the scanner frame. Rotation vector and translation of T
in the mount frame move by J·ξ with J = diag(J_r⁻¹, R), so that theirs is J·Σ·Jᵀ (to first order).
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array
from stitch.units import METRES, value_uncertainty_text

# Expanded uncertainty U = k·σ, coverage about 95 % (JCGM 100:2008, GUM).
COVERAGE_FACTOR = 2.0
# Of a twist, for central differences: far above rounding, far below the bend of any angle.
_STEP = 1e-6


def printed_covariance(T_mount: Array, covariance: Array) -> Array:
    """(6, 6) of (rotation vector in rad, translation in length_unit), both in the mount frame.

    Args:
        T_mount: (4, 4) T_mount_scanner.
        covariance: (6, 6) of the right perturbation, rotation first.
    """
    J = np.zeros((6, 6))
    J[:3, :3] = frames.right_jacobian_inverse(Rotation.from_matrix(T_mount[:3, :3]).as_rotvec())
    J[3:, 3:] = T_mount[:3, :3]
    return J @ covariance @ J.T


def numbers_covariance(numbers: Callable[[Array], Array], T_mount: Array, covariance: Array) -> Array:
    """(n, n) of whatever numbers (n,) a controller writes of a hand-eye, to first order.

    Args:
        numbers: of a pose (4, 4); near T_mount they must not jump.
        T_mount: (4, 4) T_mount_scanner.
        covariance: (6, 6) of the right perturbation, rotation first.
    """
    steps = _STEP * np.eye(6)
    J = [(numbers(T_mount @ frames.exp(e)) - numbers(T_mount @ frames.exp(-e))) / (2 * _STEP) for e in steps]
    return np.asarray(np.transpose(J) @ covariance @ np.array(J))


def expanded_uncertainty(T_mount: Array, covariance: Array) -> Array:
    """(6,) U (k = 2) of rotation vector (rad) and translation (length_unit) in the mount frame."""
    return COVERAGE_FACTOR * np.sqrt(np.diag(printed_covariance(T_mount, covariance)))


def hand_eye_lines(T_mount: Array, covariance: Array, mount: str, length_unit: str) -> list[str]:
    """Return text: position in mm and rotation vector in mrad with U (k = 2), in the frame that carries the scanner."""
    frame = "base" if mount == "eye_to_hand" else "flange"
    to_mm = METRES[length_unit] * 1e3
    rotation = Rotation.from_matrix(T_mount[:3, :3]).as_rotvec() * 1e3
    U = expanded_uncertainty(T_mount, covariance) * np.repeat([1e3, to_mm], 3)
    position, turn = (
        ", ".join(f"{axis} {value_uncertainty_text(x, u)}" for axis, x, u in zip("xyz", values, size, strict=True))
        for values, size in ((T_mount[:3, 3] * to_mm, U[3:]), (rotation, U[:3]))
    )
    return [
        f"Hand-eye T_{frame}_scanner, in the frame of the {frame}, ± U (k = 2) for a complete model:",
        f"  position {position} mm",
        f"  rotation vector {turn} mrad",
    ]


def uncertainty_scope(verdict: str | None) -> str:
    """Of which model U is: a sigma counts no effect that is missing.

    Args:
        verdict: of the diagnosis; None where there is none yet.
    """
    told = {
        None: "; whether an effect is missing has not been asked",
        "adequate": "; no effect is found missing",
    }
    return f"U of the hand-eye holds for a complete model{told.get(verdict, ', and this one seems to lack something')}."
