"""Mistakes that people make with the poses of a session: each mistake undone gives other poses.

Poses that are right after one of these changes, and only then, say which mistake was made.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.session.robot import forward
from stitch.session.session import Mount, SessionData

_AXES = "xyz"
_CORRECT_TABLE = "to fix: correct the table of poses"


def other_columns(position: Array) -> Iterator[tuple[str, Array]]:
    """Yield positions (V, 3) with permuted columns, then with one or two signs changed, and the mistake undone.

    All three with the other sign are a left-handed frame, of poses or of scans.
    """
    for order in permutations(range(3)):
        if order != (0, 1, 2):
            named = ", ".join(_AXES[i] for i in np.argsort(order))
            yield f"the columns of the positions are {named}, not x, y, z; {_CORRECT_TABLE}", position[:, order]
    for signs in product((1.0, -1.0), repeat=3):
        wrong = [axis for axis, sign in zip(_AXES, signs, strict=True) if sign < 0]
        if len(wrong) in (1, 2):
            have = "has" if len(wrong) == 1 else "have"
            yield f"{' and '.join(wrong)} of the positions {have} the wrong sign; {_CORRECT_TABLE}", position * signs


def other_units(position: Array, units: Mapping[float, str]) -> Iterator[tuple[str, Array]]:
    """Yield positions (V, 3) of which one column is in another unit than the rest, and what that undoes.

    Args:
        units: factors by which lengths may be too large, and how that comes about.
    """
    for column, axis in enumerate(_AXES):
        for factor, words in units.items():
            right = np.array(position)
            right[:, column] /= factor
            yield f"{axis} of the positions alone is in {words}; to fix: convert this column", right


# Orders of Euler angles are those of Diebel (2006), "Representing Attitude": six with three axes, six with two.
ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")


def other_quaternions(q: Array) -> Iterator[tuple[str, Rotation]]:
    """Yield readings (V, 4) x, y, z, w taken for another order."""
    yield "w, x, y, z, not x, y, z, w; to fix: rename them", Rotation.from_quat(q[:, [1, 2, 3, 0]])
    yield "x, y, z, w but were reordered as if w came first; to fix: undo that", Rotation.from_quat(q[:, [3, 0, 1, 2]])


def other_angles(R: Rotation) -> Iterator[tuple[str, Rotation]]:
    """Yield angles that were composed in one order and belong into another, columns by place or by axis."""
    for order in (*ORDERS, *(o.lower() for o in ORDERS)):
        angles = euler_angles(R, order)
        for right in (*ORDERS, *(o.lower() for o in ORDERS)):
            if right != order:
                yield _order_fix(order, right), Rotation.from_euler(right, angles)
        if len(set(order.upper())) == 3:
            for right in ORDERS[:6]:
                if right != order:
                    named = np.column_stack([angles[:, order.upper().index(axis)] for axis in right])
                    yield _order_fix(order, right), Rotation.from_euler(right, named)
        yield (
            "the angles are a rotation vector, not Euler angles; to fix: convert them as such",
            Rotation.from_rotvec(_shortest(angles)),
        )
    for right in (*ORDERS, *(o.lower() for o in ORDERS)):
        yield (
            f"the rotation vectors are Euler angles in the order {_order_name(right)}; to fix: convert them as such",
            Rotation.from_euler(right, R.as_rotvec()),
        )


def _order_fix(order: str, right: str) -> str:
    name = _order_name(right)
    return f"the Euler angles are {name}, not {_order_name(order)}; to fix: convert them as {name}"


def _order_name(order: str) -> str:
    """Capitals turn about the axes that turned already (intrinsic)."""
    return f"{order.lower()}-{'intrinsic' if order.isupper() else 'extrinsic'}"


def degrees_for_radians(R: Rotation) -> Iterator[tuple[str, Rotation]]:
    """Yield angles in radians that were taken for degrees."""
    words, fix = "the angles are radians, and were read as degrees", "to fix: convert them to degrees"
    yield f"{words}; {fix}", Rotation.from_rotvec(R.as_rotvec() * 180 / np.pi)
    for order in ORDERS:
        yield f"{words} ({_order_name(order)}); {fix}", Rotation.from_euler(order, euler_angles(R, order) * 180 / np.pi)


def _mixed_degrees(R: Rotation) -> Iterator[tuple[str, Rotation]]:
    """Yield angles of which one column is in radians and was read as degrees, like the others."""
    for order in (o for orders in (ORDERS[:6], [o.lower() for o in ORDERS[:6]]) for o in orders):
        angles = euler_angles(R, order)
        for k, axis in enumerate(order.lower()):
            right = np.array(angles)
            right[:, k] *= 180 / np.pi
            words = f"the angle about {axis} alone is in radians ({_order_name(order)})"
            yield f"{words}; to fix: convert this column to degrees", Rotation.from_euler(order, right)


def euler_angles(R: Rotation, order: str) -> Array:
    """Return angles (V, 3) in an order, rad."""
    with warnings.catch_warnings():
        # Gimbal lock sets an angle to zero: that reading is one of those to try.
        warnings.simplefilter("ignore")
        return np.asarray(R.as_euler(order))


def _shortest(angles: Array) -> Array:
    """Return the shorter of the two triples of angles that make one rotation: vectors are at most π long."""
    other = np.stack([angles[:, 0] - np.pi, np.pi - angles[:, 1], angles[:, 2] - np.pi], axis=1)
    other = (other + np.pi) % (2 * np.pi) - np.pi
    shorter = np.linalg.norm(other, axis=1) < np.linalg.norm(angles, axis=1)
    return np.where(shorter[:, None], other, angles)


# Factors by which lengths are too large when units are mixed up, and how that comes about.
UNITS = {
    1000.0: "mm where m are stated",
    0.001: "m where mm are stated",
    25.4: "mm where inches are stated",
    1 / 25.4: "inches where mm are stated",
    10.0: "mm where cm are stated",
    0.1: "cm where mm are stated",
}
# A fitted factor is one between units if it is this near, or within three sigmas and the second share. No scanner's and
# no arm's own scale is off by the last one.
_UNIT_NEAR, _UNIT_FAR, _LARGEST_SCALE = 0.05, 0.2, 1.25


def known_unit_ratio(scale: float, sigma: float = 0.0) -> float | None:
    """Return the factor of `UNITS` that a fitted scale is, None where it is none."""
    if scale <= 0:
        return None
    factor = min(UNITS, key=lambda u: abs(np.log(scale / u)))
    near = np.clip(3 * sigma / factor, _UNIT_NEAR, _UNIT_FAR)
    return factor if abs(scale / factor - 1) < near else None


def scale_text(scale: float, sigma: float = 0.0) -> str:
    """Return what a fitted factor between clouds and robot says, without the factor where lengths cannot differ so."""
    unit = known_unit_ratio(scale, sigma)
    if unit is not None or 1 / _LARGEST_SCALE <= scale <= _LARGEST_SCALE:
        factor = f"{scale:.5g}" if unit is None else f"{unit:.6g}"
        return f"the clouds are {factor} times as large as the robot's motions; to fix: check the scale of both"
    return (
        "The robot's positions do not explain how the scanner moved; its rotations do; to fix: is an axis missing "
        "(column E1), or a column mixed up?"
    )


_OTHER_MOUNT: dict[Mount, Mount] = {"eye_to_hand": "eye_in_hand", "eye_in_hand": "eye_to_hand"}
_HANDED = (
    "the scans, or the frames of the poses, are left-handed; to fix: look for two exchanged columns, or one with the "
    "wrong sign"
)
# Without motions that accuse some rows, each pair is tried among so many views: in more, two that are exchanged neither
# move a median nor a robust fit.
MOST_EXCHANGED = 24
_TEXT_ORDER = "the {} are sorted as text (1, 10, 11, 2, …), the {} by number; to fix: pair them by number"
# Rows that a list may be shifted by.
_SHIFTS = (1, -1, 2, -2, 3, -3)


@dataclass(frozen=True)
class Hypothesis:
    """Poses with one mistake undone."""

    kind: str  # as in `stitch check --deep`; "stated" for the poses as they are
    T_base_flange: Array  # (V, 4, 4) of the views that are tried
    mount: Mount
    fix: str
    rows: tuple[int, ...] = ()  # whose poses change places; empty: all
    used: tuple[int, ...] | None = None  # scans that still have a pose; None: all

    @property
    def T_reference_mount(self) -> Array:
        """(V, 4, 4) as the chain of frames takes them."""
        return frames.inverse(self.T_base_flange) if self.mount == "eye_to_hand" else self.T_base_flange


def stated_hypothesis(session: SessionData, rows: Indices | None = None) -> Hypothesis:
    """Return the poses as stated, of some rows or of all."""
    T = np.array([view.T_base_flange for view in session.views])
    return Hypothesis("stated", T if rows is None else T[rows], session.mount, "")


def hypotheses(
    session: SessionData, rows: Indices | None = None, exchangeable: Sequence[int] | None = None
) -> list[Hypothesis]:
    """Return the poses as stated, first, and with every mistake undone that can be undone.

    Args:
        rows: of the session that are tried; None: all.
        exchangeable: of these, views that may have changed places, by their index among them; None: of few views all.
    """
    every = np.arange(len(session.views)) if rows is None else rows
    stated = stated_hypothesis(session, rows)
    if exchangeable is None:
        exchangeable = range(len(every)) if len(every) <= MOST_EXCHANGED else ()
    out = [stated, *_joint_mistakes(session, every), *_pose_mistakes(stated)]
    return [*out, *_row_mistakes(session, every), *_exchanges(stated, exchangeable)]


def _joint_mistakes(session: SessionData, rows: Indices) -> Iterator[Hypothesis]:
    """Yield mistakes with joint angles, and with the mount, which they tell from inverted poses."""
    mount, robot, q = session.mount, session.robot, session.joints
    T = stated_hypothesis(session, rows).T_base_flange
    if robot is None or q is None:
        yield Hypothesis("inverse", frames.inverse(T), mount, _mount_or_inverse(mount))
        return
    q = q[rows]
    other = f'the scanner is not mounted as stated; to fix: set mount = "{_OTHER_MOUNT[mount]}" in session.toml'
    yield Hypothesis("mount", T, _OTHER_MOUNT[mount], other)
    for factor, words in ((180 / np.pi, "radians, not degrees"), (np.pi / 180, "degrees turned twice")):
        fix = f"the joint angles are {words}; to fix: convert them"
        yield Hypothesis("degrees", forward(robot, q * factor), mount, fix)
    if not np.allclose(forward(robot, q), T, rtol=0, atol=1e-6 * np.abs(T).max()):
        # The poses were not taken from the joints.
        return
    for kind, by, fix in _joint_changes(q.shape[1]):
        yield Hypothesis(kind, forward(robot, q @ by.T), mount, fix)


def _joint_changes(joints: int) -> Iterator[tuple[str, Array, str]]:
    """Yield kind, matrix on the angles and fix of joints that count otherwise than the robot's description."""
    names = [f"j{j + 1}" for j in range(joints)]
    for turned in (*combinations(range(joints), 1), *combinations(range(joints), 2)):
        by = np.diag([-1.0 if j in turned else 1.0 for j in range(joints)])
        named, counts = " and ".join(names[j] for j in turned), "counts" if len(turned) == 1 else "count"
        yield "joint_sign", by, f"{named} {counts} the other way; to fix: negate {named} in views.csv"
    for j in range(joints):
        by = np.eye(joints)
        by[j, j] = 180 / np.pi
        yield "degrees", by, f"{names[j]} alone is in radians; to fix: convert this column to degrees"
    if joints > 2:
        for sign, words in ((1.0, "+"), (-1.0, "-")):
            by = np.eye(joints)
            by[2, 1] = sign
            fix = f"j3 is shown as it moves with j2; to fix: write j3 {words} j2 in place of j3 in views.csv"
            yield "joint_coupling", by, fix


