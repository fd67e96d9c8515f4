"""A view made ready for matching, once: KD-tree, normals, edges, spacing and noise, scanner frame."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.numerics.frames import Array, Indices, Mask
from stitch.system.values import take_rows

# Neighbours of a point's local plane: enough to average the noise, few enough to follow a fillet. To the quadric of the
# noise estimate, of six coefficients, they leave ten degrees of freedom, and stay within one curve of the surface where
# a thin part is scanned in coarse steps.
_NEIGHBOURS = 16
_NOISE_SAMPLES = 1500
# Points whose neighbourhoods are worked on at a time: as many as stay in a core's cache.
_IN_CACHE = 4096
# Beyond 75° between ray and normal, range cameras smear; beyond 0.35 of the neighbourhood's
# radius, the centroid has left the point: the surface ends here.
GRAZING_COSINE = np.cos(np.radians(75.0))
_EDGE_OFFSET = 0.35
# A surface bends where a plane leaves so many times the noise: then it leaves as much of the bend as of the noise.
_BENT = 2**0.5
# Surface variation λ₀/(λ₀+λ₁+λ₂) of a crease (Pauly et al. 2002); a plane has 0.
_CREASE_VARIATION = 0.05
# Share of the largest eigenvalue's square by which a plane stands out from a line; below it digits are lost.
_CLEARLY_PLANE = 1e-3
# Weight of a quadric's terms being zero, as a share of their squares: what neighbours hardly show beside the rest stays
# zero, as how a surface bends between two profiles, whatever the axes.
_NOT_SHOWN = 0.01
# Of the largest square, what rounding makes of none.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Stock:
    """A surface of a scan that stood off along its normals, as stock on a casting or a scanner's zero do."""

    thickness: float  # length_unit, outwards
    sigma: float
    share: float  # of the scan's surface
    points: Mask  # (N,) which of its points


@dataclass(frozen=True)
class Scan:
    """One view in the scanner frame, length_unit; arrays of N points, float64."""

    name: str
    points: Array  # (N, 3)
    normals: Array  # (N, 3) unit, towards the scanner
    usable: Array  # (N,) bool: neither edge nor crease nor grazing
    area: Array  # (N,) surface per point: the inverse of the local density
    confidence: Array  # (N,) cosine of incidence
    tree: Any = field(repr=False, compare=False)  # pykdtree KDTree over `points`
    spacing: float  # median distance between neighbours
    scanned_spacing: float  # the same between all points that were scanned, of which these may be some
    noise: float  # 1-sigma across the surface, from the scan itself
    eye: Array  # (3,) from where the scanner looks
    stock: Stock | None = None  # taken off its points

    def __getstate__(self) -> dict[str, Any]:
        """Leave the tree out of pickles and copies: it is made of the points when it is asked for."""
        return {name: value for name, value in vars(self).items() if name != "tree"}

    def __getattr__(self, name: str) -> Any:
        if name != "tree" or "points" not in vars(self):
            raise AttributeError(name)
        tree = vars(self)["tree"] = KDTree(self.points, leafsize=16)
        return tree

    @cached_property
    def box(self) -> Array:
        """(2, 3) lowest and highest corner of the points."""
        return bounding_box(self.points)

    @cached_property
    def size(self) -> float:
        """Diameter of the points, length_unit: twice their rms distance from their centroid."""
        return 2 * spread(self.points)

    @cached_property
    def solid_angle(self) -> float:
        """Median solid angle, seen from the eye, that a point on a smooth surface has for itself."""
        smooth = self.usable if self.usable.any() else np.ones_like(self.usable)
        away = self.points[smooth] - self.eye
        each = (self.area * self.confidence)[smooth] / np.einsum("ij,ij->i", away, away)
        return float(np.median(each))

    def rays(self, points: Array) -> Array:
        """Return (N, 3) unit vectors from the eye to points (N, 3), scanner frame."""
        return _rays_to(points, self.eye)


@dataclass(frozen=True)
class Neighbourhoods:
    """The points that are nearest to each of n points, itself the first."""

    tree: Any  # pykdtree KDTree over all points
    index: Indices  # (n, k)
    radius: Array  # (n,) distance to the farthest of them
    spacing: float  # median distance to the nearest one, length_unit


def without_stock(scan: Scan, stock: Stock | None) -> Scan:
    """Return the scan with stock taken off: points on it moved back along their normals; None: with what was taken."""
    taken = stock or scan.stock
    assert taken is not None
    outwards = taken.points[:, None] * (taken.thickness if stock else -taken.thickness)
    points = scan.points - outwards * scan.normals
    return replace(scan, points=points, tree=KDTree(points, leafsize=16), stock=stock)


