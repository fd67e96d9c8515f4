"""The rigid motion between two sets of points: of partners in closed form; of surfaces from their shape alone.

Surfaces need no first guess: fast point feature histograms (FPFH; Rusu, Blodow & Beetz 2009) say how the surface bends
around each point, whatever the frame. Points whose histograms are each other's nearest are tentative partners; triples
of partners propose motions, the one that the partners agree with best wins (RANSAC), and ICP refines it. Draws are
seeded and each sum has one order, so the same surfaces give the same motion, bit for bit.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices

_BINS = 11
_NEIGHBOURS = 100
_MIN_SAMPLE = 3
# Edges of a triple that differ by more than a tenth between the surfaces are no rigid copy.
_EDGE_RATIO = 0.9
_ICP_STEPS = 30
# Motions judged at once: bounds the memory.
_BLOCK = 200


def align_points(points: Array, targets: Array, weights: Array | None = None) -> Array:
    """Return the rigid motions T (..., 4, 4) that minimise Σ wᵢ |T·pointᵢ − targetᵢ|².

    By singular value decomposition (Arun, Huang & Blostein 1987).

    Args:
        points, targets: (..., N, 3), in their own frames: T maps the frame of the points into that of the targets.
        weights: (N,) w; None: all are equal.
    """
    share = np.full(points.shape[-2], 1.0) if weights is None else weights
    share = (share / share.sum())[:, None]
    mean_point, mean_target = ((share * x).sum(axis=-2) for x in (points, targets))
    covariance = np.swapaxes(share * (targets - mean_target[..., None, :]), -1, -2) @ (
        points - mean_point[..., None, :]
    )
    R = frames.nearest_rotation(covariance)
    return frames.make(R, mean_target - (R @ mean_point[..., None])[..., 0])


@dataclass(frozen=True)
class FeaturedSurface:
    """A surface of N points with the histograms that tell its points apart."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3) unit
    histograms: Array  # (N, 33)
    tree: Any  # pykdtree KDTree over `points`


def voxel_downsample(points: Array, normals: Array, size: float) -> tuple[Array, Array]:
    """Return the mean point (M, 3) and the unit mean normal (M, 3) of every voxel that holds points.

    Args:
        points, normals: (N, 3), one frame; normals of unit length.
        size: edge of a voxel, in the unit of the points.
    """
    _, voxel = np.unique(np.floor((points - points.min(axis=0)) / size).astype(int), axis=0, return_inverse=True)
    voxel = voxel.ravel()
    count = np.bincount(voxel)

    def mean(values: Array) -> Array:
        """Return the mean (M, 3) over the points of each voxel."""
        return np.stack([np.bincount(voxel, column, len(count)) for column in values.T], axis=1) / count[:, None]

    return mean(points), _unit(mean(normals))


def compute_fpfh(points: Array, normals: Array, radius: float) -> FeaturedSurface:
    """Return a surface with the fast point feature histogram (FPFH, 33 bins) of each of its points.

    A point's own histogram of angles to its neighbours, plus theirs weighted by 1/distance²; both scaled to the same
    sum.

    Args:
        points, normals: (N, 3), one frame; normals of unit length.
        radius: neighbours are the nearest points within it, 99 at most; in the unit of the points.
    """
    points = np.ascontiguousarray(points, float)
    tree = KDTree(points)
    count = min(_NEIGHBOURS, len(points))
    distance, index = (a.reshape(len(points), count) for a in tree.query(points, k=count, distance_upper_bound=radius))
    point, column = np.nonzero(np.isfinite(distance) & (distance > 0))
    neighbour = index[point, column].astype(int)
    # `point` and `neighbour` (P,) list all pairs; each point's query also found the point itself, at distance 0.
    own = _angle_histograms(points, normals, point, neighbour)
    weight = 1 / distance[point, column] ** 2
    sums = [np.bincount(point, weight * of_bin[neighbour], len(points)) for of_bin in own.T]
    of_neighbours: Array = np.stack(sums, axis=1).astype(float)
    return FeaturedSurface(points, normals, _normalised(own) + _normalised(of_neighbours), tree)


def register_ransac(source: FeaturedSurface, target: FeaturedSurface, reach: float, draws: int, seed: int = 0) -> Array:
    """Return the motion T (4, 4) that maps `source` onto `target`, by RANSAC (Fischler & Bolles 1981).

    Points whose histograms match are partners. Triples of partners drawn at random propose motions; the one with the
    least cost over all partners is returned (`_msac_costs`).

    Args:
        reach: largest distance of two partners under the right motion, in the unit of the points.
        draws: number of triples.
        seed: of the random draws.

    Returns:
        The identity where no triple has the same shape in both surfaces.
    """
    in_source, in_target = _partners(source.histograms, target.histograms)
    a, b = source.points[in_source], target.points[in_target]
    triples = np.random.default_rng(seed).integers(len(a), size=(draws, _MIN_SAMPLE))
    # Only triples whose edges have the same lengths in both surfaces can be a rigid copy.
    edges = [np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2) for p in (a[triples], b[triples])]
    triples = triples[(np.minimum(*edges) > _EDGE_RATIO * np.maximum(*edges)).all(axis=1)]
    T = align_points(a[triples], b[triples])
    moved = a[triples] @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    T = T[np.linalg.norm(moved - b[triples], axis=2).max(axis=1, initial=0.0) < reach]
    if not len(T):
        return np.eye(4)
    best: Array = T[np.argmin(_msac_costs(T, a, b, reach))]
    return best