def _pose_mistakes(stated: Hypothesis) -> Iterator[Hypothesis]:
    """Yield mistakes that change all poses in the same way."""
    T, mount = stated.T_base_flange, stated.mount
    position, R = T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3])
    transposed = frames.make(R.inv().as_matrix(), position)
    yield Hypothesis("quaternion", transposed, mount, "the quaternions turn the other way; to fix: negate qx, qy, qz")
    for name, q in other_quaternions(R.as_quat()):
        yield Hypothesis(
            "quaternion", frames.make(q.as_matrix(), position), mount, f"the quaternion columns are {name}"
        )
    for name, turned in other_angles(R):
        yield Hypothesis("euler", frames.make(turned.as_matrix(), position), mount, name)
    for name, turned in (*degrees_for_radians(R), *_mixed_degrees(R)):
        yield Hypothesis("degrees", frames.make(turned.as_matrix(), position), mount, name)
    flip = np.diag([-1.0, 1, 1])
    yield Hypothesis("mirrored", frames.make(flip @ T[:, :3, :3] @ flip, position @ flip), mount, _HANDED)
    for name, moved in other_columns(position):
        yield Hypothesis("mirrored", frames.make(T[:, :3, :3], moved), mount, name)
    for name, moved in other_units(position, UNITS):
        yield Hypothesis("unit", frames.make(T[:, :3, :3], moved), mount, name)
    still = np.broadcast_to(np.eye(4), T.shape)
    yield Hypothesis(
        "mount",
        still,
        mount,
        "the clouds stand in one common frame already, or show mostly a wall or a table before the scanner; to fix: "
        "export them in the scanner's frame, or cut the background away (within, under [scanner])",
    )


