"""Mistakes put into a good session in memory, each with what a check may call it and whom it has to name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.session.robot import forward
from stitch.session.session import Cloud, SessionData

Array = NDArray[np.float64]
_OTHER = {"eye_to_hand": "eye_in_hand", "eye_in_hand": "eye_to_hand"}


@dataclass(frozen=True)
class Fault:
    """A mistake: what it does to a session, its accepted kinds, and the views of which one must be named."""

    apply: Callable[[SessionData], SessionData]
    kinds: tuple[str, ...]
    views: tuple[int, ...] = ()  # empty: the whole session


def poses_of(session: SessionData) -> Array:
    """(V, 4, 4)."""
    return np.array([view.T_base_flange for view in session.views])


def with_poses(session: SessionData, T: Array) -> SessionData:
    """The session with other poses and no joints."""
    views = zip(session.views, T, strict=True)
    return replace(session, views=tuple(replace(view, T_base_flange=pose, joints=None) for view, pose in views))


def with_clouds(session: SessionData, clouds: dict[int, Array]) -> SessionData:
    """The session with other points in some views."""
    views = enumerate(session.views)
    return replace(session, views=tuple(replace(w, cloud=Cloud(clouds[v])) if v in clouds else w for v, w in views))


def shown(session: SessionData, v: int) -> Array:
    """(N, 3) points of one view."""
    cloud = session.views[v].cloud
    assert cloud is not None
    return cloud.points


def displaced(twists: dict[int, Array]) -> Callable[[SessionData], SessionData]:
    """Poses of some views with a right twist of the flange (rad, mm)."""

    def apply(session: SessionData) -> SessionData:
        T = poses_of(session)
        for v, twist in twists.items():
            T[v] = T[v] @ frames.exp(twist)
        return with_poses(session, T)

    return apply


def moved_clouds(order: dict[int, int]) -> Callable[[SessionData], SessionData]:
    """The cloud of view `order[v]` in the row of v."""
    return lambda session: with_clouds(session, {v: shown(session, w) for v, w in order.items()})


def turned(change: Callable[[Rotation], Rotation]) -> Callable[[SessionData], SessionData]:
    """Rotations of all poses rewritten."""

    def apply(session: SessionData) -> SessionData:
        T = poses_of(session)
        return with_poses(session, frames.make(change(Rotation.from_matrix(T[:, :3, :3])).as_matrix(), T[:, :3, 3]))

    return apply


def _torn(points: Array, shift: Array) -> Array:
    """Half of a scan moved: the part was knocked while it was scanned."""
    later = points[:, 0] > np.median(points[:, 0])
    return points + later[:, None] * shift


def _rows(order: Callable[[Array], Array]) -> Callable[[SessionData], SessionData]:
    return lambda session: with_poses(session, order(poses_of(session)))


def _clouds(
    change: Callable[[Array], Array], views: Sequence[int] | None = None
) -> Callable[[SessionData], SessionData]:
    def apply(session: SessionData) -> SessionData:
        those = range(len(session.views)) if views is None else views
        return with_clouds(session, {v: change(shown(session, v)) for v in those})

    return apply


def _joints(change: Callable[[SessionData], Array], v: int) -> Callable[[SessionData], SessionData]:
    def apply(session: SessionData) -> SessionData:
        assert session.robot is not None
        views = list(session.views)
        q = change(session)
        views[v] = replace(views[v], joints=q, T_base_flange=forward(session.robot, q))
        return replace(session, views=tuple(views))

    return apply


def _reclamped(start: int, twist: Array) -> Callable[[SessionData], SessionData]:
    def apply(session: SessionData) -> SessionData:
        T, K = poses_of(session), frames.exp(twist)
        # The part moves on the flange, or the flange's poses are off by a motion of the base frame.
        T[start:] = T[start:] @ K if session.mount == "eye_to_hand" else K @ T[start:]
        return with_poses(session, T)

    return apply


def in_base_frame(T_reference_scanner: Array) -> Fault:
    """All clouds in the reference frame already."""

    def apply(session: SessionData) -> SessionData:
        return with_clouds(
            session, {v: frames.transform(T, shown(session, v)) for v, T in enumerate(T_reference_scanner)}
        )

    return Fault(apply, ("mount",))


def faults(views: int, rng: np.random.Generator) -> dict[str, Fault]:
    """The table: name to fault."""
    a, b, c = (int(v) for v in rng.permutation(views)[:3])
    u = rng.standard_normal(3)
    u /= np.linalg.norm(u)
    none = np.zeros(3)
    shift = lambda d: np.r_[none, d * u]  # noqa: E731
    plane = np.c_[rng.uniform(-40, 40, (2500, 2)), np.zeros(2500)]
    wavy = plane + np.c_[np.zeros((2500, 2)), 420 + 9 * np.sin(plane[:, 0] / 7) + 0.02 * rng.standard_normal(2500)]
    one, pose = ("displaced",), ("displaced", "duplicate_pose", "joint_row")
    next_row = max(a - 1, 0) if a else 1
    table: dict[str, Fault] = {
        f"shift {d} mm": Fault(displaced({a: shift(d)}), one, (a,)) for d in (0.2, 1.0, 5.0, 60.0)
    }
    table |= {
        "turn 2 deg": Fault(displaced({a: np.r_[np.radians(2) * u, none]}), one, (a,)),
        "two shifted 5 mm": Fault(displaced({a: shift(5.0), b: shift(-5.0)}), one, (a, b)),
        "three shifted 1 mm": Fault(displaced({a: shift(1.0), b: shift(-1.0), c: shift(1.0)}), one, (a, b, c)),
        "two exchanged": Fault(moved_clouds({a: b, b: a}), ("exchanged",), (a, b)),
        "three exchanged": Fault(moved_clouds({a: b, b: c, c: a}), ("exchanged",), (a, b, c)),
        "shifted by 1": Fault(_rows(lambda T: np.roll(T, 1, axis=0)), ("shifted",)),
        "shifted by -2": Fault(_rows(lambda T: np.roll(T, -2, axis=0)), ("shifted",)),
        "reversed": Fault(_rows(lambda T: T[::-1]), ("reversed",)),
        "inverse": Fault(_rows(frames.inverse), ("inverse", "mount")),
        "mount": Fault(lambda s: replace(s, mount=_OTHER[s.mount]), ("mount", "inverse")),
        "euler ZYX as xyz": Fault(turned(lambda R: Rotation.from_euler("xyz", R.as_euler("ZYX"))), ("euler",)),
        "euler XYZ as ZYX": Fault(turned(lambda R: Rotation.from_euler("ZYX", R.as_euler("XYZ"))), ("euler",)),
        "euler xyz as XYZ": Fault(turned(lambda R: Rotation.from_euler("XYZ", R.as_euler("xyz"))), ("euler",)),
        "rotation vector as xyz": Fault(turned(lambda R: Rotation.from_euler("xyz", R.as_rotvec())), ("euler",)),
        "radians as degrees": Fault(turned(lambda R: Rotation.from_rotvec(R.as_rotvec() * np.pi / 180)), ("degrees",)),
        "quaternion w first": Fault(
            turned(lambda R: Rotation.from_quat(R.as_quat()[:, [3, 0, 1, 2]])), ("quaternion",)
        ),
        "quaternion conjugate": Fault(turned(lambda R: R.inv()), ("quaternion",)),
        "poses in inches": Fault(_rows(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 25.4)), ("unit",)),
        "poses in m": Fault(_rows(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 1000)), ("unit",)),
        "clouds scaled 1.0254": Fault(_clouds(lambda p: p * 1.0254), ("scale",)),
        "clouds mirrored": Fault(_clouds(lambda p: p * [-1, 1, 1]), ("mirrored",)),
        "one scaled 1.0254": Fault(_clouds(lambda p: p * 1.0254, [a]), ("scale",), (a,)),
        "one in inches": Fault(_clouds(lambda p: p / 25.4, [a]), ("unit",), (a,)),
        "one mirrored": Fault(_clouds(lambda p: p * [-1, 1, 1], [a]), ("mirrored",), (a,)),
        "other part": Fault(_clouds(lambda p: wavy, [a]), ("foreign",), (a,)),
        "three points": Fault(_clouds(lambda p: p[:: len(p) // 2][:3], [a]), ("foreign",), (a,)),
        "a line": Fault(_clouds(lambda p: np.linspace(p[0], p[-1], 400), [a]), ("foreign",), (a,)),
        "one torn 1 mm": Fault(_clouds(lambda p: _torn(p, u), [a]), one, (a,)),
        "one torn 5 mm": Fault(_clouds(lambda p: _torn(p, 5 * u), [a]), one, (a,)),
        "copy of a scan": Fault(moved_clouds({a: b}), ("duplicate_scan",), (a,)),
        "copy of a pose": Fault(
            _rows(lambda T: np.concatenate([T[:a], T[b : b + 1], T[a + 1 :]])), ("duplicate_pose", "joint_row"), (a,)
        ),
        "neighbour's joints": Fault(_joints(lambda s: np.array(s.views[next_row].joints), a), pose[1:], (a,)),
        "digit of a joint": Fault(_joints(lambda s: s.views[a].joints + np.radians(10) * np.eye(6)[2], a), pose, (a,)),
        "re-clamped half way": Fault(_reclamped(views // 2, np.r_[0.1, 0.08, -0.07, 4, 4, 3.5]), ("reclamped",)),
        "re-clamped late": Fault(_reclamped(views - 4, np.r_[0.03, -0.02, 0.01, 1.0, -2.0, 1.0]), ("reclamped",)),
    }  # fmt: skip
    return table
