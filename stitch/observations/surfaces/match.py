"""Correspondences between views: KD-tree search in both directions, gated by distance and normal."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.bounding_box import box_of, corners
from stitch.measurement.scan import Scan, evenly
from stitch.system.threads import parallel

# Two patches whose normals differ by more than 45° are not the same surface.
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Queries that decide whether two views overlap, and the share that must find a partner.
_PROBES = 250
# Views in which one point of another view is asked for.
MOST_PARTNERS = 12
_MINIMUM_OVERLAP = 0.04


@dataclass(frozen=True)
class Match:
    """Correspondences of one pair of views, in the reference frame; both search directions."""

    v: int
    w: int
    middle: Array  # (M, 3) midpoint of the two points
    normal: Array  # (M, 3) unit, mean of the two normals
    residual: Array  # (M,) signed distance (p_v − p_w)·normal
    weight: Array  # (M,) confidence × surface per point, mean 1 over the scan
    index_v: Indices  # (M,) point of view v
    index_w: Indices  # (M,) point of view w

    def part(self, at: slice) -> "Match":
        """Some of them."""
        return Match(self.v, self.w, *(value[at] for value in list(vars(self).values())[2:]))


def sample(scan: Scan, count: int) -> Indices:
    """(n,) indices of at most `count` usable points, evenly over the scan order; the same every time."""
    usable: Indices = np.flatnonzero(scan.usable).astype(np.int64)
    if len(usable) <= count:
        return usable
    picked: Indices = usable[evenly(len(usable), count)]
    return picked


def overlapping_pairs(
    scans: Sequence[Scan], poses: Array, gate: float, at_most: int = _PROBES
) -> list[tuple[int, int]]:
    """Pairs (v < w) of which at least 4 % of the probed points meet; poses T_reference_scanner.

    Args:
        at_most: points of a view that are probed; more than 250 tell nothing new.
    """
    probes = [sample(scan, min(at_most, _PROBES)) for scan in scans]

    def overlap(pair: tuple[int, int]) -> bool:
        for a, b in (pair, pair[::-1]):
            if len(probes[a]):
                _, _, agree = search(scans[a], scans[b], probes[a], poses[a], poses[b], gate)
                if np.mean(agree) >= _MINIMUM_OVERLAP:
                    return True
        return False

    pairs = near_pairs(scans, poses, gate)
    return [pair for pair, meets in zip(pairs, parallel(overlap, pairs), strict=True) if meets]


def near_pairs(scans: Sequence[Scan], poses: Array, gate: float) -> list[tuple[int, int]]:
    """Pairs (v < w) whose bounding boxes come within `gate`: no others can have partners."""
    placed = [frames.transform(T, corners(box_of(scan.points))) for scan, T in zip(scans, poses, strict=True)]
    low, high = np.min(placed, axis=1), np.max(placed, axis=1)
    apart = (low[:, None] - high[None] > gate).any(axis=2)
    v, w = np.nonzero(np.triu(~(apart | apart.T), 1))
    return list(zip(v.tolist(), w.tolist(), strict=True))


def match(
    scans: Sequence[Scan],
    poses: Array,
    pairs: Sequence[tuple[int, int]],
    gate: float,
    samples: Sequence[Indices],
    partners: int = MOST_PARTNERS,
) -> Iterator[Match]:
    """Stream the correspondences of `pairs`: each sampled point with its nearest point of the other.

    Where a view overlaps with more than `partners` others, its points take turns: each is asked for in so many of them.
    What a point says of its own view it says to the first few already, so that many views cost what they are and not
    their square.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        gate: largest distance between partners, length_unit.
        samples: per view the indices that search (see `sample`).
    """

    turns = -(-np.bincount(np.array(pairs, int).ravel(), minlength=len(scans)) // partners)

    def of_pair(pair: tuple[int, int]) -> Match | None:
        v, w = pair
        from_v = _partners(scans, poses, samples[v][w % turns[v] :: turns[v]], v, w, gate)
        from_w = _partners(scans, poses, samples[w][v % turns[w] :: turns[w]], w, v, gate)
        index_v = np.concatenate([from_v[0], from_w[1]])
        index_w = np.concatenate([from_v[1], from_w[0]])
        return _measure(scans, poses, v, w, index_v, index_w) if len(index_v) else None

    return (found for found in parallel(of_pair, pairs) if found is not None)


def search(
    scan: Scan, other: Scan, index: Indices, T_scan: Array, T_other: Array, gate: float
) -> tuple[Array, Indices, NDArray[np.bool_]]:
    """Of n points each (n,): distance (inf where none), index of the partner and whether it may be used.

    Args:
        index: (n,) points of the scan that look for a partner.
        T_scan, T_other: (4, 4) T_reference_scanner of the two views.
        gate: farthest partner, length_unit.
    """
    # The trees stay in their scanner's frame; the queries travel.
    T_other_scan = frames.inverse(T_other) @ T_scan
    query = np.ascontiguousarray(frames.transform(T_other_scan, scan.points[index]))
    distance, partner = other.tree.query(query, k=1, distance_upper_bound=gate)
    found = np.isfinite(distance)
    partner = np.where(found, partner, 0).astype(np.int64)
    normal = frames.rotate(T_other_scan, scan.normals[index])
    cosine = np.einsum("ij,ij->i", normal, other.normals[partner])
    return distance, partner, found & other.usable[partner] & (cosine > _NORMAL_COSINE)


def distances(matches: Sequence[Match], poses: Array, points: Sequence[Array]) -> Array:
    """(M,) signed distances of all correspondences, v less w along their normals, with the views elsewhere.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        points: (N, 3) of every scan, scanner frame.
    """
    out = []
    for m in matches:
        p = frames.transform(poses[m.v], points[m.v][m.index_v])
        q = frames.transform(poses[m.w], points[m.w][m.index_w])
        out.append(np.einsum("ij,ij->i", p - q, m.normal))
    return np.concatenate(out)


def _partners(
    scans: Sequence[Scan], poses: Array, index: Indices, a: int, b: int, gate: float
) -> tuple[Indices, Indices]:
    """Indices (of view a, of view b) of the accepted correspondences."""
    if not len(index):
        return index, index
    _, partner, accept = search(scans[a], scans[b], index, poses[a], poses[b], gate)
    return index[accept], partner[accept]


def _measure(scans: Sequence[Scan], poses: Array, v: int, w: int, index_v: Indices, index_w: Indices) -> Match:
    p = frames.transform(poses[v], scans[v].points[index_v])
    q = frames.transform(poses[w], scans[w].points[index_w])
    normal = frames.rotate(poses[v], scans[v].normals[index_v])
    normal += frames.rotate(poses[w], scans[w].normals[index_w])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    weight = scans[v].confidence[index_v] * scans[w].confidence[index_w]
    residual = np.einsum("ij,ij->i", p - q, normal)
    return Match(v, w, (p + q) / 2, normal=normal, residual=residual, weight=weight, index_v=index_v, index_w=index_w)
