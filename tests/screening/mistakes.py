"""Mistakes with the poses of a session: what they do, and what they may be called."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames

_OTHER = {"eye_to_hand": "eye_in_hand", "eye_in_hand": "eye_to_hand"}


def with_poses(session, T):
    """The session with other flange poses (V, 4, 4) and no joints."""
    views = zip(session.views, T, strict=True)
    return replace(session, views=tuple(replace(v, T_base_flange=pose, joints=None) for v, pose in views))


def _of(change):
    return lambda session: with_poses(session, change(np.array([v.T_base_flange for v in session.views])))


def _turned(change):
    return _of(lambda T: frames.make(change(Rotation.from_matrix(T[:, :3, :3])).as_matrix(), T[:, :3, 3]))


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

    return _of(apply)


def _midway(T, ahead):
    """Poses interpolated to half a step: turned evenly, moved along lines; the last one has no neighbour."""
    there = np.clip(np.arange(len(T)) + ahead, 0, len(T) - 1)
    R = Rotation.from_matrix(T[:, :3, :3])
    turned = R * Rotation.from_rotvec(0.5 * (R.inv() * R[there]).as_rotvec())
    return frames.make(turned.as_matrix(), (T[:, :3, 3] + T[there, :3, 3]) / 2)


def _midway_by_screws(T, ahead):
    there = np.clip(np.arange(len(T)) + ahead, 0, len(T) - 1)
    return T @ frames.exp(0.5 * frames.log(frames.inverse(T) @ T[there]))


def _rows_turned(rows):
    def change(R):
        angles = R.as_euler("ZYX")
        return Rotation.concatenate(
            [Rotation.from_euler("xyz" if v in rows else "ZYX", own) for v, own in enumerate(angles)]
        )

    return _turned(change)


MISTAKES = {
    "inverse": (_of(frames.inverse), ("inverse",)),
    # Poses without joints: the other mount is the same as poses inverted.
    "mount": (lambda s: replace(s, mount=_OTHER[s.mount]), ("inverse", "mount")),
    "KUKA angles as xyz": (_turned(lambda R: Rotation.from_euler("xyz", R.as_euler("ZYX"))), ("euler",)),
    "fixed for moving axes": (_turned(lambda R: Rotation.from_euler("XYZ", R.as_euler("xyz"))), ("euler",)),
    "ZYZ as ZXZ": (_turned(lambda R: Rotation.from_euler("ZXZ", R.as_euler("ZYZ"))), ("euler",)),
    "rotation vector as angles": (_turned(lambda R: Rotation.from_euler("xyz", R.as_rotvec())), ("euler",)),
    "radians as degrees": (_turned(lambda R: Rotation.from_rotvec(R.as_rotvec() * np.pi / 180)), ("degrees",)),
    "w first": (_turned(lambda R: Rotation.from_quat(R.as_quat()[:, [3, 0, 1, 2]])), ("quaternion",)),
    "turned the other way": (_turned(lambda R: R.inv()), ("quaternion",)),
    "inches": (_of(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 25.4)), ("unit",)),
    "metres": (_of(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 1000)), ("unit",)),
    "scaled": (_of(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] * 1.05)), ("scale",)),
    "y, x, z": (_of(lambda T: frames.make(T[:, :3, :3], T[:, [1, 0, 2], 3])), ("mirrored",)),
    "z, x, y": (_of(lambda T: frames.make(T[:, :3, :3], T[:, [2, 0, 1], 3])), ("mirrored",)),
    "x negated": (_of(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] * [-1, 1, 1])), ("mirrored",)),
    "poses as text": (_of(lambda T: T[_as_text(len(T))]), ("shifted",)),
    "clouds as text": (_of(lambda T: T[np.argsort(_as_text(len(T)))]), ("shifted",)),
    "shifted by one": (_of(lambda T: np.roll(T, 1, axis=0)), ("shifted",)),
    "shifted by two": (_of(lambda T: np.roll(T, -2, axis=0)), ("shifted",)),
    "reversed": (_of(lambda T: T[::-1]), ("reversed",)),
    "x in inches": (_column(0, lambda x: x / 25.4), ("unit",)),
    "z in metres": (_column(2, lambda z: z / 1000), ("unit",)),
    "z stuck": (_column(2, lambda z: 0 * z + 412.5), ("scale",)),
    "y stuck": (_column(1, lambda y: 0 * y), ("scale",)),
    "half a row late": (_of(lambda T: _midway(T, -1)), ("shifted",)),
    "half a row early": (_of(lambda T: _midway(T, 1)), ("shifted",)),
    "half a row late by screws": (_of(lambda T: _midway_by_screws(T, -1)), ("shifted",)),
    "last rows in another order": (_rows_turned(range(5, 10)), ("euler",)),
    "first rows in another order": (_rows_turned(range(4)), ("euler",)),
    "two exchanged": (_of(_exchanged), ("exchanged",)),
}
