"""Scans of a scanner that moves while it scans, as they would be from where each view stood (de-skew)."""

from dataclasses import replace

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.odometry import hand_eye_of_stream, is_stream
from stitch.session.axis_poses import require_placed
from stitch.session.session import Cloud, SessionData, View
from stitch.session.thinning import thin_cloud

# Fewer views say nothing of how the robot moved between them.
_FEWEST = 4


def deskew_session(session: SessionData) -> SessionData:
    """Return the session with each point in the frame of the scanner at the time of its view, not at its own time.

    The robot's path is a spline through the poses of the views. The hand-eye that turns it into the scanner's path is
    found from the odometry of the scans, if the scanner never stopped; else it is the stated one.

    Raises:
        InputError: a view or a point without time, times that do not rise, too few views, an axis of unknown place, or
            no hand-eye.
    """
    require_placed(session)
    where = session.path / "session.toml"
    times = [view.time_s for view in session.views]
    if None in times or len(times) < _FEWEST or np.any(np.diff(np.array(times, float)) <= 0):
        raise InputError(
            f"{where}: scanner.moving needs at least {_FEWEST} views with rising time_s; to fix: add the column to "
            "views.csv, in the order of the scans"
        )
    for view in session.views:
        if view.cloud is None or "time" not in view.cloud.scalars:
            raise InputError(
                f"{where}: scanner.moving, and the cloud of view {view.name} has no time of its points; to fix: write "
                "the column time, s after time_s, or drop scanner.moving"
            )
    path = _RobotPath(np.array(times, float), _mount_poses(session))
    T_mount = _stream_hand_eye(session)
    if T_mount is None:
        T_mount = session.scanner.T_mount
    if T_mount is None:
        raise InputError(
            f"{where}: the scans show no hand-eye that says how the scanner moved; to fix: give scanner.pose"
        )

    def of_view(view: View, time: float) -> View:
        cloud = view.cloud
        assert cloud is not None

        def all_points() -> Cloud:
            """Return the de-skewed cloud with the points that are not in memory too."""
            whole = cloud if cloud.whole is None else cloud.whole.read()
            points = _seen_from_view(whole.points, whole.scalars["time"], path, time, T_mount)
            return replace(whole, points=points, normals=None)

        return replace(view, cloud=thin_cloud(view.name, all_points(), len(cloud.points), session.scanner, all_points))

    return replace(session, views=tuple(map(of_view, session.views, path.times)))


def _mount_poses(session: SessionData) -> Array:
    """Return T_reference_mount (V, 4, 4): T_base_flange where the flange carries the scanner, else its inverse."""
    T = np.array([view.T_base_flange for view in session.views])
    return T if session.mount == "eye_in_hand" else frames.inverse(T)


def _stream_hand_eye(session: SessionData) -> Array | None:
    """Return T_mount (4, 4) found from the odometry of a scanner that never stopped, by A·X = X·B.

    The search begins with the stated hand-eye, then without one. None: the scanner stopped between scans, or its
    odometry does not turn as the robot does.
    """
    clouds = [view.cloud for view in session.views if view.cloud is not None]
    scans = [cloud.points for cloud in clouds]
    T_reference_mount = _mount_poses(session)
    if not is_stream(T_reference_mount, scans):
        return None
    times = [cloud.scalars["time"] for cloud in clouds] if session.scanner.moving else None
    seconds = [view.time_s for view in session.views if view.time_s is not None]
    interval = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    starts = [None] if session.scanner.T_mount is None else [session.scanner.T_mount, None]
    for T_mount in starts:
        hand_eye, _ = hand_eye_of_stream(T_reference_mount, scans, times, interval, T_mount)
        if hand_eye is not None:
            return hand_eye
    return None


class _RobotPath:
    """T_reference_mount as a function of time: splines through the poses of the views."""

    def __init__(self, times: Array, T_reference_mount: Array) -> None:
        """Fit cubic splines of positions and of rotations to T_reference_mount (V, 4, 4) at rising times (V,), s."""
        self.times = times
        # Few sessions have a scanner that moves: the others do not wait for it.
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        self._place = CubicSpline(times, T_reference_mount[:, :3, 3])
        self._by_vector = Rotation.from_rotvec
        self._turn = RotationSpline(times, Rotation.from_matrix(T_reference_mount[:, :3, :3]))

    def at(self, times: Array) -> Array:
        """Return T_reference_mount (K, 4, 4) at times (K,), s; before the first view and after the last at constant
        velocity."""
        within = np.clip(times, self.times[0], self.times[-1])
        T = np.tile(np.eye(4), (len(times), 1, 1))
        rate = self._turn(within, 1)
        late = times - within
        T[:, :3, :3] = (self._turn(within) * self._by_vector(rate * late[:, None])).as_matrix()
        T[:, :3, 3] = self._place(within) + self._place(within, 1) * late[:, None]
        return T


def _seen_from_view(points: Array, times: Array, path: _RobotPath, of_view: float, T_mount: Array) -> Array:
    """Return points (N, 3) mapped from the scanner's frame at their own time to its frame at the time of the view.

    Args:
        times: (N,) s after the time of the view.
        of_view: s, time of the view on the path.
        T_mount: (4, 4) hand-eye.
    """
    moments, index = np.unique(times, return_inverse=True)
    T_reference_scanner = path.at(of_view + moments) @ T_mount
    T = (frames.inverse(path.at(np.array([of_view]))[0] @ T_mount) @ T_reference_scanner)[index]
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
