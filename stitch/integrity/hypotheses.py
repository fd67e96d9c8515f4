"""What people do wrong with the poses of a session, written out: each mistake undone gives other poses.

Poses that are right after one of these changes, and only then, say which mistake was made.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array, Indices
from stitch.integrity.misread_positions import other_columns, other_units
from stitch.integrity.misread_rotations import degrees_for_radians, other_angles, other_quaternions
from stitch.measurement.robot import forward
from stitch.measurement.session import Mount, Session

# Factors by which lengths are too large when units are mixed up, and how that comes about.
UNITS = {
    1000.0: "mm where m are stated",
    0.001: "m where mm are stated",
    25.4: "mm where inches are stated",
    1 / 25.4: "inches where mm are stated",
    10.0: "mm where cm are stated",
    0.1: "cm where mm are stated",
}
_OTHER_MOUNT: dict[Mount, Mount] = {"eye_to_hand": "eye_in_hand", "eye_in_hand": "eye_to_hand"}
_HANDED = "the scans, or the frames of the poses, are left-handed: two columns are exchanged, or one has the wrong sign"
_TEXT_ORDER = "the {} are in the order of numbers as text (1, 10, 11, 2, …), the {} in that of numbers: pair by number"
# Rows that a list may be shifted by.
_SHIFTS = (1, -1, 2, -2, 3, -3)


@dataclass(frozen=True)
class Hypothesis:
    """Poses with one mistake undone."""

    kind: str  # as in `stitch check --deep`; "stated" for the poses as they are
    T_base_flange: Array  # (V, 4, 4)
    mount: Mount
    fix: str
    rows: tuple[int, ...] = ()  # whose poses change places; empty: all
    used: tuple[int, ...] | None = None  # scans that still have a pose; None: all

    @property
    def T_reference_mount(self) -> Array:
        """(V, 4, 4) as the chain of frames takes them."""
        return frames.inverse(self.T_base_flange) if self.mount == "eye_to_hand" else self.T_base_flange


def hypotheses(session: Session) -> list[Hypothesis]:
    """The poses as stated, first, and with every mistake undone that can be undone."""
    T = np.array([view.T_base_flange for view in session.views])
    mount = session.mount
    out = [Hypothesis("stated", T, mount, "")]
    out += _session_mistakes(session, T)
    out += _row_mistakes(T, mount)
    return out


def _session_mistakes(session: Session, T: Array) -> Iterator[Hypothesis]:
    """Mistakes that change all poses alike."""
    mount, joints = session.mount, [view.joints for view in session.views]
    robot = session.robot
    known = robot is not None and all(q is not None for q in joints)
    other = f'set mount = "{_OTHER_MOUNT[mount]}" in session.toml'
    if known:
        yield Hypothesis("mount", T, _OTHER_MOUNT[mount], other)
        q = np.array(joints)
        assert robot is not None
        for factor, words in ((180 / np.pi, "radians, not degrees"), (np.pi / 180, "degrees turned twice")):
            yield Hypothesis(
                "degrees", forward(robot, q * factor), mount, f"the joint angles are {words}: convert them"
            )
    else:
        yield Hypothesis("inverse", frames.inverse(T), mount, _mount_or_inverse(mount))
    position, R = T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3])
    transposed = frames.make(R.inv().as_matrix(), position)
    yield Hypothesis("quaternion", transposed, mount, "the quaternions turn the other way: negate qx, qy, qz")
    for name, q in other_quaternions(R.as_quat()):
        yield Hypothesis(
            "quaternion", frames.make(q.as_matrix(), position), mount, f"the quaternion columns are {name}"
        )
    for name, turned in other_angles(R):
        yield Hypothesis("euler", frames.make(turned.as_matrix(), position), mount, name)
    for name, turned in degrees_for_radians(R):
        yield Hypothesis("degrees", frames.make(turned.as_matrix(), position), mount, name)
    flip = np.diag([-1.0, 1, 1])
    yield Hypothesis("mirrored", frames.make(flip @ T[:, :3, :3] @ flip, position @ flip), mount, _HANDED)
    for name, moved in other_columns(position):
        yield Hypothesis("mirrored", frames.make(T[:, :3, :3], moved), mount, f"{name}: correct the table of poses")
    for name, moved in other_units(position, UNITS):
        yield Hypothesis("unit", frames.make(T[:, :3, :3], moved), mount, name)
    still = np.broadcast_to(np.eye(4), T.shape)
    yield Hypothesis(
        "mount",
        still,
        mount,
        "the clouds stand in one common frame already: export them as the scanner sees them; or most of them shows "
        "what stands still before the scanner, a wall or a table: cut it away (within, under [scanner])",
    )


def _mount_or_inverse(mount: Mount) -> str:
    return (
        f'the poses are T_flange_base: invert them; if they are not, set mount = "{_OTHER_MOUNT[mount]}" in session.toml '
        "(these scans cannot tell the two apart, the size of the hand-eye can)"
    )


def _row_mistakes(T: Array, mount: Mount) -> Iterator[Hypothesis]:
    """Poses that belong to other rows."""
    V = len(T)
    index = np.arange(V)
    yield Hypothesis("reversed", T[::-1], mount, "the poses are in reverse order: turn the list around")
    for first in (0, 1):
        as_text = np.argsort([str(v + first) for v in range(V)])
        yield Hypothesis("shifted", T[as_text], mount, _TEXT_ORDER.format("clouds", "poses"))
        yield Hypothesis("shifted", T[np.argsort(as_text)], mount, _TEXT_ORDER.format("poses", "clouds"))
    for by in _SHIFTS:
        if abs(by) < V - 2:
            kept = index[(index + by >= 0) & (index + by < V)]
            yield _shifted(T, mount, by, kept)
    for a, b in combinations(range(V), 2):
        order = index.copy()
        order[[a, b]] = [b, a]
        yield Hypothesis("exchanged", T[order], mount, "exchange the clouds of these rows", (a, b))


def _shifted(T: Array, mount: Mount, by: int, kept: Indices) -> Hypothesis:
    where = "below" if by > 0 else "above"
    fix = f"every cloud belongs to the pose {abs(by)} row{'s' * (abs(by) > 1)} {where} it: shift the column back"
    return Hypothesis("shifted", np.roll(T, -by, axis=0), mount, fix, (), tuple(int(v) for v in kept))


def distinct(found: Sequence[Hypothesis], angle: float, length: float) -> list[Hypothesis]:
    """Hypotheses whose relative motions differ, the first of each kind kept."""
    kept: list[Hypothesis] = []
    signs: list[Array] = []
    for h in found:
        relative = frames.inverse(h.T_reference_mount[:1]) @ h.T_reference_mount[1:]
        sign = np.concatenate([relative[:, :3, :3].reshape(-1) / angle, relative[:, :3, 3].reshape(-1) / length])
        if h.used is None and any(np.abs(sign - other).max() < 1 for other in signs):
            continue
        kept.append(h)
        signs.append(sign)
    return kept
