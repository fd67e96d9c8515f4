"""The same session by somebody else's program: Open3D's multiway registration, an independent witness."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import distributions
from itertools import combinations
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import binomial_tail
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array
from stitch.numerics.units import angle_text, length_text
from stitch.output.mesh import spacing
from stitch.run_data import RunData
from stitch.system.open3d_library import import_open3d

_FORMAT = "stitch-witness/1"
_PACKAGES = ("open3d", "open3d-cpu")
# Points of a view that are registered: a surface is averaged over enough of them, and a pair takes a tenth of a second.
_POINTS = 30_000
# Distances between partners, coarse to fine, and the scale beyond which the last, robust fit doubts; in spacings of the
# points. It begins near the end: wider ones pair across edges and slide a thin part along itself, by 2 mm on a blade.
_DISTANCES, _ROBUST = (1.0, 0.5), 0.25
# Points that say how far the clouds lie apart.
_ASKED = 20_000
_ASKED_OF_VIEW = 3_000
# Fewer common points say nothing of an overlap.
_FEWEST = 100
# A difference of sides that chance makes as often as this is none.
_CLEAR = 0.05
_NEIGHBOURS = 20
# Views are paired that look from within 60° of each other, and of which so much meets at the start: on a thin part the
# other side lies within reach.
_SAME_SIDE, _OVERLAP = 0.5, 0.3


@dataclass(frozen=True)
class Witness:
    """Open3D's poses of the views beside those of a run, after the common rigid motion that no scan can tell."""

    version: str
    views: tuple[str, ...]
    poses: Array  # (V, 4, 4) T_reference_scanner, length_unit
    shift: Array  # (V,) how far the middle of a view lies from where the run puts it, length_unit
    turn: Array  # (V,) rad
    pairs: int  # of views that it registered
    to_run: Array  # (N,) from points of its cloud to the surface of the run's, signed along the normal, length_unit
    from_run: Array  # (M,) from points of the run's cloud to the surface of its own
    places: Array  # (M, 3) of the latter, reference frame
    overlaps: Array  # (P, 2) how far apart two views' surfaces lie by the run's poses and by Open3D's, medians

    def document(self) -> dict[str, Any]:
        """Return what witness.json holds."""
        rows = zip(self.views, self.poses, self.shift, self.turn, strict=True)
        return {
            "format": _FORMAT,
            "program": f"Open3D {self.version}, multiway registration",
            "pairs": self.pairs,
            "views": [
                {"view": name, "pose": T.tolist(), "shift": float(d), "turn_rad": float(a)} for name, T, d, a in rows
            ],
            "to_run": _summary(self.to_run),
            "from_run": _summary(self.from_run),
            "overlaps": {"run": self.overlaps[:, 0].tolist(), "open3d": self.overlaps[:, 1].tolist()},
        }

    def sentences(self, length_unit: str) -> list[str]:
        """Return sentences for an auditor: how Open3D registered the scans, and how far it is from the run."""
        to_run = _summary(self.to_run)
        from_run = _summary(self.from_run)
        worst = int(np.argmax(self.shift))
        return [
            f"Open3D {self.version} registered the same scans by {self.pairs} pairs and a graph of poses.",
            "It began at the robot's poses under this run's hand-eye, and knows of no robot after that.",
            f"From its cloud to this one: half within {length_text(to_run['median'], length_unit)}, "
            f"95 % within {length_text(to_run['p95'], length_unit)}.",
            f"From this cloud to its own: half within {length_text(from_run['median'], length_unit)}, "
            f"95 % within {length_text(from_run['p95'], length_unit)}.",
            f"The views differ by {length_text(float(np.median(self.shift)), length_unit)} and "
            f"{angle_text(float(np.median(self.turn)))} in the median.",
            f"{self.views[worst]} differs most, by {length_text(float(self.shift[worst]), length_unit)}.",
            *self._nearer_sentences(length_unit),
        ]

    def _nearer_sentences(self, length_unit: str) -> Iterator[str]:
        """Yield sentences on whose poses bring the surfaces of two views closer, by a sign test over the overlaps.

        The number of fitted parameters is not corrected for: both fits have six a view, against thousands of points.
        """
        count = len(self.overlaps)
        if not count:
            return
        ours, theirs = (length_text(float(x), length_unit) for x in np.median(self.overlaps, axis=0))
        nearer = int((self.overlaps[:, 0] < self.overlaps[:, 1]).sum())
        yield (
            f"Where two views overlap, their surfaces lie {ours} apart by this run's poses and {theirs} by Open3D's "
            "(medians)."
        )
        chance = min(1.0, 2 * binomial_tail(max(nearer, count - nearer) - 1, count, 0.5))
        if chance > _CLEAR:
            yield f"This run is nearer in {nearer} of {count} overlaps: no difference beyond chance (p = {chance:.2g})."
        else:
            name = "This run" if 2 * nearer > count else "Open3D"
            yield f"{name} is nearer in {max(nearer, count - nearer)} of {count} overlaps (p = {chance:.1g})."


