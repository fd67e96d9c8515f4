"""Motions of a scanner that never stops, from its scans in their order alone: KISS-ICP (Vizzo et al. 2023).

KISS-ICP is made for small steps: it predicts each pose from the last motion and closes in on a map of what was seen
before. Separate views are no such sequence (`is_stream`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.hand_eye import park_martin

# From one scan to the next a stream turns and shifts no more than this: rad, share of the part's size.
_LARGEST_TURN, _LARGEST_SHIFT = np.radians(10.0), 0.25
# Share of the steps that must keep within it: a stream may pause, or lose a scan.
_MOST = 0.95
# Fewer scans are no stream.
_FEWEST = 10
# Of the part's size: the grid of the map, and sigma of its robust kernel. An arm moves smoothly, so that the prediction
# from the last motion is never farther off than a few of them.
_VOXEL, _KERNEL = 0.02, 0.02
# KISS-ICP's other lengths are those of streets, in metres: a part is scaled to this size.
_STREET = 100.0
# Started from the last motion it is there within some ten steps, or nowhere.
_STEPS = 60
# Passes of the odometry: the second one knows from the first where the robot carries the scanner.
_PASSES = 2
# Of the motions that agree best, the middle one turns as the robot does within so much, rad.
_TURNS_ALIKE = np.radians(0.5)
# Motions that show a hand-eye turn by so much, rad; steps of the stream between their ends, as shares of its length.
_TURNED, _STRIDES = np.radians(10.0), (0.05, 0.1, 0.2, 0.35)


def size_of_scan(points: Array) -> float:
    """Return the size of points (N, 3): twice their rms distance from their middle."""
    return 2 * float(np.sqrt(points.var(axis=0).sum()))


def is_stream(T_reference_mount: Array, scans: Sequence[Array]) -> bool:
    """Return True if a scanner never stopped: almost all steps from scan to scan are small.

    Args:
        T_reference_mount: (V, 4, 4) poses of what carries the scanner, from the robot.
        scans: V arrays of points (N, 3), scanner frame.
    """
    if len(scans) < _FEWEST:
        return False
    middle = np.array([points.mean(axis=0) for points in scans])
    turned = frames.angle_between(T_reference_mount[:-1], T_reference_mount[1:])
    shifted = np.linalg.norm(np.diff(middle, axis=0), axis=1) / np.median([size_of_scan(points) for points in scans])
    return bool(np.mean((turned < _LARGEST_TURN) & (shifted < _LARGEST_SHIFT)) >= _MOST)


def scan_odometry(
    scans: Sequence[Array],
    times: Sequence[Array] | None = None,
    interval: float = 1.0,
    predicted: Array | None = None,
) -> Array:
    """Return T_first_scanner (V, 4, 4), in length_unit, of a scanner that never stopped, from its scans alone.

    Args:
        scans: V arrays of points (N, 3), scanner frame.
        times: V arrays (N,) of s from the time of the scan to each of its points, of a scanner that moves meanwhile;
            None: all points of a scan have one time.
        interval: s from one scan to the next.
        predicted: (V - 1, 4, 4) motions from scan to scan, with which each search begins; None: the last motion found.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    # KISS-ICP takes lengths for metres of a street: points and motions are scaled to that size, poses back.
    scale = _STREET / float(np.median([size_of_scan(points) for points in scans]))
    config = KISSConfig()
    # Its sums over several threads have no fixed order, so their last digits would change from run to run.
    config.registration.max_num_threads = 1
    config.registration.max_num_iterations = _STEPS
    config.mapping.voxel_size = _VOXEL * _STREET
    config.adaptive_threshold.fixed_threshold = _KERNEL * _STREET
    config.data.max_range = 1e6
    config.data.deskew = times is not None
    odometry = KissICP(config)
    odometry.preprocessor = _MotionCorrection(odometry.preprocessor, interval)
    poses = []
    for v, points in enumerate(scans):
        if predicted is not None and v:
            odometry.last_delta = frames.make(predicted[v - 1, :3, :3], scale * predicted[v - 1, :3, 3])
        odometry.register_frame(np.ascontiguousarray(scale * points), np.zeros(0) if times is None else times[v])
        poses.append(odometry.last_pose.copy())
    T_first_scanner = np.array(poses)
    T_first_scanner[:, :3, 3] /= scale
    return T_first_scanner


