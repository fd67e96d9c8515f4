"""Where a scan belongs among the others, tried wide: from many starts, by the surface alone.

Point-to-plane ICP (Chen & Medioni 1992) of one scan against the surface of other views, all starts at once, with a
gate that shrinks. A placement is judged by its closure: of the points that come to lie near the other surface, the
share that lies on it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array, Indices, Mask
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.match import sample_points

# Points of the other views that make up their surface, and of the scan that is placed.
_SURFACE_POINTS = 30_000
_COARSE_PROBES, _FINAL_PROBES = 160, 600
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Gates of the search as shares of the size: from a third of the part to a two-hundredth.
_FIRST_GATE, _LAST_GATE, _STEPS = 0.35, 0.005, 14
_FINAL_STEPS = 15
_KEPT = 4
# A scan of a line or of a point has no second direction: its extent there, as a share of the largest.
_LINE = 1e-3
_FEWEST = 30


@dataclass(frozen=True)
class ReferenceSurface:
    """Points of several views in the reference frame, with normals."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    tree: Any
    spacing: float  # median distance between neighbours of one scan
    tolerance: float  # a point this far from the surface, along the normal, lies on it

    @property
    def near(self) -> float:
        """Distance from its points within which a point lies near the surface."""
        return 2 * self.spacing + 3 * self.tolerance

    def meets(self, poses: Array, points: Array, normals: Array, gate: float) -> tuple[Array, Array, Mask]:
        """Signed distance (S, n), normal of the partner (S, n, 3), and whether there is one within `gate`."""
        placed = frames.transform(poses, points)
        distance, partner = self.tree.query(np.ascontiguousarray(placed.reshape(-1, 3)), distance_upper_bound=gate)
        found = np.isfinite(distance).reshape(placed.shape[:2])
        partner = np.where(np.isfinite(distance), partner, 0).astype(np.int64).reshape(placed.shape[:2])
        normal = self.normals[partner]
        found &= np.einsum("snj,snj->sn", frames.rotate(poses, normals), normal) > _NORMAL_COSINE
        return np.einsum("snj,snj->sn", placed - self.points[partner], normal), normal, found


@dataclass(frozen=True)
class Placement:
    """A scan placed on a surface."""

    T: Array  # (4, 4) T_reference_scanner
    near: float  # share of its points that lie near the surface
    closure: float  # share of those that lie on it

    @property
    def surface_share(self) -> float:
        """Share of all its points that lie on the surface."""
        return self.near * self.closure