def _summary(distance: Array) -> dict[str, float]:
    """Return median and 95 % quantile of |distance| (N,), and the mean of the signed distances, length_unit."""
    median, p95 = np.quantile(np.abs(distance), [0.5, 0.95])
    return {"median": float(median), "p95": float(p95), "mean": float(distance.mean())}


def open3d_witness(run: RunData) -> Witness:
    """Return the poses of a run's views by Open3D, compared with the run's: robust point-to-plane ICP, a pose graph.

    One thread computes, so that results repeat to the last bit.

    Raises:
        InputError: Open3D is not installed, or lacks a library of the system.
        NoResultError: the run has no scans, or a view meets no other.
    """
    o3d = import_open3d("--with open3d")
    clouds = [view.cloud.points for view in run.session.views if view.cloud is not None]
    if len(clouds) < len(run.session.views):
        raise NoResultError("--with open3d: labelled points are no clouds; there is nothing for Open3D to register")
    clouds = [np.ascontiguousarray(points[:: max(1, len(points) // _POINTS)], float) for points in clouds]
    point_spacing = float(np.median([spacing(points, KDTree(points)) for points in clouds]))
    with _one_thread(o3d):
        poses, pairs = _registered(o3d, clouds, run.poses_model, point_spacing)
        normals = [np.asarray(cloud.normals) for cloud in _with_normals(o3d, clouds)]
    # The common rigid motion that no scan can tell is taken off.
    poses = align_points(_placed(clouds, poses), _placed(clouds, run.poses)) @ poses
    T_run_open3d = frames.inverse(run.poses) @ poses  # of each view, scanner frame
    middles = np.array([points.mean(axis=0) for points in clouds])
    shifts = np.array([frames.transform(T, m[None])[0] - m for T, m in zip(T_run_open3d, middles, strict=True)])
    its_points = _placed(clouds, poses)
    its_normals = np.concatenate([frames.rotate(T, n) for T, n in zip(poses, normals, strict=True)])
    our_points = run.fused.points
    its_sample = its_points[:: max(1, len(its_points) // _ASKED)]
    our_sample = our_points[:: max(1, len(our_points) // _ASKED)]
    return Witness(
        version=next(d.version for d in distributions() if (d.metadata["Name"] or "").lower() in _PACKAGES),
        views=tuple(run.session.names),
        poses=poses,
        shift=np.linalg.norm(shifts, axis=1),
        turn=np.linalg.norm(frames.log(T_run_open3d)[:, :3], axis=1),
        pairs=pairs,
        to_run=_from_surface(its_sample, our_points, run.fused.normals),
        from_run=_from_surface(our_sample, its_points, its_normals),
        places=our_sample,
        overlaps=_overlaps(clouds, normals, (run.poses, poses), 2 * point_spacing),
    )


@contextmanager
def _one_thread(o3d: Any) -> Iterator[None]:
    """Limit Open3D to one thread, where its version allows that, and to messages of errors while the block lasts."""
    limit = getattr(o3d.utility, "set_max_threads", lambda _: None)
    limit(1)
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            yield
    finally:
        limit(0)


def _with_normals(o3d: Any, clouds: list[Array]) -> list[Any]:
    """Return Open3D's clouds with normals towards the scanner."""
    shown = []
    for points in clouds:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, float)))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        shown.append(cloud)
    return shown


def _registered(o3d: Any, clouds: list[Array], start: Array, spacing: float) -> tuple[Array, int]:
    """Return poses T_reference_scanner (V, 4, 4) by Open3D, and the number of pairs of views that it registered.

    Args:
        clouds: V clouds (N, 3), scanner frame, length_unit.
        start: (V, 4, 4) poses at which it begins.
        spacing: of the points, length_unit.

    Raises:
        NoResultError: a view is in no pair.
    """
    registration = o3d.pipelines.registration
    shown = _with_normals(o3d, clouds)
    graph = registration.PoseGraph()
    graph.nodes.extend([registration.PoseGraphNode(T) for T in start])
    for i, j in _one_sided(clouds, start):
        T = frames.inverse(start[i]) @ start[j]
        if registration.evaluate_registration(shown[j], shown[i], _DISTANCES[0] * spacing, T).fitness >= _OVERLAP:
            T, information = _register_pair(registration, shown[j], shown[i], T, spacing)
            # An edge of Open3D leads from its source to its target.
            graph.edges.append(registration.PoseGraphEdge(j, i, T, information, uncertain=False))
    linked = {v for edge in graph.edges for v in (edge.source_node_id, edge.target_node_id)}
    if len(linked) < len(clouds):
        raise NoResultError("--with open3d: Open3D finds no pair for some view; there is nothing to compare")
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(
            max_correspondence_distance=_DISTANCES[-1] * spacing, edge_prune_threshold=0.25, reference_node=0
        ),
    )
    return np.array([node.pose for node in graph.nodes]), len(graph.edges)


def _register_pair(registration: Any, source: Any, target: Any, T: Array, spacing: float) -> tuple[Array, Array]:
    """Return T_target_source (4, 4) by point-to-plane ICP from coarse to fine, and its information matrix (6, 6).

    Args:
        registration: the module of Open3D.
        source, target: clouds of Open3D with normals.
        T: (4, 4) T_target_source at which it begins.
        spacing: of the points, length_unit.
    """
    for distance in _DISTANCES:
        is_last = distance == _DISTANCES[-1]
        loss = registration.TukeyLoss(k=_ROBUST * spacing) if is_last else registration.L2Loss()
        method = registration.TransformationEstimationPointToPlane(loss)
        T = registration.registration_icp(source, target, distance * spacing, T, method).transformation
    reach = _DISTANCES[-1] * spacing
    return T, registration.get_information_matrix_from_point_clouds(source, target, reach, T)


def _one_sided(clouds: list[Array], poses: Array) -> list[tuple[int, int]]:
    """Return the pairs of views whose directions to the part's middle are within 60° of each other."""
    looks = [frames.rotate(T, c.mean(axis=0)[None])[0] for c, T in zip(clouds, poses, strict=True)]
    unit = [look / np.linalg.norm(look) for look in looks]
    return [(i, j) for i, j in combinations(range(len(clouds)), 2) if unit[i] @ unit[j] > _SAME_SIDE]


def _placed(clouds: list[Array], poses: Array) -> Array:
    """Return the points (N, 3) of all clouds under poses (V, 4, 4), one cloud after the other."""
    return np.concatenate([frames.transform(T, points) for T, points in zip(poses, clouds, strict=True)])


def _overlaps(clouds: list[Array], normals: list[Array], rivals: tuple[Array, Array], reach: float) -> Array:
    """Return median distances (P, 2) between the surfaces of each of P overlapping pairs, by either set of poses.

    Only points count that have a partner within reach by both sets.

    Args:
        clouds, normals: of V views, (N, 3) each, scanner frame.
        rivals: the two sets of poses (V, 4, 4).
        reach: length_unit.
    """
    trees = [KDTree(np.ascontiguousarray(points, float)) for points in clouds]
    medians = []
    for i, j in _one_sided(clouds, rivals[0]):
        moved = clouds[j][:: max(1, len(clouds[j]) // _ASKED_OF_VIEW)]
        distances = []
        meets = np.ones(len(moved), bool)
        for poses in rivals:
            places = frames.transform(frames.inverse(poses[i]) @ poses[j], moved)
            distance, nearest = trees[i].query(np.ascontiguousarray(places))
            meets &= distance < reach
            nearest = np.minimum(nearest, len(clouds[i]) - 1)
            distances.append(np.einsum("ni,ni->n", places - clouds[i][nearest], normals[i][nearest]))
        if meets.sum() > _FEWEST:
            medians.append([np.median(np.abs(distance[meets])) for distance in distances])
    return np.array(medians).reshape(-1, 2)


def _from_surface(points: Array, surface: Array, normals: Array) -> Array:
    """Return signed distances (N,) of points (N, 3) from the tangent plane of the nearest surface point.

    Args:
        surface, normals: (M, 3) points and their unit normals; positive distances lie on the normals' side.
    """
    _, at = KDTree(np.ascontiguousarray(surface, float)).query(np.ascontiguousarray(points, float))
    return np.einsum("ni,ni->n", points - surface[at], normals[at])
