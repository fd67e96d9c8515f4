"""Rotations that were read in another way than they were written, undone.

Orders of Euler angles are those of Diebel (2006), "Representing Attitude": six with three axes, six with two.
"""

import warnings
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.frames import Array

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")


def other_quaternions(q: Array) -> Iterator[tuple[str, Rotation]]:
    """Readings (V, 4) x, y, z, w taken for another order."""
    yield "w, x, y, z, not x, y, z, w", Rotation.from_quat(q[:, [1, 2, 3, 0]])
    yield "x, y, z, w but were reordered as if w came first", Rotation.from_quat(q[:, [3, 0, 1, 2]])


def other_angles(R: Rotation) -> Iterator[tuple[str, Rotation]]:
    """Angles that were composed in one order and belong into another; columns by place, and by the axis they name."""
    for order in (*ORDERS, *(o.lower() for o in ORDERS)):
        angles = _angles(R, order)
        for right in (*ORDERS, *(o.lower() for o in ORDERS)):
            if right != order:
                yield _order_fix(order, right), Rotation.from_euler(right, angles)
        if len(set(order.upper())) == 3:
            for right in ORDERS[:6]:
                if right != order:
                    named = np.column_stack([angles[:, order.upper().index(axis)] for axis in right])
                    yield _order_fix(order, right), Rotation.from_euler(right, named)
        yield "the angles are a rotation vector, not Euler angles", Rotation.from_rotvec(_shortest(angles))
    for right in (*ORDERS, *(o.lower() for o in ORDERS)):
        yield (
            f"the rotation vectors are Euler angles in the order {_order_name(right)}",
            Rotation.from_euler(right, R.as_rotvec()),
        )


def _order_fix(order: str, right: str) -> str:
    return f"the Euler angles were turned in the order {_order_name(order)} and belong into {_order_name(right)}"


def _order_name(order: str) -> str:
    """Capitals turn about the axes that turned already (intrinsic)."""
    return f"{order.lower()}-{'intrinsic' if order.isupper() else 'extrinsic'}"


def degrees_for_radians(R: Rotation) -> Iterator[tuple[str, Rotation]]:
    """Angles in radians that were taken for degrees."""
    words = "the angles are radians, and were read as degrees"
    yield words, Rotation.from_rotvec(R.as_rotvec() * 180 / np.pi)
    for order in ORDERS:
        yield f"{words} ({_order_name(order)})", Rotation.from_euler(order, _angles(R, order) * 180 / np.pi)


def _angles(R: Rotation, order: str) -> Array:
    with warnings.catch_warnings():
        # Gimbal lock sets an angle to zero: that reading is one of those to try.
        warnings.simplefilter("ignore")
        return np.asarray(R.as_euler(order))


def _shortest(angles: Array) -> Array:
    """Of the two triples of angles about three axes that make one rotation, the shorter: vectors are at most π long."""
    other = np.stack([angles[:, 0] - np.pi, np.pi - angles[:, 1], angles[:, 2] - np.pi], axis=1)
    other = (other + np.pi) % (2 * np.pi) - np.pi
    shorter = np.linalg.norm(other, axis=1) < np.linalg.norm(angles, axis=1)
    return np.where(shorter[:, None], other, angles)
