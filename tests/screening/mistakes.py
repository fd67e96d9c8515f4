"""Mistakes with the poses of a session: what they do, and what they may be called."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from bench.integrity import OTHER_MOUNT, posed, turned
from stitch.numerics import frames


def _exchanged(T):
    T = T.copy()
    T[[2, 8]] = T[[8, 2]]
    return T


def _as_text(views):
    """Files 1 to so many as `ls` sorts them."""
    return sorted(range(views), key=lambda v: str(v + 1))


def _column(axis, change):
    def apply(T):
        T = T.copy()
        T[:, axis, 3] = change(T[:, axis, 3])
        return T

    return posed(apply)


def _midway(T, ahead):
    """Poses interpolated to half a step: turned evenly, moved along lines; the last one has no neighbour."""
    there = np.clip(np.arange(len(T)) + ahead, 0, len(T) - 1)
    R = Rotation.from_matrix(T[:, :3, :3])
    halfway = R * Rotation.from_rotvec(0.5 * (R.inv() * R[there]).as_rotvec())
    return frames.make(halfway.as_matrix(), (T[:, :3, 3] + T[there, :3, 3]) / 2)


def _midway_by_screws(T, ahead):
    there = np.clip(np.arange(len(T)) + ahead, 0, len(T) - 1)
    return T @ frames.exp(0.5 * frames.log(frames.inverse(T) @ T[there]))


def _rows_turned(rows):
    def change(R):
        angles = R.as_euler("ZYX")
        return Rotation.concatenate(
            [Rotation.from_euler("xyz" if v in rows else "ZYX", own) for v, own in enumerate(angles)]
        )

    return turned(change)


MISTAKES = {
    "inverse": (posed(frames.inverse), ("inverse",)),
    # Poses without joints: the other mount is the same as poses inverted.
    "mount": (lambda s: replace(s, mount=OTHER_MOUNT[s.mount]), ("inverse", "mount")),
    "KUKA angles as xyz": (turned(lambda R: Rotation.from_euler("xyz", R.as_euler("ZYX"))), ("euler",)),
    "fixed for moving axes": (turned(lambda R: Rotation.from_euler("XYZ", R.as_euler("xyz"))), ("euler",)),
    "ZYZ as ZXZ": (turned(lambda R: Rotation.from_euler("ZXZ", R.as_euler("ZYZ"))), ("euler",)),
    "rotation vector as angles": (turned(lambda R: Rotation.from_euler("xyz", R.as_rotvec())), ("euler",)),
    "radians as degrees": (turned(lambda R: Rotation.from_rotvec(R.as_rotvec() * np.pi / 180)), ("degrees",)),
    "w first": (turned(lambda R: Rotation.from_quat(R.as_quat()[:, [3, 0, 1, 2]])), ("quaternion",)),
    "turned the other way": (turned(lambda R: R.inv()), ("quaternion",)),
    "inches": (posed(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 25.4)), ("unit",)),
    "metres": (posed(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 1000)), ("unit",)),
    "scaled": (posed(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] * 1.05)), ("scale",)),
    "y, x, z": (posed(lambda T: frames.make(T[:, :3, :3], T[:, [1, 0, 2], 3])), ("mirrored",)),
    "z, x, y": (posed(lambda T: frames.make(T[:, :3, :3], T[:, [2, 0, 1], 3])), ("mirrored",)),
    "x negated": (posed(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] * [-1, 1, 1])), ("mirrored",)),
    "poses as text": (posed(lambda T: T[_as_text(len(T))]), ("shifted",)),
    "clouds as text": (posed(lambda T: T[np.argsort(_as_text(len(T)))]), ("shifted",)),
    "shifted by one": (posed(lambda T: np.roll(T, 1, axis=0)), ("shifted",)),
    "shifted by two": (posed(lambda T: np.roll(T, -2, axis=0)), ("shifted",)),
    "reversed": (posed(lambda T: T[::-1]), ("reversed",)),
    "x in inches": (_column(0, lambda x: x / 25.4), ("unit",)),
    "z in metres": (_column(2, lambda z: z / 1000), ("unit",)),
    "z stuck": (_column(2, lambda z: 0 * z + 412.5), ("scale",)),
    "y stuck": (_column(1, lambda y: 0 * y), ("scale",)),
    "half a row late": (posed(lambda T: _midway(T, -1)), ("shifted",)),
    "half a row early": (posed(lambda T: _midway(T, 1)), ("shifted",)),
    "half a row late by screws": (posed(lambda T: _midway_by_screws(T, -1)), ("shifted",)),
    "last rows in another order": (_rows_turned(range(5, 10)), ("euler",)),
    "first rows in another order": (_rows_turned(range(4)), ("euler",)),
    "two exchanged": (posed(_exchanged), ("exchanged",)),
}
