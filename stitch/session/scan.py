"""A view made ready for matching, once: KD-tree, normals, edges, spacing and noise, scanner frame."""

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
    area: Array  # (N,) length_unit², surface per point: the inverse of the local density
    confidence: Array  # (N,) cosine of incidence, 0 … 1
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
        """Return the tree, built from the points, of a scan that was copied without it: Python asks for it here."""
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
        """Median over smooth points of the solid angle per point, sr, seen from the eye: area · cosine / distance²."""
        smooth = self.usable if self.usable.any() else np.ones_like(self.usable)
        away = self.points[smooth] - self.eye
        each = (self.area * self.confidence)[smooth] / np.einsum("ij,ij->i", away, away)
        return float(np.median(each))

    def rays(self, points: Array) -> Array:
        """Return (N, 3) unit vectors from the eye to points (N, 3), scanner frame."""
        return _rays_to(points, self.eye)


@dataclass(frozen=True)
class Neighbourhoods:
    """The k nearest points of each of n points, the point itself first."""

    tree: Any  # pykdtree KDTree over all points
    index: Indices  # (n, k)
    radius: Array  # (n,) distance to the farthest of them
    spacing: float  # median distance to the nearest one, length_unit


def without_stock(scan: Scan, stock: Stock | None) -> Scan:
    """Return the scan with points of stock moved against their normals, by its thickness, onto the surface below.

    Args:
        stock: what to take off; None: points that an earlier call moved return to where they were scanned.
    """
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
    """Return a scan made ready for matching: KD-tree, normals, usable points, spacing and noise.

    A normal is that of the plane through 16 neighbours; where that leaves clearly more than noise, of a quadric. Points
    at an edge, in a crease or at grazing incidence are not usable.

    Args:
        name: of the view.
        points: (M, 3) all points, scanner frame, length_unit.
        picked: (N,) indices of the points that the scan keeps; None: all. Normals, edges and noise come from all.
        eye: (3,) from where the scanner looks, scanner frame; None: the origin.
        around: `find_neighbourhoods(points, picked)`, where the caller has it already.
    """
    points = np.ascontiguousarray(points, float)
    selected = points if picked is None or len(picked) == len(points) else points[picked]
    around = around or find_neighbourhoods(points, picked)
    tree, index, radius = around.tree, around.index, around.radius
    centroid, normals, variation, residual = fit_planes(points, index)
    eye = np.zeros(3) if eye is None else eye
    rays = _rays_to(selected, eye)
    usable = (np.abs(np.einsum("ij,ij->i", normals, rays)) > GRAZING_COSINE) & (variation < _CREASE_VARIATION)
    usable &= np.linalg.norm(centroid - selected, axis=1) < _EDGE_OFFSET * radius
    # Across an edge no quadric fits: there the surface would count as noise.
    smooth = usable if usable.any() else np.ones_like(usable)
    noise = _estimate_noise(points, selected[smooth], normals[smooth], index[smooth])
    bent = np.flatnonzero(smooth & (residual > _BENT * noise))
    normals[bent] = _bent_normals(points, selected[bent], normals[bent], index[bent])
    # Normals point towards the scanner, against the rays.
    cosine = np.einsum("ij,ij->i", normals, rays)
    normals *= -np.sign(cosine)[:, None]
    confidence = np.abs(cosine)
    usable &= confidence > GRAZING_COSINE
    spacing = scanned_spacing = around.spacing
    if len(selected) < len(points):
        tree = KDTree(selected, leafsize=16)
        spacing = _estimate_spacing(selected, tree)
    # The disc that holds the neighbours, shared among them; fewer selected points stand for more surface each.
    area = np.pi * radius**2 / index.shape[1] * (len(points) / len(selected))
    return Scan(
        name=name,
        points=selected,
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
    """Return the nearest neighbours, among all points (M, 3), of the points at the indices `picked`, or of all."""
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
    """Return the median distance of points (N, 3) to their nearest other point, from the tree over them."""
    distance, _ = tree.query(points, k=2)
    return float(np.median(distance[:, 1]))


def fit_planes(points: Array, index: Indices) -> tuple[Array, Array, Array, Array]:
    """Return the planes fitted to N neighbourhoods by least squares.

    Args:
        points: (M, 3).
        index: (N, k) indices of the points of each neighbourhood.

    Returns:
        The centroid (N, 3) of the neighbours; unit normals (N, 3) of either sign; the variation (N,), the smallest
        eigenvalue of the neighbours' covariance over the sum of all, 0 … 1/3; and the standard deviation (N,) of the
        neighbours about the plane, length_unit.
    """
    centroid, normals = np.empty((len(index), 3)), np.empty((len(index), 3))
    variation, sigma = np.empty(len(index)), np.empty(len(index))
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
        # The smallest eigenvalue is the sum of squares about the plane, which takes three degrees of freedom.
        sigma[at] = np.sqrt(np.maximum(variation[at], 0) * np.trace(C) / max(len(rows) - 3, 1))
    return centroid, normals, variation, sigma


def _weakest_directions(C: Array) -> tuple[Array, Array]:
    """Return unit eigenvectors (N, 3) of the smallest eigenvalues λ of covariances C (3, 3, N), and λ over the traces.

    With mean eigenvalue m, B = C − m, p² = tr B²/6 and cos 3φ = det B/(2p³) the eigenvalues are m + 2p cos(φ + 2πk/3)
    (Smith 1961). All rows of C − λ are orthogonal to the eigenvector: the longest cross product of two of them gives
    it. Where all are short, as of points along a line, a library's decomposition is used.
    """
    scaled = C / np.maximum(np.trace(C), 1e-300)
    mean = np.trace(scaled) / 3
    identity = np.eye(3)[:, :, None]
    B = scaled - identity * mean
    p = np.maximum(np.sqrt((B**2).sum(axis=(0, 1)) / 6), 1e-100)
    determinant = (B[0] * _cross(B[1], B[2])).sum(axis=0)
    angle = np.arccos(np.clip(determinant / (2 * p**3), -1.0, 1.0)) / 3
    smallest, largest = (mean + 2 * p * np.cos(angle + turn) for turn in (2 * np.pi / 3, 0.0))
    rows = scaled - identity * smallest
    products = np.array([_cross(rows[i], rows[j]) for i, j in ((0, 1), (1, 2), (2, 0))])
    square = (products**2).sum(axis=1)
    longest = square.argmax(axis=0)
    every = np.arange(len(longest))
    length = np.sqrt(square[longest, every])
    normals = products[longest, :, every] / np.maximum(length, 1e-300)[:, None]
    unclear = np.flatnonzero(length <= _CLEARLY_PLANE * largest**2)
    if len(unclear):
        values, vectors = np.linalg.eigh(scaled[:, :, unclear].transpose(2, 0, 1))
        normals[unclear], smallest[unclear] = vectors[:, :, 0], values[:, 0]
    return normals, smallest


def _estimate_noise(points: Array, centres: Array, normals: Array, index: Indices) -> float:
    """Return the standard deviation of points from local quadrics, length_unit: median over up to 1500 neighbourhoods.

    Only white noise: an error that is smooth over the neighbourhood moves the quadric with it and is not seen. A plane
    would count curvature as noise. NaN where neighbourhoods have too few points for a quadric.

    Args:
        points: (M, 3) all points.
        centres: (N, 3) points whose neighbourhoods are used.
        normals: (N, 3) unit normals at the centres.
        index: (N, k) indices of each centre's neighbours among all points.
    """
    count = index.shape[1]
    if count <= 8:
        return float("nan")
    sample = even_indices(len(centres), _NOISE_SAMPLES)
    residuals, _, penalty, factors = _fit_quadrics(points, centres[sample], normals[sample], index[sample])
    # Each fit has 1 + m − tr R⁴ parameters: R = (S + μW)⁻¹μW is what one of its two rounds leaves of m coefficients.
    left = np.stack([_cholesky_solve(factors, penalty[:, j]) for j in range(len(penalty))], axis=1)
    twice = np.einsum("ijn,jkn->ikn", left, left)
    degrees = count - (1 + len(penalty) - np.einsum("ijn,jin->n", twice, twice))
    variance = (residuals**2).sum(axis=0) / degrees
    # The median of χ²/ν lies at (1 − 2/(9ν))³ of the mean (Wilson–Hilferty).
    return float(np.sqrt(np.median(variance / (1 - 2 / (9 * degrees)) ** 3)))


def _bent_normals(points: Array, centres: Array, normals: Array, index: Indices) -> Array:
    """Return unit normals (N, 3) of local quadrics at points.

    The points of a bent surface are closer where it faces the scanner. The centroid of a point's neighbours is shifted
    to there: normals of planes lean towards the scanner, by some hundredths of a radian.

    Args:
        points: (M, 3) all points.
        centres: (N, 3) points at which the normals are returned.
        normals: (N, 3) unit normals of the local planes at the centres.
        index: (N, k) indices of each centre's neighbours among all points.
    """
    out = np.empty_like(normals)
    for start in range(0, len(centres), _IN_CACHE):
        at = slice(start, start + _IN_CACHE)
        out[at] = _fit_quadrics(points, centres[at], normals[at], index[at])[1]
    return out


def _fit_quadrics(points: Array, centres: Array, normals: Array, index: Indices) -> tuple[Array, Array, Array, Array]:
    """Return quadrics fitted to the k neighbours of each of N points, with m = 5 terms beside a constant.

    With x and y across the normal the height over the local plane is a constant plus c·(x, y, x², √2·xy, y²). The
    coefficients c are found by least squares with a small penalty, in two rounds (iterated Tikhonov): (S + μW) c = q,
    and once more for the residuals, with μ `_NOT_SHOWN` and q the products of terms and heights. S is the normal matrix
    of the terms less their means; W is that of the terms as they are, without products of first and second order. So a
    coefficient that the neighbours hardly determine stays near zero, whatever the axes.

    Args:
        points: (M, 3) all points.
        centres: (N, 3) points to whose neighbours the quadrics are fitted.
        normals: (N, 3) unit normals of the local planes.
        index: (N, k) indices of each centre's neighbours among all points.

    Returns:
        Residuals (k, N) along the normals of the local planes, length_unit; unit normals (N, 3) at the points; μW and
        the Cholesky factors of S + μW, (m, m, N) each.
    """
    n = normals.T
    a, b = _axes_across(n)
    neighbours = np.array([column[index.T] for column in points.T]) - centres.T[:, None]
    x, y, heights = (np.einsum("in,ikn->kn", axis, neighbours) for axis in (a, b, n))
    # In units of the farthest neighbour's distance.
    size = np.sqrt(np.maximum((x * x + y * y).max(axis=0), 1e-300))
    x, y = x / size, y / size
    terms = np.array([x, y, x * x, np.sqrt(2) * x * y, y * y])
    penalty = _NOT_SHOWN * _orders_apart(_normal_matrices(terms))
    terms -= terms.mean(axis=1, keepdims=True)
    residuals = heights - heights.mean(axis=0)
    factors = _cholesky_factors(_normal_matrices(terms) + penalty)
    slope = np.zeros((2, x.shape[1]))
    for _ in range(2):
        coefficients = _cholesky_solve(factors, np.einsum("ikn,kn->in", terms, residuals))
        residuals -= np.einsum("ikn,in->kn", terms, coefficients)
        slope += coefficients[:2]
    slope /= size
    # The normal of the surface z = slope · (x, y) at the point itself.
    bent = n - slope[0] * a - slope[1] * b
    return residuals, (bent / np.maximum(np.linalg.norm(bent, axis=0), 1e-300)).T, penalty, factors


def _axes_across(normals: Array) -> tuple[Array, Array]:
    """Return unit vectors (3, N) and (3, N) across normals (3, N) and each other; zero where a normal is."""
    other = np.where(np.abs(normals[0]) < 0.7, [[1.0], [0.0], [0.0]], [[0.0], [1.0], [0.0]])
    a = _cross(normals, other)
    a /= np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    return a, _cross(normals, a)


def _orders_apart(W: Array) -> Array:
    """Return normal matrices W (5, 5, N) without products of first-order and second-order terms, made invertible."""
    W[:2, 2:] = W[2:, :2] = 0.0
    for order in (slice(0, 2), slice(2, 5)):
        W[order, order] += _ROUNDING * np.eye(order.stop - order.start)[..., None] * np.einsum("iin->n", W)
    return W


def _normal_matrices(terms: Array) -> Array:
    """Return N normal matrices (m, m, N): products of every two of m terms, (m, k, N), summed over k neighbours."""
    out = np.empty((len(terms), *terms[:, 0].shape))
    for i, term in enumerate(terms):
        out[i, : i + 1] = out[: i + 1, i] = np.einsum("kn,jkn->jn", term, terms[: i + 1])
    return out


def _cholesky_factors(A: Array) -> Array:
    """Return lower factors L (m, m, N), A = L·Lᵀ, of N symmetric positive definite matrices A (m, m, N)."""
    # All at once: a library's loop over the matrices takes several times as long.
    L = np.zeros_like(A)
    for j in range(len(A)):
        below = A[j:, j] - np.einsum("ikn,kn->in", L[j:, :j], L[j, :j])
        L[j:, j] = below / np.sqrt(np.maximum(below[0], 1e-300))
    return L


def _cholesky_solve(L: Array, right: Array) -> Array:
    """Return the solutions x (m, N) of L·Lᵀ·x = right (m, N), L (m, m, N): forward, then backward substitution."""
    x = np.array(right)
    for j in range(len(L)):
        x[j] = (x[j] - np.einsum("kn,kn->n", L[j, :j], x[:j])) / L[j, j]
    for j in reversed(range(len(L))):
        x[j] = (x[j] - np.einsum("kn,kn->n", L[j + 1 :, j], x[j + 1 :])) / L[j, j]
    return x


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
