"""Frames of ROS chained: what tf recorded between parents and children, interpolated in time."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array

# An edge moves if it turns (rad) or shifts (m) by more between its recordings.
_STATIC_TURN, _STATIC_SHIFT = 1e-4, 1e-4
# Recordings this long (s) before or after a moment still say where things were.
_MAX_TRANSFORM_AGE = 0.5
_LONGEST = 200


@dataclass
class _TreeEdge:
    parent: str
    times: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)  # T_parent_child, m
    static: bool = False


# Time, parent, child, T_parent_child (4, 4), whether published as fixed.
Recording = tuple[float, str, str, Array, bool]


class TransformTree:
    """Child to parent, with every recording of each edge; lengths in m, times in s."""

    def __init__(self, recordings: Iterable[Recording]) -> None:
        """Sort recordings by edge."""
        self._edges: dict[str, _TreeEdge] = {}
        for time, parent, child, T, static in recordings:
            edge = self._edges.setdefault(child, _TreeEdge(parent))
            # What is published as fixed, or under another parent later, replaces what was said before.
            if static or parent != edge.parent:
                edge = self._edges[child] = _TreeEdge(parent, static=static)
            edge.times.append(time)
            edge.poses.append(T)
        for edge in self._edges.values():
            order = np.argsort(edge.times, kind="stable")
            edge.times = [edge.times[i] for i in order]
            edge.poses = [edge.poses[i] for i in order]

    @property
    def still(self) -> bool:
        """True if no frame moves."""
        return not any(self.moves(child) for child in self._edges)

    @property
    def names(self) -> list[str]:
        """All frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def above(self, frame: str) -> list[str]:
        """A frame, its parent, and so on up to the root.

        Raises:
            InputError: parents that go in a circle.
        """
        out = [frame]
        while out[-1] in self._edges:
            out.append(self._edges[out[-1]].parent)
            if len(out) > _LONGEST:
                raise InputError(f"tf: the parents of {frame} go in a circle; to fix: record it again")
        return out

    def moves(self, child: str) -> bool:
        """Whether a frame moves in its parent."""
        edge = self._edges.get(child)
        if edge is None or edge.static or len(edge.poses) < 2:
            return False
        step = frames.log(frames.inverse(edge.poses[0]) @ np.array(edge.poses))
        turn, shift = (np.linalg.norm(step[:, part], axis=1).max() for part in (slice(0, 3), slice(3, 6)))
        return bool(turn > _STATIC_TURN or shift > _STATIC_SHIFT)

    def pose(self, parent: str, child: str, times: Array) -> Array:
        """T_parent_child (M, 4, 4) at some times; NaN where nothing was recorded near.

        Raises:
            InputError: no chain leads from one to the other.
        """
        up, down = self.above(child), self.above(parent)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            known = ", ".join(self.names[:8])
            raise InputError(
                f"tf: no chain leads from {parent} to {child}; to fix: name others with --frames: {known} …"
            )
        return frames.inverse(self._down(down[: down.index(common)], times)) @ self._down(up[: up.index(common)], times)

    def _down(self, path: list[str], times: Array) -> Array:
        """Product of the edges of a path that ends at its first frame."""
        T = np.tile(np.eye(4), (len(times), 1, 1))
        for child in path[::-1]:
            T = T @ self._at(self._edges[child], times)
        return T

    def _at(self, edge: _TreeEdge, times: Array) -> Array:
        """T_parent_child (M, 4, 4): turned by Slerp (Shoemake 1985), shifted along a line."""
        if edge.static or len(edge.poses) == 1:
            return np.broadcast_to(edge.poses[-1], (len(times), 4, 4))
        known, first = np.unique(edge.times, return_index=True)
        poses = np.array(edge.poses)[first]
        if len(known) == 1:
            return np.broadcast_to(poses[0], (len(times), 4, 4))
        asked = np.clip(times, known[0], known[-1])
        shift = np.stack([np.interp(asked, known, poses[:, i, 3]) for i in range(3)], axis=1)
        T = frames.make(Slerp(known, Rotation.from_matrix(poses[:, :3, :3]))(asked).as_matrix(), shift)
        nearest = np.abs(known[:, None] - np.asarray(times)[None]).min(axis=0)
        T[nearest > _MAX_TRANSFORM_AGE] = np.nan
        return T
