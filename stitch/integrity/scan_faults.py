"""What can be wrong with one scan so that it closes nowhere: mirrored, scaled, another unit; or a copy of another."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.hypotheses import UNITS
from stitch.integrity.placing import ReferenceSurface, evaluate_placement, place_scan, starts_about
from stitch.measurement.capture import Capture
from stitch.measurement.scan import Scan, prepare_scan
from stitch.observations.surfaces.match import sample_points
from stitch.statistics.robust import tukey

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


@dataclass(frozen=True)
class ScanFault:
    """A scan that closes on the others once this is undone."""

    kind: str  # mirrored | scale | unit
    fix: str


def scan_fault(scan: Scan, T_pose: Array, surface: ReferenceSurface, size: float, needed: float) -> ScanFault | None:
    """What makes a scan close on the surface of the others, at its pose or near it; None if nothing does.

    Args:
        T_pose: (4, 4) T_reference_scanner from the robot.
        size: of the part, length_unit.
        needed: closure that counts as closed.
    """

    def closes(points: Array, eye: Array, reach: float) -> float:
        other = prepare_scan(scan.name, points, eye=eye)
        found = [
            evaluate_placement(other, T_pose, surface),
            *place_scan(other, surface, starts_about(T_pose, other, size), size)[:1],
        ]
        middle = other.points.mean(axis=0)[None]
        moved = [np.linalg.norm(frames.transform(f.T, middle) - frames.transform(T_pose, middle)) for f in found]
        return max(f.closure if f.near > 0.3 and m < reach else 0.0 for f, m in zip(found, moved, strict=True))

    # The pose of a mirrored scan is right: on a part that looks alike in a mirror, others close elsewhere too.
    near = _STAYS * size
    mirrored = [w for w, flip in _FLIPS.items() if closes(scan.points @ flip, scan.eye @ flip, near) > needed]
    if len(mirrored) == 1:
        return ScanFault("mirrored", f"{mirrored[0]} in this cloud: export it again")
    for factor, words in UNITS.items():
        if closes(scan.points / factor, scan.eye / factor, np.inf) > needed:
            return ScanFault(
                "unit", f"this cloud is {factor:.6g} times too large ({words}): export it in the right unit"
            )
    return scale_fault(scan, T_pose, surface, size, needed)


def scale_fault(scan: Scan, T_pose: Array, surface: ReferenceSurface, size: float, needed: float) -> ScanFault | None:
    """A factor on the cloud under which it closes at its own pose; None if there is none."""
    begin = place_scan(scan, surface, np.concatenate([T_pose[None], starts_about(T_pose, scan, size)]), size)[0]
    scale = _similarity(scan, begin.T, surface, size)
    if not (_LEAST_SCALE < scale < 1 / _LEAST_SCALE) or abs(scale - 1) < _NEAR_ONE:
        return None
    other = prepare_scan(scan.name, scan.points * scale, eye=scan.eye * scale)
    found = evaluate_placement(other, T_pose, surface)
    if found.closure < needed:
        # The factor from the shape is good to a thousandth; the range that it leaves is one of millimetres.
        found = place_scan(other, surface, T_pose[None], 0.2 * size)[0]
        middle = other.points.mean(axis=0)[None]
        moved = np.linalg.norm(frames.transform(found.T, middle) - frames.transform(T_pose, middle))
        if found.closure < needed or moved > _RANGE_LEFT * abs(scale - 1) * np.linalg.norm(middle):
            return None
    return ScanFault("scale", f"this cloud is {1 / scale:.4g} times as large as the part: multiply it by {scale:.5g}")


def _similarity(scan: Scan, T: Array, surface: ReferenceSurface, size: float) -> float:
    """Factor on the scan's points that fits a surface best, with its pose: point-to-plane, seven unknowns."""
    index = sample_points(scan, 600)
    points, normals = scan.points[index], scan.normals[index]
    centre, scale = points.mean(axis=0), 1.0
    lever = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))
    for gate in np.maximum(size * np.geomspace(0.1, 0.01, 25), 1.5 * surface.spacing):
        shown = centre + scale * (points - centre)
        residual, normal, found = (x[0] for x in surface.meets(T[None], shown, normals, gate))
        arm = frames.transform(T, shown) - frames.transform(T, centre[None])
        along = np.einsum("nj,nj->n", arm, normal)[:, None] / lever
        J = np.concatenate([np.cross(arm, normal) / lever, normal, along], axis=1)
        spread = 1.4826 * np.median(np.abs(residual[found])) if found.any() else gate
        weight = found * tukey(residual, max(spread, surface.tolerance / 4))
        H = J.T @ (weight[:, None] * J)
        step = -np.linalg.solve(H + 1e-6 * (np.trace(H) + 1e-9) * np.eye(7), J.T @ (weight * residual))
        step[[0, 1, 2, 6]] /= lever
        to = frames.make(np.eye(3), -frames.transform(T, centre[None])[0])
        T = frames.inverse(to) @ frames.exp(step[:6]) @ to @ T
        scale *= 1 + float(step[6])
    return scale


def find_copies(capture: Capture) -> list[tuple[int, int]]:
    """Pairs of views (v < w) that show the same measured points."""
    pairs = []
    for v, w in combinations(range(len(capture.scans)), 2):
        a, b = capture.scans[v].points, capture.scans[w].points
        if abs(len(a) - len(b)) <= 0.02 * max(len(a), len(b)) and _same_points(capture.scans[v], capture.scans[w]):
            pairs.append((v, w))
    return pairs


def _same_points(a: Scan, b: Scan) -> bool:
    """True if nearly every point of `a` is found in `b`, far closer than two measurements ever agree."""
    index = np.linspace(0, len(a.points) - 1, min(len(a.points), 60)).astype(int)
    distance, _ = b.tree.query(np.ascontiguousarray(a.points[index]), k=1)
    return bool(np.mean(distance < 1e-4 * b.spacing) > 0.9)


def find_same_poses(capture: Capture) -> list[tuple[int, int]]:
    """Pairs of views (v < w) with the very same pose."""
    T = capture.T_reference_mount
    return [(v, w) for v, w in combinations(range(len(T)), 2) if np.allclose(T[v], T[w], rtol=0, atol=1e-9)]
