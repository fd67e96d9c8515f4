"""A taught point, and how each controller writes an orientation. Lengths in mm, angles in rad.

A pose as the numbers of each controller. Among numbers that mean the same pose those nearest to the ones before are
taken, so that a target that hardly moves hardly changes.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array

# cos B below which A and C turn about the same axis, and one of them is free (rad).
_LOCKED = 1e-6
_FEWEST_JOINTS = 4
Span = tuple[int, int]  # begin and end in a text
# What stands between commas, without the space around it.
CELL = re.compile(r"[^,\s](?:[^,]*[^,\s])?")


def zyx_numbers(T: Array, near: Array | None = None) -> Array:
    """(6,) KUKA X, Y, Z in mm, A, B, C in degrees, of a pose (4, 4) in mm."""
    return np.append(T[:3, 3], np.degrees(_zyx(T[:3, :3], None if near is None else np.radians(near[3:6]))))


def fixed_xyz_numbers(T: Array, near: Array | None = None) -> Array:
    """(6,) FANUC X, Y, Z in mm, W, P, R in degrees: the same three turns as KUKA's, written the other way round."""
    return np.append(T[:3, 3], np.degrees(_zyx(T[:3, :3], None if near is None else np.radians(near[5:2:-1])))[::-1])


def quaternion_w_first_numbers(T: Array, near: Array | None = None) -> Array:
    """(7,) ABB x, y, z in mm, q1 … q4 with q1 = w; w not negative, or the sign nearest to the one before."""
    q = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)[[3, 0, 1, 2]]
    return np.append(T[:3, 3], q if near is None or q @ near[3:7] >= 0 else -q)


def rotation_vector_numbers(T: Array, near: Array | None = None) -> Array:
    """(6,) UR x, y, z in m, rotation vector in rad, of a pose (4, 4) in mm."""
    r = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(r))
    if near is not None and angle > 0:
        # The same turn about the opposite direction, and whole turns more.
        same = [r * (1 + 2 * np.pi * k / angle) for k in (-2, -1, 0, 1)]
        r = min(same, key=lambda v: float(np.linalg.norm(v - near[3:6])))
    return np.append(T[:3, 3] / 1000, r)


NUMBERS: dict[str, Callable[..., Array]] = {
    "kuka": zyx_numbers,
    "fanuc": fixed_xyz_numbers,
    "abb": quaternion_w_first_numbers,
    "ur": rotation_vector_numbers,
    "yaskawa": fixed_xyz_numbers,
}