def _mount_or_inverse(mount: Mount) -> str:
    return (
        "the poses are T_flange_base, or the mount is not as stated (the size of the hand-eye shows which); to fix: "
        f'invert the poses, or set mount = "{_OTHER_MOUNT[mount]}" in session.toml'
    )


def _row_mistakes(session: SessionData, rows: Indices) -> Iterator[Hypothesis]:
    """Yield poses that belong to other rows, for all views alike."""
    T, mount, V = stated_hypothesis(session).T_base_flange, session.mount, len(session.views)
    yield Hypothesis("reversed", T[::-1][rows], mount, "the poses are in reverse order; to fix: turn the list around")
    for first in (0, 1):
        as_text = np.argsort([str(v + first) for v in range(V)])
        yield Hypothesis("shifted", T[as_text][rows], mount, _TEXT_ORDER.format("clouds", "poses"))
        yield Hypothesis("shifted", T[np.argsort(as_text)][rows], mount, _TEXT_ORDER.format("poses", "clouds"))
    for by in (by for by in _SHIFTS if abs(by) < V - 2):
        used = np.flatnonzero((rows + by >= 0) & (rows + by < V))
        where, plural = "below" if by > 0 else "above", "s" * (abs(by) > 1)
        fix = f"every cloud belongs to the pose {abs(by)} row{plural} {where} it; to fix: shift the column back"
        yield Hypothesis("shifted", np.roll(T, -by, axis=0)[rows], mount, fix, (), tuple(used.tolist()))


