"""Sampled points of all views, placed in the reference frame once, and their search for nearest points of a view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.scan import Scan

# Two patches whose normals differ by more than 45° are not the same surface.
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Some of a view's sampled points.
QueryPart = tuple[int, slice]


@dataclass(frozen=True)
class NeighbourQueries:
    """V views under one set of poses, and n points of each that look for partners."""

    scans: Sequence[Scan]
    poses: Array  # (V, 4, 4) T_reference_scanner
    index: Sequence[Indices]  # per view (n,)
    points: list[Array]  # per view (n, 3), reference frame
    normals: list[Array]  # per view (n, 3), reference frame

    def gather(self, parts: Sequence[QueryPart]) -> tuple[Indices, Array, Array]:
        """Index, point and normal of some points of several views, one view after the other."""
        points, normals = (np.concatenate([own[v][at] for v, at in parts]) for own in (self.points, self.normals))
        return np.concatenate([self.index[v][at] for v, at in parts]), points, normals

    def counts(self, parts: Sequence[QueryPart]) -> list[int]:
        """How many points each part holds."""
        return [len(range(*at.indices(len(self.index[v])))) for v, at in parts]

    def search(self, w: int, points: Array, normals: Array, gate: float) -> tuple[Array, Indices, NDArray[np.bool_]]:
        """Of N points each (N,): distance (inf where none), index of the partner and whether it may be used.

        Args:
            w: the view in which partners are sought.
            points, normals: (N, 3) reference frame.
            gate: farthest partner, length_unit.
        """
        scan, T = self.scans[w], frames.inverse(self.poses[w])
        # The trees stay in their scanner's frame; the queries travel.
        query = np.ascontiguousarray(frames.transform(T, points))
        distance, partner = scan.tree.query(query, k=1, distance_upper_bound=gate)
        found = np.isfinite(distance)
        partner = np.where(found, partner, 0).astype(np.int64)
        cosine = np.einsum("ij,ij->i", frames.rotate(T, normals), scan.normals[partner])
        return distance, partner, found & scan.usable[partner] & (cosine > _NORMAL_COSINE)


def neighbour_queries(scans: Sequence[Scan], poses: Array, samples: Sequence[Indices]) -> NeighbourQueries:
    """Sampled points of every view under T_reference_scanner (V, 4, 4)."""
    every = list(zip(scans, poses, samples, strict=True))
    points = [frames.transform(T, scan.points[index]) for scan, T, index in every]
    return NeighbourQueries(
        scans, poses, samples, points, [frames.rotate(T, scan.normals[index]) for scan, T, index in every]
    )
