"""Find faults of single scans: mirrored or scaled clouds, copies of other scans, poses of other scans."""

from itertools import combinations
from typing import Any

import numpy as np

from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA, tukey
from stitch.numerics.frames import Array
from stitch.observations.surfaces.matching import sample_points
from stitch.screening.hypotheses import UNITS
from stitch.screening.placement import ReferenceSurface, evaluate_placement, place_scan, starts_about
from stitch.session.capture import Capture
from stitch.session.scan import Scan, even_indices, prepare_scan

# Reflections of the scanner frame, with what was done.
_FLIPS = {
    "x has the wrong sign": np.diag([-1.0, 1, 1]),
    "y has the wrong sign": np.diag([1.0, -1, 1]),
    "z has the wrong sign": np.diag([1.0, 1, -1]),
    "x and y are exchanged": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    "y and z are exchanged": np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "x and z are exchanged": np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]),
}
# Factors that are looked for; nearer to one than the last, scanners differ from robots.
_LEAST_SCALE, _NEAR_ONE = 0.5, 1e-3
# Of the part's size: how far a scan may be moved whose pose is right.
_STAYS = 0.03
# Of the shift that a scale makes along the ray, the share that its own uncertainty may leave.
_RANGE_LEFT = 0.3
# Points that hold a factor on a scan, and gates, as shares of the part's size, at which these are matched.
_PROBES, _GATES = 600, np.geomspace(0.1, 0.01, 25)

# Points by which two scans are compared.
_COMPARED = 60

# A mistake of the list in `hypotheses`, and its words.
ScanFault = tuple[str, dict[str, Any]]


def scan_fault(scan: Scan, T_pose: Array, surface: ReferenceSurface, size: float, needed: float) -> ScanFault | None:
    """Return the mistake of a cloud that, undone, makes it fit the surface of the others; None if there is none.

    Tried are reflections (at its own pose), other units (anywhere), and other factors. A reflection counts only if it
    is the only one that fits.

    Args:
        T_pose: (4, 4) T_reference_scanner from the robot.
        surface: of the other views.
        size: of the part, length_unit.
        needed: closure that counts as closed.
    """

    def closes(points: Array, eye: Array, reach: float) -> bool:
        """Return whether a cloud lies on the surface of the others at its pose, or placed within `reach` of it.

        Args:
            points, eye: (N, 3) points of the changed cloud and (3,) place that it was seen from, scanner frame.
            reach: largest shift from its pose, length_unit.
        """
        other = prepare_scan(scan.name, points, eye=eye)
        placed = place_scan(other, surface, starts_about(T_pose, other, size), size)[0]
        placements = (evaluate_placement(other, T_pose, surface), placed)
        # Where less than a third of the scan is near the surface, its closure says little.
        near = [p for p in placements if p.near > 0.3 and _moved(other, T_pose, p.T) < reach]
        return max((p.closure for p in near), default=0.0) > needed

    # The pose of a mirrored scan is right: on a symmetric part a wrong reflection may fit, but elsewhere.
    mirrored = [name for name, flip in _FLIPS.items() if closes(scan.points @ flip, scan.eye @ flip, _STAYS * size)]
    if len(mirrored) == 1:
        return "mirrored cloud", {"flip": mirrored[0]}
    for factor, units in UNITS.items():
        if closes(scan.points / factor, scan.eye / factor, np.inf):
            return "one cloud", {"factor": factor, "units": units}
    return scale_fault(scan, T_pose, surface, size, needed)