def _zyx(R: Array, near: Array | None) -> Array:
    """(a, b, c) rad with R = Rz(a)·Ry(b)·Rx(c)."""
    b = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if np.hypot(R[0, 0], R[1, 0]) < _LOCKED:
        # Only a ∓ c counts: c stays what it was.
        c = 0.0 if near is None else float(near[2])
        rest = R @ Rotation.from_euler("x", -c).as_matrix()
        return np.array([np.arctan2(-rest[0, 1], rest[1, 1]), b, c])
    first = np.array([np.arctan2(R[1, 0], R[0, 0]), b, np.arctan2(R[2, 1], R[2, 2])])
    if near is None:
        return first
    # Both ways to write the rotation, less whole turns.
    both = np.array([first, [first[0] + np.pi, np.pi - b, first[2] + np.pi]])
    off = (both - near + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(near + min(off, key=lambda own: float(np.linalg.norm(own))))


@dataclass(frozen=True)
class WrittenNumber:
    """A number as a program has it, and where."""

    value: float
    span: Span


@dataclass(frozen=True)
class TaughtPoint:
    """One point of a program: a pose, joint angles, or both."""

    name: str
    line: int
    T_frame_tool: Array | None  # (4, 4) of the tool in the frame in which it was taught
    joints: Array | None  # (n,) rad
    frame: str = ""  # frame and tool in force, in the controller's words; empty where the file does not say
    pose_at: tuple[Span, ...] = ()  # where the pose's numbers stand, in the controller's order
    joints_at: tuple[Span, ...] = ()  # where the joint angles stand
    file: Path | None = None  # in which they stand, where it is not the program itself
    moved_by: str = ""  # an external axis that is not at zero
    is_target: bool = True  # False for a frame that may be a tool or a base, and for a pose that nothing moves to


def fixed_xyz(numbers: Array) -> Array:
    """FANUC x, y, z, W, P, R (mm, deg): turn by W about the fixed x, by P about y, by R about z: Rz(R)·Ry(P)·Rx(W)."""
    return frames.make(Rotation.from_euler("xyz", numbers[3:6], degrees=True).as_matrix(), numbers[:3])


def zyx(numbers: Array) -> Array:
    """KUKA X, Y, Z, A, B, C (mm, deg): turn by A about z, B about the new y, C about the new x: Rz(A)·Ry(B)·Rx(C)."""
    return frames.make(Rotation.from_euler("ZYX", numbers[3:6], degrees=True).as_matrix(), numbers[:3])


def quaternion_w_first(numbers: Array) -> Array:
    """(4, 4) of ABB x, y, z, q1, q2, q3, q4 (mm): q1 is w.

    Raises:
        ValueError: not a unit quaternion.
    """
    return pose_from_quaternion(np.asarray(numbers[:3], float), np.asarray(numbers, float)[[4, 5, 6, 3]])


def pose_from_quaternion(position: Array, quaternion: Array) -> Array:
    """Pose (4, 4) from a position (3,) and a unit quaternion (4,), w last.

    Raises:
        ValueError: not a unit quaternion.
    """
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-3:
        raise ValueError(f"quaternion of length {norm:.4f}, not a rotation; to fix: write or export it with length 1")
    return frames.from_quaternion(position, quaternion / norm)


def rotation_vector(numbers: Array) -> Array:
    """UR x, y, z, rx, ry, rz (m, rad): turn by the vector's length about its direction."""
    numbers = np.asarray(numbers, float)
    return frames.make(Rotation.from_rotvec(numbers[3:6]).as_matrix(), numbers[:3] * 1000)


def taught_point(
    name: str,
    line: int,
    fields: Mapping[str, WrittenNumber],
    axes: str,
    pose: Callable[[Array], Array],
    *,
    joint: str,
    frame: str = "",
) -> TaughtPoint | None:
    """Return a point with the pose from the fields named by `axes`, else the joint angles from fields joint1, joint2, …

    Args:
        pose: of the numbers of these fields.
        frame: in force when the point was taught.

    Returns:
        None where neither is complete.
    """
    moved_by = ", ".join(f"{key} {w.value:g}" for key, w in fields.items() if key.startswith("E") and w.value)
    if all(axis in fields for axis in axes):
        own = [fields[axis] for axis in axes]
        T_frame_tool = pose(np.array([number.value for number in own]))
        spans = tuple(number.span for number in own)
        return TaughtPoint(name, line, T_frame_tool, None, frame, pose_at=spans, moved_by=moved_by)
    own = [fields[f"{joint}{i}"] for i in range(1, 10) if f"{joint}{i}" in fields]
    if len(own) < _FEWEST_JOINTS:
        return None
    joints = np.radians([number.value for number in own])
    return TaughtPoint(name, line, None, joints, frame, joints_at=tuple(number.span for number in own))


def program_text(file: Path) -> str:
    """Return a program's text, of which `program_bytes` makes the same bytes: ends of lines, whatever encoding."""
    return file.read_bytes().decode("utf-8", errors="surrogateescape")


def program_bytes(text: str) -> bytes:
    """Return the bytes of a program's text."""
    return text.encode("utf-8", errors="surrogateescape")


def without_comments(text: str, mark: str) -> str:
    """Return a text with its comments, from the mark to the end of the line, blanked: positions stay."""
    return re.sub(rf"{mark}[^\n]*", lambda match: " " * len(match[0]), text)


def line_of(text: str, position: int) -> int:
    """Return the line number, from 1, of a position in a text."""
    return text.count("\n", 0, position) + 1
