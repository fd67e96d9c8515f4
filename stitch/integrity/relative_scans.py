"""How the scanner moved between views, from the scans alone: what every hypothesis about the poses has to explain.

Neighbours in the list are registered to each other from many starts. A motion counts if the surfaces close; a
symmetric part closes in several ways, and then one of them may be the wrong one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array
from stitch.integrity.placing import Placement, place_scan, shows_no_surface, surface_of
from stitch.measurement.capture import Capture, part_size
from stitch.system.threads import parallel

# A pair counts if this share of the surface near lies on it, and this share of the scan is near.
_MIN_SCAN_CLOSURE, _SHARED = 0.75, 0.35
_SIGMAS = 6.0
# Of the spacing: how far a point lies from its neighbour's tangent plane on a curved surface.
_CURVED = 0.03
_ROW_STEPS = (1, 2)
_START_ROTATIONS_DEG = (0.0, 30.0, 60.0, 90.0, 135.0, 180.0)


@dataclass(frozen=True)
class RelativeScans:
    """M motions between pairs of views."""

    pairs: tuple[tuple[int, int], ...]
    T: Array  # (M, 4, 4) that maps view w's scanner frame into view v's


def register_scan_pairs(capture: Capture) -> RelativeScans:
    """Motions between each view and the next two of the list, without any pose."""
    size = part_size([capture])
    views = len(capture.scans)
    pairs = [(v, v + step) for step in _ROW_STEPS for v in range(views - step)]
    starts = _start_rotations()
    usable = [not shows_no_surface(scan) for scan in capture.scans]
    tried = [(v, w) for v, w in pairs if usable[v] and usable[w]]
    found = list(parallel(lambda pair: _motion_between(capture, *pair, starts, size), tried, "pairs of scans"))
    good = [i for i, best in enumerate(found) if best.closure > _MIN_SCAN_CLOSURE and best.near > _SHARED]
    motions = np.array([found[i].T for i in good]).reshape(-1, 4, 4)
    return RelativeScans(tuple(tried[i] for i in good), motions)


def _motion_between(capture: Capture, v: int, w: int, turns: Array, size: float) -> Placement:
    scan, other = capture.scans[w], capture.scans[v]
    tolerance = _SIGMAS * float(np.hypot(scan.noise, other.noise)) / 2 + _CURVED * other.spacing
    surface = surface_of(capture.scans, np.tile(np.eye(4), (len(capture.scans), 1, 1)), [v], tolerance)
    own, there = scan.points.mean(axis=0), other.points.mean(axis=0)
    starts = frames.make(turns, there - turns @ own)
    return place_scan(scan, surface, starts, size)[0]


def _start_rotations() -> Array:
    """(S, 3, 3) rotations: none, and about twelve axes."""
    golden = (1 + np.sqrt(5)) / 2
    axes = np.array([p for a in (-1, 1) for b in (-golden, golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = [a * np.radians(angle) for angle in _START_ROTATIONS_DEG[1:] for a in axes]
    return np.asarray(Rotation.from_rotvec(np.array([np.zeros(3), *vectors])).as_matrix())