def scale_fault(scan: Scan, T_pose: Array, surface: ReferenceSurface, size: float, needed: float) -> ScanFault | None:
    """Return a factor on the cloud under which it fits the others' surface at its own pose; None if there is none.

    Args:
        T_pose: (4, 4) T_reference_scanner from the robot.
        size: of the part, length_unit.
        needed: closure from which a scan counts as placed.
    """
    starts = np.concatenate([T_pose[None], starts_about(T_pose, scan, size)])
    scale = _fit_scale(scan, place_scan(scan, surface, starts, size)[0].T, surface, size)
    if not (_LEAST_SCALE < scale < 1 / _LEAST_SCALE) or abs(scale - 1) < _NEAR_ONE:
        return None
    other = prepare_scan(scan.name, scan.points * scale, eye=scan.eye * scale)
    if evaluate_placement(other, T_pose, surface).closure < needed:
        # The factor is known from the shape to about a thousandth. Times the range, that is a shift of millimetres.
        placed = place_scan(other, surface, T_pose[None], 0.2 * size)[0]
        allowed = _RANGE_LEFT * abs(scale - 1) * np.linalg.norm(other.points.mean(axis=0))
        if placed.closure < needed or _moved(other, T_pose, placed.T) > allowed:
            return None
    return "scaled cloud", {"factor": 1 / scale, "by": scale}


def _moved(scan: Scan, T: Array, other: Array) -> float:
    """Return how far apart two poses put the middle of a scan."""
    centroid = scan.points.mean(axis=0)[None]
    return float(np.linalg.norm(frames.transform(other, centroid) - frames.transform(T, centroid)))


def _fit_scale(scan: Scan, T: Array, surface: ReferenceSurface, size: float) -> float:
    """Return the factor on a scan's points about their centroid that fits a surface best, with the pose free.

    Point-to-plane least squares with seven unknowns, one step per gate.

    Args:
        T: (4, 4) T_reference_scanner to begin with.
        size: of the part, length_unit: gates are shares of it.
    """
    index = sample_points(scan, _PROBES)
    points, normals = scan.points[index], scan.normals[index]
    centre = points.mean(axis=0)
    scale = 1.0
    lever = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))
    for gate in np.maximum(size * _GATES, 1.5 * surface.spacing):
        scaled = centre + scale * (points - centre)
        residual, normal, meets, _ = (x[0] for x in surface.meets(T[None], scaled, normals, gate))
        arm = frames.transform(T, scaled) - frames.transform(T, centre[None])
        along = np.einsum("nj,nj->n", arm, normal)[:, None] / lever
        J = np.concatenate([np.cross(arm, normal) / lever, normal, along], axis=1)
        spread = MAD_TO_SIGMA * np.median(np.abs(residual[meets])) if meets.any() else gate
        weight = meets * tukey(residual, max(spread, surface.tolerance / 4))
        H = J.T @ (weight[:, None] * J)
        step = -np.linalg.solve(H + 1e-6 * (np.trace(H) + 1e-9) * np.eye(7), J.T @ (weight * residual))
        step[[0, 1, 2, 6]] /= lever
        T = frames.moved_about(frames.transform(T, centre[None])[0], step[:6], T)
        scale *= 1 + float(step[6])
    return scale


def find_copies(capture: Capture) -> list[tuple[int, int]]:
    """Find pairs of views (v < w) that show the same measured points."""
    return [(v, w) for (v, a), (w, b) in combinations(enumerate(capture.scans), 2) if _same_points(a, b)]


def _same_points(a: Scan, b: Scan) -> bool:
    """Return whether nearly every point of `a` is found in `b`, within 1e-4 of the spacing: never so by chance."""
    if abs(len(a.points) - len(b.points)) > 0.02 * max(len(a.points), len(b.points)):
        return False
    points = a.points[even_indices(len(a.points), _COMPARED)]
    distance, _ = b.tree.query(np.ascontiguousarray(points), k=1)
    return bool(np.mean(distance < 1e-4 * b.spacing) > 0.9)


def find_same_poses(capture: Capture) -> list[tuple[int, int]]:
    """Find pairs of views (v < w) with the very same pose."""
    T = capture.T_reference_mount
    return [(v, w) for v, w in combinations(range(len(T)), 2) if np.allclose(T[v], T[w], rtol=0, atol=1e-9)]
