"""What one scan shows where others look through and see nothing: a cable, an arm, a box that stood there for a while.

It belongs neither to the part nor to the scanner, stands elsewhere in every view, and is in the stitched cloud at every
place where it was seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pykdtree.kdtree import KDTree

from stitch import frames
from stitch.frames import Array, Mask
from stitch.integrity.view_names import list_views
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.match import sample_points

# Points of a scan that are asked, and other scans, evenly over the session, that are asked for each.
_OCCLUDER_PROBES, _OCCLUDER_VIEWS_COMPARED = 400, 20
# Of the part's size: what is farther from a scan's points it does not show, and what it sees farther behind it looks
# through. Where poses err or an edge is seen aslant, scans differ by less; so do those whose points lie as far apart.
_APART, _SPACINGS = 0.03, 2.0
# Nearest looks of another scan that must all pass a point.
_LOOK_DIRECTIONS = 8
# Share of a scan's points that is worth a word, and how many; scans of good sessions had 0.0025 at the most.
_OCCLUDER_MIN_SHARE, _FEWEST = 0.01, 5


@dataclass(frozen=True)
class Occluder:
    """What stands where others look through."""

    views: tuple[int, ...]
    share: float  # of the points of these views, at least: where no other scan looks, nobody can say

    def describe(self, names: Sequence[str]) -> str:
        """In words, and what to do."""
        where, verb = list_views([names[v] for v in self.views], names), "shows" if len(self.views) == 1 else "show"
        return (
            f"At least {self.share:.0%} of what {where} {verb} stands where other scans look through and see none of "
            "it: something was in the way, a cable, an arm or a clamp, or these are stray points. It is in the "
            "stitched cloud: cut it out of the scan, or scan again."
        )


def find_occluder(scans: Sequence[Scan], poses: Array, size: float) -> Occluder | None:
    """What single scans show where others look through, if that is worth a word.

    Args:
        poses: (V, 4, 4) T_reference_scanner where surfaces put the views.
        size: of the part, length_unit.
    """
    views = [v for v, scan in enumerate(scans) if len(scan.points)]
    looks = {v: KDTree(scans[v].rays(scans[v].points)) for v in views}
    shares = {}
    for v in views:
        others = [w for w in views if w != v]
        asked = [
            others[i] for i in np.linspace(0, len(others) - 1, min(len(others), _OCCLUDER_VIEWS_COMPARED)).astype(int)
        ]
        points = scans[v].points[sample_points(scans[v], _OCCLUDER_PROBES)]
        seen_from = {w: frames.inverse(poses[w]) @ poses[v] for w in asked}
        apart = {w: max(_APART * size, _SPACINGS * scans[w].spacing) for w in asked}
        # Most are shown by the first scans that are asked; only the rest can be in the way.
        alone, count = points, len(points)
        for w in asked:
            there = np.ascontiguousarray(frames.transform(seen_from[w], alone))
            alone = alone[scans[w].tree.query(there, k=1)[0] >= apart[w]] if len(alone) else alone
        through = np.zeros(len(alone), bool)
        for w in asked if len(alone) >= _FEWEST else ():
            there = np.ascontiguousarray(frames.transform(seen_from[w], alone))
            through |= _looks_through(scans[w], looks[w], there, apart[w])
        shares[v] = through.sum() / count if through.sum() >= _FEWEST else 0.0
    told = tuple(v for v, share in shares.items() if share > _OCCLUDER_MIN_SHARE)
    return Occluder(told, float(np.mean([shares[v] for v in told]))) if told else None


def _looks_through(scan: Scan, look: KDTree, points: Array, behind: float) -> Mask:
    """(n,) points in the frame of a scan all about whose direction what it sees is farther away.

    One look alone would pass an edge beside which it sees nearer: a face that the scan sees from its side stands there.
    Where that face is too steep to be seen, there are looks on one side of the point alone.
    """
    away, rays = np.linalg.norm(points - scan.eye, axis=1), scan.rays(points)
    beside, partners = look.query(rays, k=min(_LOOK_DIRECTIONS, len(scan.points)))
    beside, partners = beside.reshape(len(points), -1), partners.reshape(len(points), -1).astype(int)
    found = scan.points[partners]
    seen = np.linalg.norm(found - scan.eye, axis=2).min(axis=1)
    looks = scan.rays(found.reshape(-1, 3)).reshape(found.shape)
    near, farther = beside[:, 0] * away < _SPACINGS * scan.spacing, seen > away + behind
    return np.asarray(near & farther & _surrounded(rays, looks))


def _surrounded(rays: Array, looks: Array) -> Mask:
    """(n,) which unit vectors (n, 3) have some of others (n, k, 3) on every side: in each half of the directions."""
    across = np.linalg.svd(rays[:, None, :])[2][:, 1:]  # (n, 2, 3) perpendicular to each
    off = np.einsum("nij,nkj->nki", across, looks - rays[:, None])
    angles = np.sort(np.arctan2(off[..., 1], off[..., 0]), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi)
    return np.asarray(gaps.max(axis=1, initial=0.0) < np.pi)