def surface_of(scans: Sequence[Scan], poses: Array, views: Iterable[int], tolerance: float) -> ReferenceSurface:
    """The surface that some views show under poses (V, 4, 4) T_reference_scanner."""
    views = list(views)
    picked = {v: sample_points(scans[v], max(_SURFACE_POINTS // max(len(views), 1), 200)) for v in views}
    points = np.concatenate([frames.transform(poses[v], scans[v].points[picked[v]]) for v in views])
    normals = np.concatenate([frames.rotate(poses[v], scans[v].normals[picked[v]]) for v in views])
    spacing = float(
        np.median([scans[v].spacing * np.sqrt(len(scans[v].points) / max(len(picked[v]), 1)) for v in views])
    )
    return ReferenceSurface(points, normals, KDTree(np.ascontiguousarray(points), leafsize=16), spacing, tolerance)


def shows_no_surface(scan: Scan) -> bool:
    """True for a scan of so few points, or of points in one line, that it fits anywhere."""
    return bool(scan.usable.sum() < _FEWEST) or lies_in_a_line(scan)


def lies_in_a_line(scan: Scan) -> bool:
    """True for a scan of points in one straight line: on a flat part it lies on the surface, and holds nothing."""
    extent = np.linalg.svd(scan.points - scan.points.mean(axis=0), compute_uv=False)
    return bool(extent[1] < _LINE * extent[0])


def evaluate_placement(scan: Scan, T: Array, surface: ReferenceSurface) -> Placement:
    """How well a scan lies on a surface under a pose (4, 4)."""
    return evaluate_placements(scan, T[None], surface)[0]


def evaluate_placements(
    scan: Scan, poses: Array, surface: ReferenceSurface, probes: int = _FINAL_PROBES
) -> list[Placement]:
    """The same for several poses (S, 4, 4)."""
    index = sample_points(scan, probes)
    if not len(index):
        return [Placement(T, 0.0, 0.0) for T in poses]
    residual, _, meets = surface.meets(poses, scan.points[index], scan.normals[index], surface.near)
    inside = _points_near_surface(scan, poses, surface, index, surface.near)
    on = meets & (np.abs(residual) < surface.tolerance)
    return [
        Placement(T, float(i.mean()), float(o.sum() / max(i.sum(), 1)))
        for T, i, o in zip(poses, inside, on, strict=True)
    ]


def _points_near_surface(scan: Scan, poses: Array, surface: ReferenceSurface, index: Indices, near: float) -> Mask:
    """(S, n) points with the surface near, whichever way it faces."""
    placed = frames.transform(poses, scan.points[index])
    distance, _ = surface.tree.query(np.ascontiguousarray(placed.reshape(-1, 3)), distance_upper_bound=near)
    return np.asarray(np.isfinite(distance).reshape(placed.shape[:2]))


def place_scan(scan: Scan, surface: ReferenceSurface, starts: Array, size: float) -> list[Placement]:
    """Close in from every start (S, 4, 4); the best few placements, best first.

    Args:
        size: of the part, length_unit: the search reaches a third of it.
    """
    gates = size * np.geomspace(_FIRST_GATE, _LAST_GATE, _STEPS)
    gates = np.maximum(gates, 1.5 * surface.spacing)
    poses = _icp_scan(scan, surface, starts, gates, _COARSE_PROBES)
    found = evaluate_placements(scan, poses, surface, 300)
    best = sorted(range(len(found)), key=lambda i: -found[i].surface_share)[:_KEPT]
    fine = np.full(_FINAL_STEPS, gates[-1])
    poses = _icp_scan(scan, surface, poses[best], fine, _FINAL_PROBES)
    return sorted(evaluate_placements(scan, poses, surface), key=lambda p: -p.surface_share)


def _icp_scan(scan: Scan, surface: ReferenceSurface, starts: Array, gates: Array, probes: int) -> Array:
    """(S, 4, 4) after one Gauss–Newton step per gate, all starts side by side."""
    index = sample_points(scan, probes)
    points, normals = scan.points[index], scan.normals[index]
    poses = np.array(starts)
    centre = points.mean(axis=0)
    lever = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())) or 1.0
    for gate in gates:
        residual, normal, found = surface.meets(poses, points, normals, gate)
        # Twists about each pose's own centre, rotations in units of the lever: well scaled at every start.
        arm = frames.transform(poses, points) - frames.transform(poses, centre[None])
        J = np.concatenate([np.cross(arm, normal) / lever, normal], axis=2)
        spread = np.median(np.where(found, np.abs(residual), np.nan_to_num(gate)), axis=1)
        cut = np.maximum(3 * 1.4826 * spread, 2 * surface.tolerance)[:, None]
        weight = found * np.clip(1 - (residual / np.maximum(cut, 1e-300)) ** 2, 0, None) ** 2
        H = np.einsum("sn,sni,snj->sij", weight, J, J, optimize=True)
        b = np.einsum("sn,sni,sn->si", weight, J, residual, optimize=True)
        H += 1e-4 * (np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(6)
        step = -np.linalg.solve(H, b[..., None])[..., 0]
        step[:, :3] /= lever
        to = frames.make(np.eye(3), -frames.transform(poses, centre[None])[:, 0])
        poses = frames.inverse(to) @ frames.exp(step) @ to @ poses
    return poses


def starts_about(T: Array, scan: Scan, size: float) -> Array:
    """(S, 4, 4) a pose and its neighbours: a third of the part along, and 12° about, each axis."""
    centre = frames.transform(T, scan.points.mean(axis=0)[None])[0]
    to = frames.make(np.eye(3), -centre)
    turns = [frames.make(Rotation.from_rotvec(a * np.radians(12)).as_matrix(), np.zeros(3)) for a in _AXES]
    shifts = [frames.make(np.eye(3), a * _FIRST_GATE * size) for a in _AXES]
    return np.array([T] + [frames.inverse(to) @ move @ to @ T for move in (*turns, *shifts)])


_AXES = np.vstack([np.eye(3), -np.eye(3)])


def starts_anywhere(surface: ReferenceSurface, scan: Scan, turns: int = 48) -> Array:
    """(S, 4, 4) the scan's centre on the surface's centre, turned every way."""
    R = Rotation.random(turns, rng=np.random.default_rng(0)).as_matrix()
    own, there = scan.points.mean(axis=0), surface.points.mean(axis=0)
    return frames.make(R, there - R @ own)
