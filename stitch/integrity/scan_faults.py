"""What can be wrong with one scan so that it closes nowhere: mirrored, scaled, in another unit; or a copy of another."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch.frames import Array
from stitch.integrity.hypotheses import UNITS
from stitch.integrity.placing import Surface, judge, place, starts_about
from stitch.measurement.capture import Capture
from stitch.measurement.scan import Scan, prepare_view

# Reflections of the scanner frame, with what was done.
_FLIPS = {
    "x has the wrong sign": np.diag([-1.0, 1, 1]),
    "y has the wrong sign": np.diag([1.0, -1, 1]),
    "z has the wrong sign": np.diag([1.0, 1, -1]),
    "x and y are exchanged": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    "y and z are exchanged": np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "x and z are exchanged": np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]),
}
# Factors near one that a wrong calibration or shrinkage makes.
_SCALES = np.geomspace(0.8, 1.25, 31)
_NEAR_ONE = 1e-3


@dataclass(frozen=True)
class ScanFault:
    """A scan that closes on the others once this is undone."""

    kind: str  # mirrored | scale | unit
    fix: str


def scan_fault(scan: Scan, T_pose: Array, surface: Surface, size: float, needed: float) -> ScanFault | None:
    """What makes a scan close on the surface of the others, at its pose or near it; None if nothing does.

    Args:
        T_pose: (4, 4) T_reference_scanner from the robot.
        size: of the part, length_unit.
        needed: closure that counts as closed.
    """

    def closes(points: Array, wide: bool) -> float:
        other = prepare_view(scan.name, points)
        found = [judge(other, T_pose, surface)]
        if wide:
            found += place(other, surface, starts_about(T_pose, other, size), size)[:1]
        return max(f.closure if f.near > 0.3 else 0.0 for f in found)

    for words, flip in _FLIPS.items():
        if closes(scan.points @ flip, True) > needed:
            return ScanFault("mirrored", f"{words} in this cloud: export it again")
    for factor, words in UNITS.items():
        if closes(scan.points * factor, True) > needed:
            return ScanFault("unit", f"this cloud is in another unit ({words}): multiply it by {factor:.6g}")
    if scan.tree.n < 20:
        return None
    first = [closes(scan.points * s, False) for s in _SCALES]
    about = _SCALES[np.argsort(first)[-3:]]
    fine = np.geomspace(about.min() / 1.008, about.max() * 1.008, 40)
    found = [closes(scan.points * s, False) for s in fine]
    best = float(fine[int(np.argmax(found))])
    closed = max(max(found), closes(scan.points * best, True))
    if closed > needed and abs(best - 1) > _NEAR_ONE:
        return ScanFault("scale", f"this cloud is {1 / best:.4g} times too large: multiply it by {best:.5g}")
    return None


def copies(capture: Capture) -> list[tuple[int, int]]:
    """Pairs of views (v < w) that show the same measured points."""
    pairs = []
    for v, w in combinations(range(len(capture.scans)), 2):
        a, b = capture.scans[v].points, capture.scans[w].points
        if abs(len(a) - len(b)) <= 0.02 * max(len(a), len(b)) and _same(capture.scans[v], capture.scans[w]):
            pairs.append((v, w))
    return pairs


def _same(a: Scan, b: Scan) -> bool:
    """True if nearly every point of `a` is found in `b`, far closer than two measurements ever agree."""
    index = np.linspace(0, len(a.points) - 1, min(len(a.points), 60)).astype(int)
    distance, _ = b.tree.query(np.ascontiguousarray(a.points[index]), k=1)
    return bool(np.mean(distance < 1e-4 * b.spacing) > 0.9)


def same_poses(capture: Capture) -> list[tuple[int, int]]:
    """Pairs of views (v < w) with the very same pose."""
    T = capture.T_reference_mount
    return [(v, w) for v, w in combinations(range(len(T)), 2) if np.allclose(T[v], T[w], rtol=0, atol=1e-9)]