def prepare_scan(
    name: str,
    points: Array,
    picked: Indices | None = None,
    eye: Array | None = None,
    around: Neighbourhoods | None = None,
) -> Scan:
    """Return one scan with KD-tree, normals, edges, spacing and noise.

    A normal is that of the local plane of 16 neighbours, or of a quadric where that bends.

    Args:
        picked: indices of the points that the scan keeps; normals, edges and noise are those of all points.
        eye: (3,) from where the scanner looks, its own frame; the origin unless stated.
        around: what `find_neighbourhoods` makes of the points, where that has been asked already.
    """
    points = np.ascontiguousarray(points, float)
    own = points if picked is None or len(picked) == len(points) else points[picked]
    around = around or find_neighbourhoods(points, picked)
    tree, index, radius = around.tree, around.index, around.radius
    centroid, normals, variation, left = fit_planes(points, index)
    eye = np.zeros(3) if eye is None else eye
    rays = _rays_to(own, eye)
    usable = (np.abs(np.einsum("ij,ij->i", normals, rays)) > GRAZING_COSINE) & (variation < _CREASE_VARIATION)
    usable &= np.linalg.norm(centroid - own, axis=1) < _EDGE_OFFSET * radius
    # Across an edge no quadric fits: there the surface would count as noise.
    smooth = usable if usable.any() else np.ones_like(usable)
    noise = _estimate_noise(points, own[smooth], normals[smooth], index[smooth])
    bent = np.flatnonzero(smooth & (left > _BENT * noise))
    normals[bent] = _bent_normals(points, own[bent], normals[bent], index[bent])
    cosine = np.einsum("ij,ij->i", normals, rays)
    normals *= -np.sign(cosine)[:, None]
    confidence = np.abs(cosine)
    usable &= confidence > GRAZING_COSINE
    spacing = scanned_spacing = around.spacing
    if len(own) < len(points):
        tree = KDTree(own, leafsize=16)
        spacing = _estimate_spacing(own, tree)
    area = np.pi * radius**2 / index.shape[1] * (len(points) / len(own))
    return Scan(
        name=name,
        points=own,
        normals=normals,
        usable=usable,
        area=area,
        confidence=confidence,
        tree=tree,
        spacing=spacing,
        scanned_spacing=scanned_spacing,
        noise=noise,
        eye=eye,
    )


def find_neighbourhoods(points: Array, picked: Indices | None = None) -> Neighbourhoods:
    """Return the neighbourhoods of all points of a scan, or of those that are picked."""
    points = np.ascontiguousarray(points, float)
    tree = KDTree(points, leafsize=16)
    queried = points if picked is None or len(picked) == len(points) else points[picked]
    distance, index = tree.query(queried, k=min(_NEIGHBOURS, len(points)))
    return Neighbourhoods(tree, index, np.array(distance[:, -1]), float(np.median(distance[:, 1])))


def subsample(scan: Scan, at_most: int) -> Scan:
    """Return the scan with at most `at_most` of its points, evenly over the scan order, and a tree over those alone."""
    if len(scan.points) <= at_most:
        return scan
    picked = even_indices(len(scan.points), at_most)
    few = take_rows(scan, picked, "points", "normals", "usable", "area", "confidence")
    tree = KDTree(few.points, leafsize=16)
    area = few.area * (len(scan.points) / at_most)
    return replace(few, area=area, tree=tree, spacing=_estimate_spacing(few.points, tree))


def even_indices(count: int, at_most: int) -> Indices:
    """Return (n,) at most `at_most` of `count` indices, evenly from the first to the last."""
    return np.linspace(0, count - 1, min(count, at_most)).astype(np.int64)


def _rays_to(points: Array, eye: Array) -> Array:
    """Return (N, 3) unit vectors from an eye (3,) to points (N, 3)."""
    away = points - eye
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)


def _estimate_spacing(points: Array, tree: Any) -> float:
    distance, _ = tree.query(points, k=2)
    return float(np.median(distance[:, 1]))


