"""Relative scanner motions from the scans alone, and hand-eyes from them (AX = XB).

Neighbouring views are registered by features (FPFH, RANSAC; Rusu et al. 2009) and, as an ordered
sequence, by KISS-ICP (Vizzo et al. 2023). The motions are matched with the robot's by five solvers.
Single motions may be wrong: a motion counts only if its rotation angle agrees with the robot's,
which holds for any hand-eye.
"""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.closed_form import feature_matching
from stitch.closed_form.axxb import AXXB_SOLVERS
from stitch.closed_form.feature_matching import FeaturedSurface
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.scan import Scan
from stitch.system.threads import parallel

# The angle of a conjugate motion is an invariant: |angle(A) − angle(B)| small (Chen 1991).
_ANGLE_TOLERANCE = np.radians(3.0)
_MINIMUM_MOTIONS = 3
_FEATURE_SPACINGS = 6.0
_POINTS = 1500
# One partner in twelve right leaves five good triples among so many.
_DRAWS = 10_000


def motion_candidates(captures: Sequence[Capture]) -> list[tuple[str, Array]]:
    """(source, T_mount (4, 4)) of every solver on every kind of motion that has enough of them."""
    out: list[tuple[str, Array]] = []
    for kind, motions in (("features", feature_motions), ("KISS-ICP", sequence_motions)):
        robot, scanner = [], []
        for capture in captures:
            A, B = consistent_motions(*motions(capture))
            robot.append(A)
            scanner.append(B)
        A, B = np.concatenate(robot), np.concatenate(scanner)
        if len(A) < _MINIMUM_MOTIONS:
            continue
        for name, solver in AXXB_SOLVERS.items():
            try:
                T_mount = solver(A, B)
            except (NoResultError, np.linalg.LinAlgError):
                continue
            if np.isfinite(T_mount).all():
                out.append((f"{kind}, {name}", T_mount))
    return out


def robot_motions(capture: Capture, pairs: Sequence[tuple[int, int]]) -> Array:
    """A (M, 4, 4) with A·X = X·B, B the motion that maps view w's scanner frame into view v's."""
    T = capture.T_reference_mount
    return np.array([frames.inverse(T[v]) @ T[w] for v, w in pairs]).reshape(-1, 4, 4)


def consistent_motions(A: Array, B: Array) -> tuple[Array, Array]:
    """The motions whose rotation angles agree."""
    if not len(A):
        return A, B
    angles = [np.linalg.norm(frames.log(T)[:, :3], axis=1) for T in (A, B)]
    keep = np.abs(angles[0] - angles[1]) < _ANGLE_TOLERANCE
    return A[keep], B[keep]


def feature_motions(capture: Capture) -> tuple[Array, Array]:
    """(A, B), each (M, 4, 4): motions between neighbours of the sequence (and its ends) by feature matching."""
    size = _FEATURE_SPACINGS * capture.spacing

    def described(scan: Scan) -> FeaturedSurface:
        points, normals = feature_matching.voxel_downsample(
            scan.points, scan.normals, max(size / 2, _even_grid_size(scan.points))
        )
        return feature_matching.compute_fpfh(points, normals, 2.5 * size)

    surfaces = list(parallel(described, capture.scans))

    def motion(pair: tuple[int, int]) -> Array:
        target, source = (surfaces[v] for v in pair)
        T = feature_matching.register_ransac(source, target, reach=1.5 * size, draws=_DRAWS)
        return feature_matching.align_icp(source, target, T, reach=size)

    pairs = _neighbours(len(capture.scans))
    return robot_motions(capture, pairs), np.array(list(parallel(motion, pairs, "pairs of scans"))).reshape(-1, 4, 4)


def _neighbours(views: int) -> list[tuple[int, int]]:
    steps = [(v, v + step) for step in (1, 2) for v in range(views - step)]
    return steps if views > 2 else [(0, 1)]


def _even_grid_size(points: Array) -> float:
    """Grid size that leaves about `_POINTS` points of a surface."""
    extent = np.ptp(points, axis=0)
    return float(np.sqrt(np.prod(np.sort(extent)[1:]) / _POINTS))


def sequence_motions(capture: Capture) -> tuple[Array, Array]:
    """(A, B), each (M, 4, 4): motions between consecutive views by KISS-ICP, made for a sequence in small steps."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.mapping import get_voxel_hash_map
    from kiss_icp.registration import get_registration

    pairs = [(v, v + 1) for v in range(len(capture.scans) - 1)]
    # KISS-ICP's defaults count in metres; a part's size plays the street's role of 100 m.
    size = 2 * float(np.sqrt(capture.scans[0].points.var(axis=0).sum()))
    config = KISSConfig()
    # Its sums over several threads have no fixed order, so their last digits would change from run to run.
    config.registration.max_num_threads = 1
    # Started from the centroids it is there within some ten steps, or nowhere.
    config.registration.max_num_iterations = 60
    config.mapping.voxel_size = 0.02 * size
    config.data.max_range = 1e6
    B = []
    for v, w in pairs:
        voxel_map = get_voxel_hash_map(config)
        voxel_map.add_points(_thin_points(capture.scans[v].points))
        start = np.eye(4)
        start[:3, 3] = capture.scans[v].points.mean(axis=0) - capture.scans[w].points.mean(axis=0)
        B.append(
            get_registration(config).align_points_to_map(
                _thin_points(capture.scans[w].points), voxel_map, start, 0.2 * size, (0.03 * size) ** 2
            )
        )
    return robot_motions(capture, pairs), np.array(B).reshape(-1, 4, 4)


def _thin_points(points: Array) -> Array:
    step = max(1, len(points) // _POINTS)
    return np.ascontiguousarray(points[::step])
