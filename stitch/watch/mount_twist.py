"""The hand-eye of a run as six numbers that can be compared from day to day: a twist about the part.

About the scanner's own origin, a turn of the mount and a shift of it are hardly told apart: their errors go together.
About the middle of what the scanner looks at they are: the shift is what moves there. So the mount's motion since the
first run is counted about that point, in the axes of the frame that carries the scanner (base or flange).
"""

import numpy as np

from stitch import frames
from stitch.frames import Array

TWIST_NAMES = ("rx", "ry", "rz", "x", "y", "z")


def mount_twist(T_mount: Array, T_mount_first: Array, centre_scanner: Array) -> Array:
    """(6,) log of the mount's motion since the first run: rad, length_unit; axes of the mount frame, about the centre.

    Args:
        centre_scanner: (3,) the middle of what the first run saw, scanner frame.
    """
    about = _watch_frame(T_mount_first, centre_scanner)
    return np.asarray(frames.log(frames.inverse(about) @ T_mount @ frames.inverse(T_mount_first) @ about))


def twist_covariance(covariance: Array, T_mount: Array, T_mount_first: Array, centre_scanner: Array) -> Array:
    """(6, 6) of `mount_twist` from that of the right perturbation T_mount·exp(ξ), to first order."""
    J = frames.adjoint(frames.inverse(_watch_frame(T_mount_first, centre_scanner)) @ T_mount)
    return np.asarray(J @ covariance @ J.T)


def middle_in_scanner(poses: Array, middle: Array) -> Array:
    """(3,) where on average the scanner has the middle of the part before it.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        middle: (3,) of the part, reference frame.
    """
    return np.asarray(frames.transform(frames.inverse(poses), middle[None])[:, 0].mean(axis=0))


def _watch_frame(T_mount_first: Array, centre_scanner: Array) -> Array:
    """(4, 4) axes of the mount frame at the centre."""
    return frames.make(np.eye(3), frames.transform(T_mount_first, centre_scanner[None])[0])
