"""What the node does, without ROS: messages in, verdicts and the hand-eye out. A view for each stop of the arm."""

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import stitch
from stitch.api.live import LiveView
from stitch.numerics import frames
from stitch.plugins.intake.ros_bag import TransformTree, cloud_array, message_time, transform_recording
from stitch.session.session import Mount

# The flange stands if it turns (rad) and shifts (m) by less within so long (s) before and after a scan.
_TURN, _SHIFT, _AROUND = 1e-3, 5e-4, 0.25
# It has moved on if it turned or shifted by more than so many times this.
_NEW = 20.0
_MEMORY = 10.0  # s of transforms that are kept


class LiveCell:
    """Session of a cell that grows by one view for each stop of the arm; lengths in m."""

    def __init__(self, base: str, flange: str, mount: Mount = "eye_in_hand") -> None:
        self.base, self.flange, self.mount = base, flange, mount
        self.scanner = ""  # frame of the clouds
        self.live = stitch.live(mount=mount, unit="m", name="ros")
        self._fixed: dict[str, Any] = {}
        self._moving: deque[Any] = deque()
        self._clouds: deque[Any] = deque()
        self._taken: np.ndarray | None = None  # T_base_flange of the last view

    def hear(self, message: Any, static: bool = False) -> None:
        """Take in a TFMessage of /tf, or of /tf_static."""
        for transform in message.transforms:
            recording = transform_recording(transform, static)
            if static:
                self._fixed[recording[2]] = recording
            else:
                self._moving.append(recording)
        while self._moving and self._moving[0][0] < self._moving[-1][0] - _MEMORY:
            self._moving.popleft()

    def see(self, message: Any) -> None:
        """Take in a PointCloud2; it waits until the arm is known before and after it."""
        self._clouds.append(message)

    def judged(self) -> Iterator[LiveView]:
        """Yield what is said of scans at stops that have come since; those on the way, or of a known stop, are dropped.

        Raises:
            InputError: a scan or a pose that cannot be used.
        """
        while self._clouds and self._moving:
            message = self._clouds[0]
            time = message_time(message.header, 0)
            if self._moving[-1][0] < time + _AROUND:
                return
            self._clouds.popleft()
            tree = TransformTree([*self._fixed.values(), *self._moving])
            before, pose, after = tree.pose(self.base, self.flange, np.array([time - _AROUND, time, time + _AROUND]))
            if not _apart(before, after, 1.0) and (self._taken is None or _apart(self._taken, pose, _NEW)):
                points = cloud_array(message, "cloud")[..., :3]
                self.scanner = message.header.frame_id.lstrip("/")
                said = self.live.add_view(points, pose, time_s=time)
                self._taken = pose
                yield said

    def hand_eye(self) -> tuple[str, str, np.ndarray] | None:
        """Return parent, child and T_parent_child (4, 4), m, of the hand-eye so far; None before there is one."""
        known = self.live.hand_eye
        parent = self.flange if self.mount == "eye_in_hand" else self.base
        return None if known is None else (parent, self.scanner, known.pose)

    def finish(self, folder: Path) -> stitch.Run:
        """Return the run of all views, after it and its session are written: FOLDER and FOLDER-session.

        Raises:
            InputError, NoResultError: as of `stitch.run`, or no place to write.
        """
        run = self.live.finish()
        run.save(folder, recording=False)
        return run


def _apart(T: np.ndarray, other: np.ndarray, times: float) -> bool:
    """Return whether two poses differ by more than a flange that stands; True where one is unknown."""
    step = frames.log(frames.inverse(T) @ other)
    near = np.linalg.norm(step[:3]) < times * _TURN and np.linalg.norm(step[3:]) < times * _SHIFT
    return not near
