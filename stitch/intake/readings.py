"""Every way to read the rotations of a table, each with the words that name it.

Orders of Euler angles: twelve, about axes that turn along (intrinsic) or that stand still (extrinsic); Diebel (2006),
"Representing Attitude". `zyx-intrinsic` turns by the first number about z, by the second about the new y.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.layouts import ColumnLayout
from stitch.integrity.misread_rotations import ORDERS

# The usual ones first: roll, pitch, yaw (FANUC, ROS, Yaskawa); A, B, C (KUKA); the others as they come.
_USUAL = ("xyz-extrinsic", "zyx-intrinsic", "xyz-intrinsic", "rotation-vector", "zyz-intrinsic")
_BY_AXIS = ("XZY", "YXZ", "YZX", "ZXY")
# Larger numbers are degrees; a rotation vector and Euler angles in radians stay below.
_RADIANS = 2 * np.pi + 1e-3


@dataclass(frozen=True)
class Reading:
    """The poses of a table read in one way."""

    T: Array  # (V, 4, 4) lengths as the file has them
    rotation: str  # as --rotation names it
    angle_unit: str | None  # "deg" or "rad" where there are angles
    layout: ColumnLayout
    rank: int  # of the usual, 0 first

    @property
    def words(self) -> str:
        """As a person says it."""
        return self.rotation + (f", {'degrees' if self.angle_unit == 'deg' else 'radians'}" if self.angle_unit else "")


def rotation_conventions() -> list[str]:
    """Every word that --rotation knows."""
    angles = [*_euler_words(), *(f"{o.lower()}-by-axis" for o in _BY_AXIS), "rotation-vector"]
    return [*angles, "quaternion-xyzw", "quaternion-wxyz", "matrix", "matrix-transposed"]


def _euler_words() -> list[str]:
    return [f"{order.lower()}-{how}" for order in ORDERS for how in ("intrinsic", "extrinsic")]


def readings(layout: ColumnLayout, rotation: str | None = None, angle_unit: str | None = None) -> list[Reading]:
    """All readings of a layout that has a pose, the usual first; one where file or flags tell it.

    Args:
        rotation: one of `conventions()`, where a person says it.
        angle_unit: "deg" or "rad", likewise.

    Raises:
        InputError: a convention that these columns cannot have.
    """
    stated = rotation or layout.convention
    kinds = {3: _angle_readings, 4: _quaternion_readings, 9: _matrix_readings}
    numbers = layout.rotation.shape[1]
    found = list(kinds[numbers](layout, angle_unit or layout.angle_unit))
    if stated is not None:
        known = ", ".join(dict.fromkeys(r.rotation for r in found))
        found = [r for r in found if r.rotation == stated]
        if not found:
            raise InputError(f"--rotation {stated}: the rotation has {numbers} numbers; to fix: use one of {known}")
    return sorted(found, key=lambda r: r.rank)


def angle_units(values: Array, stated: str | None) -> list[str]:
    """Units that angles (V, k) can have: degrees where they exceed a turn in radians, else both, radians first."""
    if stated is not None:
        return [stated]
    return ["deg"] if np.abs(values).max(initial=0.0) > _RADIANS else ["rad", "deg"]


def _angle_readings(layout: ColumnLayout, stated: str | None) -> Iterator[Reading]:
    for place, unit in enumerate(angle_units(layout.rotation, stated)):
        angles = np.radians(layout.rotation) if unit == "deg" else layout.rotation
        for word, R in _rotations(angles):
            rank = _USUAL.index(word) if word in _USUAL else len(_USUAL)
            yield _rotation_reading(layout, R, word, unit, rank + 100 * place)


def _rotations(angles: Array) -> Iterator[tuple[str, Rotation]]:
    for word in _euler_words():
        order, how = word.split("-")
        yield word, Rotation.from_euler(order.upper() if how == "intrinsic" else order, angles)
    for order in _BY_AXIS:
        # Columns name the axes x, y, z; the turns come in another order than the columns stand.
        columns = ["XYZ".index(axis) for axis in order]
        yield f"{order.lower()}-by-axis", Rotation.from_euler(order, angles[:, columns])
    yield "rotation-vector", Rotation.from_rotvec(angles)


def _quaternion_readings(layout: ColumnLayout, _: str | None) -> Iterator[Reading]:
    q = layout.rotation / np.linalg.norm(layout.rotation, axis=1, keepdims=True)
    yield _rotation_reading(layout, Rotation.from_quat(q), "quaternion-xyzw", None, 0)
    if layout.convention == "quaternion-wxyz" or layout.convention is None:
        yield _rotation_reading(layout, Rotation.from_quat(q[:, [1, 2, 3, 0]]), "quaternion-wxyz", None, 1)


def _matrix_readings(layout: ColumnLayout, _: str | None) -> Iterator[Reading]:
    R = layout.rotation.reshape(-1, 3, 3)
    yield _rotation_reading(layout, Rotation.from_matrix(R), "matrix", None, 0)
    if layout.convention is None:
        yield _rotation_reading(layout, Rotation.from_matrix(R.transpose(0, 2, 1)), "matrix-transposed", None, 1)


def _rotation_reading(layout: ColumnLayout, R: Rotation, word: str, unit: str | None, rank: int) -> Reading:
    return Reading(frames.make(R.as_matrix(), layout.position), word, unit, layout, rank)