def align_icp(source: FeaturedSurface, target: FeaturedSurface, T: Array, reach: float) -> Array:
    """Return the motion (4, 4) that maps `source` onto `target` after point-to-plane ICP (Chen & Medioni 1992).

    It ends when a step is tiny, after `_ICP_STEPS` steps, or where fewer than 6 points have a partner, too few for six
    unknowns; the last motion is returned in any case.

    Args:
        T: (4, 4) motion to begin with.
        reach: largest distance between partners, in the unit of the points.
    """
    for _ in range(_ICP_STEPS):
        moved = frames.transform(T, source.points)
        distance, index = target.tree.query(moved, k=1, distance_upper_bound=reach)
        near = np.isfinite(distance)
        if near.sum() < 6:
            break
        place, n = target.points[index[near].astype(int)], target.normals[index[near].astype(int)]
        residual = np.einsum("ij,ij->i", moved[near] - place, n)
        # Turning about the points' own centre keeps turn and shift apart.
        centre = frames.make(np.eye(3), moved[near].mean(axis=0))
        design = frames.plane_rows(moved[near] - centre[:3, 3], n)
        step = np.linalg.lstsq(design, -residual, rcond=1e-6)[0]
        T = centre @ frames.exp(step) @ frames.inverse(centre) @ T
        if np.linalg.norm(step[3:]) < 1e-6 * reach and np.linalg.norm(step[:3]) < 1e-7:
            break
    return T


def _angle_histograms(points: Array, normals: Array, point: Indices, neighbour: Indices) -> Array:
    """Return histograms (N, 33) of three angles between each point's normal and those of its neighbours, 11 bins each.

    The angles θ, arccos α and arccos φ of Rusu, Blodow & Beetz 2009, by the cosines of the latter two; each histogram
    sums to 100.

    Args:
        points, normals: (N, 3), normals of unit length.
        point, neighbour: (P,) indices of the two points of each pair.
    """
    line = _unit(points[neighbour] - points[point])
    first, second = normals[point], normals[neighbour]
    # The frame sits on that of the two points whose normal lies closer to the line between them.
    swap = np.abs(np.einsum("ij,ij->i", first, line)) < np.abs(np.einsum("ij,ij->i", second, line))
    first, second = np.where(swap[:, None], second, first), np.where(swap[:, None], first, second)
    line = np.where(swap[:, None], -line, line)
    v = _unit(np.cross(line, first))
    w = np.cross(first, v)
    theta = np.arctan2(np.einsum("ij,ij->i", w, second), np.einsum("ij,ij->i", first, second))
    cosines = np.einsum("ij,ij->i", v, second), np.einsum("ij,ij->i", first, line)
    histograms = []
    for share in (theta / (2 * np.pi) + 0.5, *((cosine + 1) / 2 for cosine in cosines)):
        bins = np.clip((share * _BINS).astype(int), 0, _BINS - 1)
        histograms.append(np.bincount(point * _BINS + bins, minlength=len(points) * _BINS).reshape(-1, _BINS))
    return _normalised(np.hstack(histograms).astype(float))


def _normalised(histograms: Array) -> Array:
    """Return histograms (N, 33), each of a point's three scaled to sum 100; without neighbours they stay 0."""
    parts = histograms.reshape(len(histograms), 3, _BINS)
    total = parts.sum(axis=2, keepdims=True)
    return (100 * parts / np.where(total > 0, total, 1)).reshape(len(histograms), -1)


def _unit(vectors: Array) -> Array:
    """Return vectors (N, 3) divided by their lengths; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _partners(a: Array, b: Array) -> tuple[Indices, Indices]:
    """Return indices (K,) into histograms a (N, 33) and (K,) into b (M, 33) of pairs that are each other's nearest.

    Where they are fewer than three triples need: each of a, and its nearest of b.
    """
    nearest_in_b = KDTree(b).query(a, k=1)[1].astype(int)
    nearest_in_a = KDTree(a).query(b, k=1)[1].astype(int)
    index = np.arange(len(a))
    mutual = nearest_in_a[nearest_in_b] == index
    return (index[mutual], nearest_in_b[mutual]) if mutual.sum() >= 3 * _MIN_SAMPLE else (index, nearest_in_b)


def _msac_costs(T: Array, a: Array, b: Array, reach: float) -> Array:
    """Return Σ min(|T·a − b|², reach²) over partners for each of K motions: (K,); MSAC, Torr & Zisserman 2000.

    Args:
        T: (K, 4, 4).
        a, b: (P, 3) partners; T maps the frame of a into that of b.
    """
    costs = []
    for block in np.array_split(T, len(T) // _BLOCK + 1):
        # One product for all motions: its rows are the three coordinates of each.
        off = (block[:, :3, :3].reshape(-1, 3) @ a.T).reshape(len(block), 3, len(a)) + block[:, :3, 3:] - b.T
        costs.append(np.minimum(np.einsum("kij,kij->kj", off, off), reach**2).sum(axis=1))
    return np.concatenate(costs)