def fit_planes(points: Array, index: Indices) -> tuple[Array, Array, Array, Array]:
    """Fit planes to neighbourhoods, rows (N, k) of points.

    Returns:
        Centroids (N, 3), unit normals (N, 3), surface variation (N,) and 1-sigma about the plane (N,).
    """
    centroid, normals = np.empty((len(index), 3)), np.empty((len(index), 3))
    variation, left = np.empty(len(index)), np.empty(len(index))
    columns = np.ascontiguousarray(points.T)
    for start in range(0, len(index), _IN_CACHE):
        at = slice(start, start + _IN_CACHE)
        # Neighbours first: sums over sixteen numbers in a row take twice as long.
        rows = np.ascontiguousarray(index[at].T)
        around = np.array([column[rows] for column in columns])
        middle = around.mean(axis=1)
        around -= middle[:, None]
        C = np.empty((3, 3, rows.shape[1]))
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            C[i, j] = C[j, i] = np.einsum("kn,kn->n", around[i], around[j])
        centroid[at] = middle.T
        normals[at], variation[at] = _weakest_directions(C)
        left[at] = np.sqrt(np.maximum(variation[at], 0) * np.trace(C) / max(len(rows) - 3, 1))
    return centroid, normals, variation, left


def _weakest_directions(C: Array) -> tuple[Array, Array]:
    """Return eigenvectors (N, 3) of the smallest eigenvalues of covariances (3, 3, N), and their share (N,) of traces.

    The eigenvalues are the roots of a cubic, by its angle (Smith 1961); all rows of C − λ lie across the eigenvector.
    """
    scaled = C / np.maximum(np.trace(C), 1e-300)
    mean, one = np.trace(scaled) / 3, np.eye(3)[:, :, None]
    off = scaled - one * mean
    p = np.maximum(np.sqrt((off**2).sum(axis=(0, 1)) / 6), 1e-100)
    det = (off[0] * _cross(off[1], off[2])).sum(axis=0)
    angle = np.arccos(np.clip(det / (2 * p**3), -1.0, 1.0)) / 3
    smallest, largest = (mean + 2 * p * np.cos(angle + turn) for turn in (2 * np.pi / 3, 0.0))
    left = scaled - one * smallest
    across = np.array([_cross(left[i], left[j]) for i, j in ((0, 1), (1, 2), (2, 0))])
    square = (across**2).sum(axis=1)
    best = square.argmax(axis=0)
    every = np.arange(len(best))
    length = np.sqrt(square[best, every])
    normals = across[best, :, every] / np.maximum(length, 1e-300)[:, None]
    unclear = np.flatnonzero(length <= _CLEARLY_PLANE * largest**2)
    if len(unclear):
        values, vectors = np.linalg.eigh(scaled[:, :, unclear].transpose(2, 0, 1))
        normals[unclear], smallest[unclear] = vectors[:, :, 0], values[:, 0]
    return normals, smallest


def _estimate_noise(points: Array, own: Array, normals: Array, index: Indices) -> float:
    """Return 1-sigma of the points across a local quadric: median over some of the neighbourhoods of `own`.

    A plane would count curvature as noise. White noise only: an error that is smooth over the
    neighbourhood moves the quadric with it and is not seen.
    """
    count = index.shape[1]
    if count <= 8:
        return float("nan")
    centre = even_indices(len(own), _NOISE_SAMPLES)
    rest, _, numbers = _fit_quadrics(points, own[centre], normals[centre], index[centre])
    degrees = count - numbers()
    variance = (rest**2).sum(axis=0) / degrees
    # The median of χ²/ν lies at (1 − 2/(9ν))³ of the mean (Wilson–Hilferty).
    return float(np.sqrt(np.median(variance / (1 - 2 / (9 * degrees)) ** 3)))


def _bent_normals(points: Array, own: Array, normals: Array, index: Indices) -> Array:
    """Return (N, 3) unit normals of local quadrics at points `own` (N, 3), from those of the local planes.

    A scanner sees a bent surface in closer steps where it looks at it straight. The plane of a point's neighbours is
    that of a place nearer to there: normals at a slant lean towards the scanner, by some hundredths of a radian.
    """
    out = np.empty_like(normals)
    for start in range(0, len(own), _IN_CACHE):
        at = slice(start, start + _IN_CACHE)
        out[at] = _fit_quadrics(points, own[at], normals[at], index[at])[1]
    return out