def _exchanges(stated: Hypothesis, exchangeable: Sequence[int]) -> Iterator[Hypothesis]:
    """Yield the poses with two of some views exchanged."""
    fix = "the clouds of two rows are exchanged; to fix: exchange the clouds of these rows"
    for a, b in combinations(exchangeable, 2):
        order = np.arange(len(stated.T_base_flange))
        order[[a, b]] = [b, a]
        yield replace(stated, kind="exchanged", T_base_flange=stated.T_base_flange[order], fix=fix, rows=(a, b))


def distinct(found: Sequence[Hypothesis], angle: float, length: float) -> list[Hypothesis]:
    """Return hypotheses whose relative motions differ, the first of each kind kept."""
    kept, signs = list[Hypothesis](), np.empty((len(found), 0))
    for h in found:
        relative = frames.inverse(h.T_reference_mount[:1]) @ h.T_reference_mount[1:]
        # A motion at a time, so that few of them part most hypotheses.
        sign = np.concatenate([relative[:, :3, :3].reshape(-1, 9) / angle, relative[:, :3, 3] / length], axis=1).ravel()
        if not signs.size:
            signs = np.empty((len(found), len(sign)))
        alike = np.flatnonzero(np.abs(signs[: len(kept), :12] - sign[:12]).max(axis=1, initial=0.0) < 1)
        if h.used is None and (np.abs(signs[alike] - sign).max(axis=1) < 1).any():
            continue
        signs[len(kept)] = sign
        kept.append(h)
    return kept