def hand_eye_of_stream(
    T_reference_mount: Array,
    scans: Sequence[Array],
    times: Sequence[Array] | None,
    interval: float,
    T_mount: Array | None,
) -> tuple[Array | None, Array]:
    """Return T_mount (4, 4) of a scanner that never stopped, from A·X = X·B, and its odometry T_first_scanner.

    Two passes of the odometry. Where the scans show little, as along an edge, motions predicted from the robot help;
    they need a hand-eye: the stated one, or the one that the pass before found. T_mount is None where the odometry
    fails: its motions turn by other angles than the robot's.

    Args:
        T_reference_mount: (V, 4, 4) poses of what carries the scanner, from the robot.
        scans, times, interval: as for `scan_odometry`.
        T_mount: (4, 4) maps scanner to mount, to begin with; within some per cent of the distance to the part. None:
            not known, and the first pass predicts each motion by the last.
    """
    steps = motions_between(T_reference_mount, [(v, v + 1) for v in range(len(scans) - 1)])
    for _ in range(_PASSES):
        predicted = None if T_mount is None else frames.inverse(T_mount) @ steps @ T_mount
        odometry = scan_odometry(scans, times, interval, predicted)
        A, B = motions_of_stream(T_reference_mount, odometry)
        if not len(A) or np.median(angle_differences(A, B)) > _TURNS_ALIKE:
            return None, odometry
        try:
            T_mount = park_martin(A, B)
        except NoResultError:
            return None, odometry
    return T_mount, odometry


class _MotionCorrection:
    """A preprocessor for KISS-ICP that moves the points of each scan to where the scanner saw them at the scan's time.

    KISS-ICP's own takes for granted that a scan lasts until the next one, and refers its points to the time of the last
    one. This one corrects both, by a scaled motion and a shift in time.
    """

    def __init__(self, preprocessor: Any, interval: float) -> None:
        self._preprocessor = preprocessor
        self._interval = interval

    def preprocess(self, points: Array, times: Array, T_last_now: Array) -> Array:
        """Return points (N, 3) in the frame of the scanner at time 0, the time of the scan.

        Args:
            points: (N, 3) each in the frame of the scanner at its own time.
            times: (N,) s after the time of the scan; empty: all points have that time.
            T_last_now: (4, 4) motion of the scanner from the last scan to this one.
        """
        if not len(times):
            return self._preprocessor.preprocess(points, times, T_last_now)
        velocity = frames.log(T_last_now) / self._interval
        at_end = self._preprocessor.preprocess(points, times, frames.exp(np.ptp(times) * velocity))
        return frames.transform(frames.exp(times.max() * velocity), at_end)


def motions_of_stream(T_reference_mount: Array, odometry: Array) -> tuple[Array, Array]:
    """Return motions A of the mount and B of the scanner, each (M, 4, 4), for A·X = X·B.

    Between views some strides apart, where the robot turned by more than `_TURNED`. A and B turn by the same angle,
    whatever the hand-eye is (Chen 1991). A wrong step of the odometry spoils every motion across it: only the half of
    the motions whose angles agree best is returned.

    Args:
        T_reference_mount: (V, 4, 4) poses of what carries the scanner, from the robot.
        odometry: (V, 4, 4) T_first_scanner from the scans.
    """
    V = len(T_reference_mount)
    strides = sorted({max(1, round(share * V)) for share in _STRIDES})
    v: Indices = np.concatenate([np.arange(V - stride) for stride in strides])
    w: Indices = np.concatenate([np.arange(stride, V) for stride in strides])
    turned = frames.angle_between(T_reference_mount[v], T_reference_mount[w]) > _TURNED
    pairs = list(zip(v[turned].tolist(), w[turned].tolist(), strict=True))
    A, B = motions_between(T_reference_mount, pairs), motions_between(odometry, pairs)
    mismatch = angle_differences(A, B)
    half = -(-len(pairs) // 2)  # rounded up
    best = np.sort(np.argsort(mismatch, kind="stable")[:half])
    return A[best], B[best]


def angle_differences(A: Array, B: Array) -> Array:
    """Return by how much the rotation angles of motions (M, 4, 4) differ, (M,) rad."""
    return np.abs(frames.angle_between(np.eye(4), A) - frames.angle_between(np.eye(4), B))


def motions_between(poses: Array, pairs: Sequence[tuple[int, int]]) -> Array:
    """Return (M, 4, 4) motions that map the frame of view w into that of view v, of poses (V, 4, 4)."""
    v, w = np.array(pairs, int).reshape(-1, 2).T
    return frames.inverse(poses[v]) @ poses[w]