def _fit_quadrics(
    points: Array, own: Array, normals: Array, index: Indices
) -> tuple[Array, Array, Callable[[], Array]]:
    """Return what quadrics through N points leave of their k neighbours, and how they bend.

    Returns:
        Distances (k, N) from the quadrics along the normals, length_unit; unit normals (N, 3) of the quadrics at the
        points; and a function that returns how many numbers (N,) each quadric took.

    With c the coefficients of x, y, x², √2·xy, y², S their normal matrix beside a constant and W its blocks of first
    and of second order without: c = (S + μW)⁻¹q, and again for what is left (iterated Tikhonov).
    """
    local = np.array([column[index.T] for column in points.T]) - own.T[:, None]
    n = normals.T
    a = _cross(n, np.where(np.abs(n[0]) < 0.7, [[1.0], [0.0], [0.0]], [[0.0], [1.0], [0.0]]))
    # A point that is seen edge-on has no normal.
    a /= np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    b = _cross(n, a)
    x, y, rest = (np.einsum("in,ikn->kn", axis, local) for axis in (a, b, n))
    scale = np.sqrt(np.maximum((x * x + y * y).max(axis=0), 1e-300))
    x, y = x / scale, y / scale
    terms = np.array([x, y, x * x, np.sqrt(2) * x * y, y * y])
    whole = _normal_matrices(terms)
    whole[:2, 2:] = whole[2:, :2] = 0.0
    for part in (slice(0, 2), slice(2, 5)):
        whole[part, part] += _ROUNDING * np.eye(part.stop - part.start)[..., None] * np.einsum("iin->n", whole)
    terms -= terms.mean(axis=1, keepdims=True)
    rest -= rest.mean(axis=0)
    solve = _solver(_normal_matrices(terms) + _NOT_SHOWN * whole)
    slope = np.zeros((2, x.shape[1]))
    for _ in range(2):
        coefficients = solve(np.einsum("ikn,kn->in", terms, rest))
        rest -= np.einsum("ikn,in->kn", terms, coefficients)
        slope += coefficients[:2]
    slope /= scale
    bent = n - slope[0] * a - slope[1] * b

    def numbers() -> Array:
        # By a round, of each term.
        left = np.stack([solve(_NOT_SHOWN * whole[:, j]) for j in range(len(terms))], axis=1)
        twice = np.einsum("ijn,jkn->ikn", left, left)
        return 1 + len(terms) - np.einsum("ijn,jin->n", twice, twice)

    return rest, (bent / np.maximum(np.linalg.norm(bent, axis=0), 1e-300)).T, numbers


def _normal_matrices(terms: Array) -> Array:
    """Return N normal matrices (m, m, N): the products of every two of m terms (m, k, N), summed over k neighbours."""
    out = np.empty((len(terms), *terms[:, 0].shape))
    for i, term in enumerate(terms):
        out[i, : i + 1] = out[: i + 1, i] = np.einsum("kn,jkn->jn", term, terms[: i + 1])
    return out


def _solver(A: Array) -> Callable[[Array], Array]:
    """Return what takes right sides (m, N) to solutions of N systems, A (m, m, N) symmetric, positive and small."""
    # All systems at once by Cholesky factors: a library's loop over them takes several times as long.
    m = len(A)
    L = np.zeros_like(A)
    for j in range(m):
        below = A[j:, j] - np.einsum("ikn,kn->in", L[j:, :j], L[j, :j])
        L[j:, j] = below / np.sqrt(np.maximum(below[0], 1e-300))

    def solve(right: Array) -> Array:
        """Return the solutions (m, N) of right sides (m, N): forward with the Cholesky factors, then backward."""
        out = np.array(right)
        for j in range(m):
            out[j] = (out[j] - np.einsum("kn,kn->n", L[j, :j], out[:j])) / L[j, j]
        for j in reversed(range(m)):
            out[j] = (out[j] - np.einsum("kn,kn->n", L[j + 1 :, j], out[j + 1 :])) / L[j, j]
        return out

    return solve


def _cross(a: Array, b: Array) -> Array:
    """Return (3, N) vector products of vectors (3, N)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def bounding_box(points: Array) -> Array:
    """Return (2, 3) lowest and highest corner of points (N, 3)."""
    # By columns: reductions over three numbers a point take ten times as long.
    return np.array([[f(column) for column in points.T] for f in (np.min, np.max)])


def centroid(points: Array) -> Array:
    """Return (3,) mean of points (N, 3)."""
    return np.array([column.mean() for column in points.T])


def spread(points: Array) -> float:
    """Return the rms distance of points (N, 3) from their centroid."""
    return float(np.sqrt(sum(column.var() for column in points.T)))


def box_corners(box: Array) -> Array:
    """Return (8, 3) corners of a box (2, 3)."""
    return np.array(np.meshgrid(*box.T)).reshape(3, 8).T
