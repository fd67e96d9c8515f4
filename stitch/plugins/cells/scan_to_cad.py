"""Scan onto CAD: a start without a guess, the fit with its covariance, an allowance, and the map of deviations.

The fit is point to plane, robustly weighted, on points that look all ways. Beside the pose it finds the allowance: the
stock that a casting has on its CAD.

From mean(d²) = Var(d) + mean(d)² a cost Var(d) + λ·mean(d)² can be chosen; the ordinary fit has λ = 1. With an
unknown allowance λ = 0: only the variance of the distances is made small (variance-minimisation matching), and their
mean is the allowance. A column of ones beside the six of the pose does the same and gives its sigma. Distances above
and below the allowance are two classes, plus and minus, each with its own scale, and the cleaner one counts for
both: gates, risers and flash all stand on one side.
"""

from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stitch.errors import InputError, NoResultError
from stitch.numerics import feature_matching, frames
from stitch.numerics.distributions import TUKEY, mad_sigma, tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.plugins.cells.cad import (
    CadSurface,
    Regions,
    cell_weights,
    nearest_partners,
    sample_normal_space,
    sample_partners,
    surface_cells,
    tukey_slope,
)
from stitch.plugins.cells.job_files import write_columns
from stitch.plugins.cells.placed_scans import SOURCES, JoinedScans, PlacingErrors
from stitch.session.reading.csv_files import is_number
from stitch.session.scan import even_indices
from stitch.system.ply_file import write_ply

FREE, VARYING = "free", "varying"
# Below this share told from a motion, an error of form enters more than threefold; that is said.
FAINT = 0.1
# Products of Legendre polynomials over the part's box up to this degree: what varies slowly.
_DEGREE = 3
_ORDERS = tuple(order for order in product(range(_DEGREE + 1), repeat=3) if 0 < sum(order) <= _DEGREE)
# Share of an even allowance that no motion of the part imitates. Below, an error of the part's form would enter the
# allowance more than thirtyfold.
_MIN_SEPARABLE_SHARE = 1e-3
# A class of fewer than this share of the points has no scale of its own.
_CLASS = 0.1
# A field this far below the scatter of the points is none.
_MIN_FIELD_SHARE = 1e-3
_MIN_FIT_POINTS = 50
_ROUNDS = 80
# A step below this share of the part is none; and cells along the part for the second kind of weight.
_STILL, _CELLS = 1e-7, 40
# A surface that leaves a direction open by this share of the best one fixes no pose.
_OPEN = 1e-6
_MIN_START_POINTS = 50
_START_POINTS = 1500  # of the scan that judge a candidate
_KEEP = 6  # candidates that are refined
_REFINE = 20  # steps of a candidate's refinement
_FEATURE_RUNS, _FEATURE_DRAWS, _FEATURE_SAMPLES = 3, 50_000, 6000
# A start of which less than a third of the scan meets the CAD is none.
_LEAST_SHARE = 1 / 3
# A pose that so much of the scan agrees with needs no second opinion.
_CERTAIN = 0.95
# A cell with fewer points has no mean worth a verdict.
_MIN_MAP_POINTS = 5
# Parts stand apart by more than this many point spacings, or this share of the part where the spacing is finer.
_GAP_SPACINGS, _GAP_SHARE = 6.0, 1 / 40
# A heap of points smaller than this share of the part's surface is no part.
_MIN_INSTANCE_SHARE = 0.1


@dataclass(frozen=True)
class AllowancePrior:
    """What is believed of the allowance before the fit; length_unit of the CAD."""

    known: float = 0.0
    free: bool = False
    varying: bool = False  # implies free

    @property
    def columns(self) -> int:
        """How many numbers are to be found."""
        return self.free + self.varying * len(_ORDERS)


@dataclass(frozen=True)
class Allowance:
    """Stock between CAD and scan, positive outside."""

    value: float  # mean over the fit's points
    sigma: float  # of that mean; 0 where it was stated
    lowest: float  # over the fit's points; of an even allowance the value
    highest: float
    sigma_field: float  # largest 1-sigma at any of those points
    prior: AllowancePrior
    told_apart: float  # share of it that no motion of the part imitates, 0 to 1; 1 where it was stated
    coefficients: Array  # (K,) of the columns
    cad: CadSurface

    def at(self, points: Array) -> Array:
        """(N,) allowance at points (N, 3), part frame."""
        return self.prior.known + allowance_columns(points, self.cad, self.prior) @ self.coefficients


def read_allowance(text: str | None) -> AllowancePrior:
    """Return what `--allowance` asks for: `free`, `varying` or a number.

    Raises:
        InputError: neither.
    """
    if text is None:
        return AllowancePrior()
    if text in (FREE, VARYING):
        return AllowancePrior(free=True, varying=text == VARYING)
    if not is_number(text) or not np.isfinite(float(text)):
        raise InputError(
            f"--allowance is {text!r}; to fix: write free (to find an even one), varying (one that changes slowly "
            "over the part), or the stock in the CAD's unit, as 0.3"
        )
    return AllowancePrior(known=float(text))


def allowance_columns(points: Array, cad: CadSurface, prior: AllowancePrior) -> Array:
    """Return the allowance (N, K) at points (N, 3), part frame, per unit of each number that is to be found."""
    if not prior.free:
        return np.zeros((len(points), 0))
    ones = np.ones((len(points), 1))
    if not prior.varying:
        return ones
    half = np.maximum(np.ptp(np.asarray(cad.mesh.bounds), axis=0) / 2, 1e-9 * cad.size)
    scaled = np.clip((points - cad.centre) / half, -1.1, 1.1)
    # Of unit mean square over the box each.
    x, y, z = (legendre.legvander(axis, _DEGREE) * np.sqrt(2 * np.arange(_DEGREE + 1) + 1) for axis in scaled.T)
    return np.column_stack([ones, *(x[:, i] * y[:, j] * z[:, k] for i, j, k in _ORDERS)])


def allowance_sentence(allowance: Allowance, length_unit: str | None) -> str:
    """Say its size with sigma, and what the sign means; None: nobody says in which unit."""
    unit = f" {length_unit}" if length_unit else ""
    if not allowance.prior.free:
        return f"Allowance {allowance.value:+.4g}{unit} as stated (plus: stock outside the CAD)."
    size = f"Allowance {allowance.value:+.4f} ± {allowance.sigma:.4f}{unit} (1 σ; plus: stock outside the CAD)"
    if allowance.prior.varying:
        size += (
            f", from {allowance.lowest:+.4f} to {allowance.highest:+.4f}{unit} over the scan, each ± "
            f"{allowance.sigma_field:.4f}{unit} at most"
        )
    if allowance.told_apart < FAINT:
        size += (
            f"; only {allowance.told_apart:.1%} of it is told from a motion of the part, so that errors of form "
            "weigh in it"
        )
    return size + "."


def robust_spread(rest: Array, prior: AllowancePrior) -> float:
    """Return the robust sigma of distances (N,) less their allowance: of the cleaner class where one is to be found."""
    if prior.free:
        sides = [rest[rest >= 0], rest[rest < 0]]
        if min(map(len, sides)) >= _CLASS * len(rest):
            return min(map(mad_sigma, sides))
    return mad_sigma(rest)


def separable_share(N: Array) -> float:
    """Return the share of an even allowance that no motion of the part imitates, from the normal matrix (6 + K, 6 + K).

    Raises:
        NoResultError: next to nothing; says which motion does.
    """
    motion = np.linalg.solve(N[:6, :6], N[:6, 6])
    share = float(1 - motion @ N[:6, 6] / N[6, 6])
    if share < _MIN_SEPARABLE_SHARE:
        shift = -motion[3:] / max(float(np.linalg.norm(motion[3:])), 1e-300)
        along = " ".join(f"{x:.2f}" for x in shift)
        raise NoResultError(
            f"the allowance cannot be told from a shift of the part along ({along}): all that was scanned looks to "
            "one side; to fix: scan opposite sides too, or state the stock, as --allowance 0.3"
        )
    return share


def varying_ridge(N: Array, coefficients: Array, scale: float, before: float) -> tuple[Array, float]:
    """Return what shrinks the varying part (6 + K,), in units of N, and its size τ by MacKay's evidence (1992).

    Pose and mean are free. Of a flat field the evidence lets τ fall to nothing.

    Args:
        N: normal matrix of weights that are 1 where nothing is wrong.
        before: τ of the round before.
    """
    weights = np.zeros(len(N))
    varying = coefficients[1:]
    if not len(varying):
        return weights, before
    weights[7:] = (scale / before) ** 2
    left = np.diag(np.linalg.inv(N + np.diag(weights)))[7:] * weights[7:]
    size = np.sqrt(float(varying @ varying) / max(float((1 - left).sum()), 1e-3))
    size = max(float(size), _MIN_FIELD_SHARE * scale)
    weights[7:] = (scale / size) ** 2
    return weights, size


def summarise_allowance(
    points: Array, cad: CadSurface, prior: AllowancePrior, coefficients: Array, covariance: Array, N: Array
) -> Allowance | None:
    """Return the allowance as people want it, over the fit's points (N, 3), part frame; None where none was spoken of.

    Args:
        covariance: of pose and coefficients, (6 + K, 6 + K).
        N: their normal matrix.
    """
    if prior == AllowancePrior():
        return None
    B = allowance_columns(points, cad, prior)
    local = prior.known + B @ coefficients
    C = covariance[6:, 6:]
    mean = B.mean(axis=0)
    return Allowance(
        value=prior.known + float(mean @ coefficients),
        sigma=float(np.sqrt(mean @ C @ mean)),
        lowest=float(local.min()),
        highest=float(local.max()),
        sigma_field=float(np.sqrt(np.einsum("ni,ij,nj->n", B, C, B).max())),
        prior=prior,
        told_apart=separable_share(N) if prior.free else 1.0,
        coefficients=coefficients,
        cad=cad,
    )


@dataclass(frozen=True)
class CadFit:
    """T_base_part and what the fit rests on."""

    T_base_part: Array  # (4, 4)
    covariance: Array  # (6, 6) of ξ about the CAD's centre, T·exp(ξ), rotation (rad) first
    parts: dict[str, Array]  # (6, 6) shares of it by source: the scan's noise, and SOURCES where they are known
    scale: float  # robust 1-sigma of the distances less the allowance
    rms: float  # of the same of all points that have a partner, deformed places too
    inliers: float  # share of the fit's points with weight above a half
    points: int
    allowance: Allowance | None = None  # None: none was spoken of

    @property
    def sigma(self) -> Array:
        """(6,) sigmas of rotation (rad) and translation, about the CAD's centre and axes."""
        return np.sqrt(np.diag(self.covariance))


def fit_cad(
    scan: JoinedScans,
    cad: CadSurface,
    T_base_part: Array,
    regions: Regions | None = None,
    prior: AllowancePrior | None = None,
    errors: PlacingErrors | None = None,
) -> CadFit:
    """Refine a coarse T_base_part (4, 4) until it stands still, and with it the allowance if it is wanted.

    The scale follows from the distances' median each round, never below the scan's own noise; what a deformation moved
    beyond 4.7 scales has no say. The rim of a dent leaves less, yet all to one side: so once the fit stands, whole
    cells of the surface are weighted by their means too (`cell_weights`). The points are drawn evenly over the
    directions they look to (`sample_normal_space`).

    Args:
        errors: how the scans' places may err; the covariance takes it up.

    Raises:
        NoResultError: too few points meet the CAD, or the surface leaves a direction or the allowance open.
    """
    prior = prior or AllowancePrior()
    scan = scan.take(sample_normal_space(scan, T_base_part))
    noise = scan.noise if np.isfinite(scan.noise) else 0.0
    scale = size = cad.size / 100
    by_cell = False
    numbers = np.zeros(prior.columns)
    for _ in range(_ROUNDS):
        local, distance, normal, used = _meeting_points(scan, cad, T_base_part, regions)
        stock = allowance_columns(local, cad, prior)
        design = np.hstack([frames.plane_rows(local - cad.centre, normal), -stock])
        rest = distance - prior.known - stock @ numbers
        # The gate closes by half a round at most, so that a bad start can still be pulled in.
        spread = robust_spread(rest[used], prior)
        scale = max(spread, 0.5 * scale, noise)
        weight = used * tukey(rest, scale)
        if by_cell:
            weight = weight * cell_weights(surface_cells(local, normal, cad.size / _CELLS), rest, used, scale)
        N = _normal_matrix(design, weight, cad)
        shrink, size = varying_ridge(N, numbers, scale, size)
        pull = np.concatenate([np.zeros(6), numbers]) * shrink
        step = np.asarray(np.linalg.solve(N + np.diag(shrink), -design.T @ (weight * rest) - pull), float)
        T_base_part = moved_about(T_base_part, step[:6], cad.centre)
        numbers = numbers + step[6:]
        if np.abs(step[3:]).max() < _STILL * cad.size and scale <= 1.05 * max(spread, noise):
            if by_cell:
                break
            by_cell = True
    modes = {} if errors is None else {source: list(errors.modes(scan, source)) for source in SOURCES}
    normals = frames.rotate(T_base_part, normal)
    parts = _covariances(design, rest, weight, scale=scale, shrink=shrink, normals=normals, modes=modes)
    covariance = sum(parts.values(), np.zeros_like(N))
    allowance = summarise_allowance(local[used], cad, prior, numbers, covariance, N)
    rest = rest[used]
    return CadFit(
        T_base_part,
        covariance=covariance[:6, :6],
        parts={name: part[:6, :6] for name, part in parts.items()},
        scale=scale,
        rms=float(np.sqrt((rest**2).mean())),
        inliers=float(np.mean(np.abs(rest) < 0.54 * TUKEY * scale)),
        points=len(rest),
        allowance=allowance,
    )


def _meeting_points(
    scan: JoinedScans, cad: CadSurface, T_base_part: Array, regions: Regions | None
) -> tuple[Array, Array, Array, Mask]:
    """Return points (N, 3) in the part's frame, distances (N,) from the CAD, its normals (N, 3), and which count (N,).

    Raises:
        NoResultError: too few do.
    """
    T = frames.inverse(T_base_part)
    local = frames.transform(T, scan.points)
    distance, normal, used = nearest_partners(cad, local, frames.rotate(T, scan.normals))
    used = used if regions is None else used & regions.used(local)
    if used.sum() < _MIN_FIT_POINTS:
        raise NoResultError(
            f"{used.sum()} points meet the CAD; to fix: check the start, the regions and the CAD's unit"
        )
    return local, distance, normal, used


def moved_about(T_base_part: Array, step: Array, centre: Array) -> Array:
    """Return the pose (4, 4) after a Gauss-Newton step, a twist (6,) about a centre (3,) of the part."""
    return T_base_part @ frames.inverse(frames.moved_about(centre, step, np.eye(4)))


def _covariances(
    design: Array,
    rest: Array,
    weight: Array,
    *,
    scale: float,
    shrink: Array,
    normals: Array,
    modes: dict[str, list[tuple[Indices, Array]]],
) -> dict[str, Array]:
    """Return covariances (6 + K, 6 + K) by source: of the scan's noise, and of the `modes` in which points move.

    Of the noise a sandwich: the weights are not the inverse variances (Huber & Ronchetti 2009, ch. 7). What is shrunk
    is as large as believed, which is an error of its own. Of misplaced scans the sum of the fit's squared answers.
    """
    robust = np.maximum(tukey(rest, scale), 1e-12)
    slope = np.where(weight > 0, weight / robust * tukey_slope(rest, scale), 0.0)
    inverse = np.linalg.inv(np.einsum("ni,n,nj->ij", design, slope, design) + np.diag(shrink))
    meat = np.einsum("ni,n,nj->ij", design, (weight * rest) ** 2, design) + np.diag(shrink) * scale**2
    covariances = {"scan": inverse @ meat @ inverse}
    for source, motions in modes.items():
        covariances[source] = np.zeros_like(inverse)
        for index, moved in motions:
            answer = inverse @ (design[index].T @ (slope[index] * np.einsum("ni,ni->n", normals[index], moved)))
            covariances[source] = covariances[source] + np.outer(answer, answer)
    return covariances


def _normal_matrix(design: Array, weight: Array, cad: CadSurface) -> Array:
    """Return the matrix (6 + K, 6 + K) of a step: a twist about the CAD's centre, and the numbers of the allowance."""
    N = np.einsum("ni,n,nj->ij", design, weight, design)
    units = np.repeat([cad.size / 2, 1.0], 3)
    values = np.linalg.eigvalsh(N[:6, :6] / np.outer(units, units))
    if values[0] < _OPEN * values[-1]:
        shift = ", and of a plate the allowance is a shift along its normal" if len(N) > 6 else ""
        raise NoResultError(
            f"the scanned surface leaves a direction open (plane, cylinder or sphere){shift}; to fix: scan an edge too"
        )
    if len(N) > 6:
        separable_share(N)
    return N


def find_cad_start(scan: JoinedScans, cad: CadSurface) -> tuple[Array, float, float]:
    """Return a coarse pose, and how well it stands against the next best different one.

    Tried are the 24 ways to lay principal axes on principal axes, and feature matches where none of them meets.
    Features are FPFH with RANSAC (Rusu et al. 2009): they serve where the scan shows only a piece of the part,
    principal axes where it is too smooth for features.

    Returns:
        T_base_part (4, 4); the share of the scan's points that meet the CAD there; the same of the best pose elsewhere,
        which is close to the first for a symmetric part.

    Raises:
        NoResultError: no candidate brings a third of the scan onto the CAD.
    """
    if scan.usable.sum() < _MIN_START_POINTS:
        raise NoResultError(
            f"{scan.usable.sum()} usable points in the scan; to fix: scan surfaces head-on, edges do not count"
        )
    index = _spread_sample(scan)
    points = scan.points[index]
    normals = scan.normals[index]
    gate = cad.size / 25
    fine = cad.size / 250
    ranked = sorted(_axis_candidates(points, cad), key=lambda T: -_inlier_share(T, points, normals, cad, gate))
    refined = [refine_start(T, points, normals, cad, gate) for T in ranked[:_KEEP]]
    shares = [_inlier_share(T, points, normals, cad, fine) for T in refined]
    if max(shares) < _CERTAIN:
        refined += [refine_start(T, points, normals, cad, gate) for T in _feature_candidates(points, normals, cad)]
        shares = [_inlier_share(T, points, normals, cad, fine) for T in refined]
    best = int(np.argmax(shares))
    corners = cad.samples[:: max(1, len(cad.samples) // 200)]
    placed = [frames.transform(T, corners) for T in refined]
    apart = [np.linalg.norm(p - placed[best], axis=1).max() for p in placed]
    elsewhere = [s for s, d in zip(shares, apart, strict=True) if d > cad.size / 50]
    if shares[best] < _LEAST_SHARE:
        raise NoResultError(
            f"scan and CAD do not meet: {shares[best]:.0%} of the points at best; to fix: check the CAD's unit, "
            "or cut away what is not the part"
        )
    return refined[best], shares[best], max(elsewhere, default=0.0)


def _spread_sample(scan: JoinedScans) -> Indices:
    """Return indices of points evenly over the surface: one per voxel, then evenly thinned."""
    usable = np.flatnonzero(scan.usable)
    size = np.ptp(scan.points[usable], axis=0).max() / 70
    _, first = np.unique(np.floor(scan.points[usable] / size).astype(int), axis=0, return_index=True)
    kept = usable[np.sort(first)]
    if len(kept) < _MIN_START_POINTS:
        raise NoResultError(
            f"the scans reach over {70 * size:.3g}, mostly empty; to fix: correct a scanner's pose, or cut them"
        )
    return kept[even_indices(len(kept), _START_POINTS)]


def _axis_candidates(points: Array, cad: CadSurface) -> list[Array]:
    """Return poses (4, 4) by the 24 turns that lay the scan's principal axes onto the CAD's."""
    clouds = (points, cad.samples[::20])
    scan_axes, cad_axes = (np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2] for p in clouds)
    turns = [np.eye(3)[list(p)] * signs for p in permutations(range(3)) for signs in product((1, -1), repeat=3)]
    rotations = [scan_axes.T @ turn @ cad_axes for turn in turns]
    middles = points.mean(axis=0), cad.samples.mean(axis=0)
    return [frames.make(R, middles[0] - R @ middles[1]) for R in rotations if np.linalg.det(R) > 0]


def _feature_candidates(points: Array, normals: Array, cad: CadSurface) -> list[Array]:
    """Return poses (4, 4) from feature matching, one per seed."""
    size = cad.size / 60
    step = max(1, len(cad.samples) // _FEATURE_SAMPLES)
    scan = feature_matching.compute_fpfh(points, normals, 5 * size)
    part = feature_matching.compute_fpfh(cad.samples[::step], cad.normals[::step], 5 * size)
    return [
        frames.inverse(feature_matching.register_ransac(scan, part, reach=1.5 * size, draws=_FEATURE_DRAWS, seed=seed))
        for seed in range(_FEATURE_RUNS)
    ]


def _inlier_share(T_base_part: Array, points: Array, normals: Array, cad: CadSurface, gate: float) -> float:
    """Return the share of the points whose nearest sample is nearer than the gate and looks the same way."""
    T = frames.inverse(T_base_part)
    local = frames.transform(T, points)
    directions = frames.rotate(T, normals)
    index = sample_partners(cad, local, directions)
    same = np.einsum("ij,ij->i", directions, cad.normals[index]) > 0.8
    return float(np.mean(same & (np.linalg.norm(local - cad.samples[index], axis=1) < gate)))


def refine_start(T_base_part: Array, points: Array, normals: Array, cad: CadSurface, gate: float) -> Array:
    """Return the pose (4, 4) after point-to-plane steps with a gate that closes to a tenth."""
    for width in gate * np.geomspace(4.0, 0.1, _REFINE):
        T = frames.inverse(T_base_part)
        local = frames.transform(T, points)
        index = sample_partners(cad, local, frames.rotate(T, normals))
        off = local - cad.samples[index]
        directions = cad.normals[index]
        near = np.linalg.norm(off, axis=1) < max(width, 3 * cad.spacing)
        if near.sum() < 12:
            break
        residual = np.einsum("ij,ij->i", off[near], directions[near])
        arm = local[near] - cad.centre
        design = np.hstack([np.cross(arm, directions[near]) / cad.size, directions[near]])
        # Directions that the surface leaves open must not run away: a weak pull to stay.
        step = np.linalg.solve(design.T @ design + 1e-4 * near.sum() * np.eye(6), -design.T @ residual)
        step[:3] /= cad.size
        T_base_part = moved_about(T_base_part, step, cad.centre)
    return T_base_part


@dataclass(frozen=True)
class Deviations:
    """N points that have a place on the CAD, part frame, and C cells: points of one cube that look the same way."""

    points: Array  # (N, 3)
    distance: Array  # (N,) positive outside
    tolerance: float
    middle: Array  # (C, 3) of a cell
    mean: Array  # (C,) deviation of a cell
    spread: Array  # (C,) 1-sigma of its points
    count: NDArray[np.int64]  # (C,)

    @property
    def outside(self) -> NDArray[np.bool_]:
        """(C,) cells whose mean is beyond the tolerance."""
        return np.abs(self.mean) > self.tolerance

    @property
    def worst(self) -> int:
        """Index of the cell that is out most."""
        return int(np.argmax(np.abs(self.mean)))


def measure_deviations(
    scan: JoinedScans,
    cad: CadSurface,
    T_base_part: Array,
    tolerance: float,
    cell: float,
    allowance: Allowance | None = None,
) -> Deviations:
    """Return distances of all usable points from the CAD with its allowance; cells average the noise away.

    Args:
        T_base_part: (4, 4) where the part lies.
        tolerance, cell: of a cell's mean, and its edge length; the CAD's unit.
    """
    T = frames.inverse(T_base_part)
    local = frames.transform(T, scan.points[scan.usable])
    distance, normal, accept = nearest_partners(cad, local, frames.rotate(T, scan.normals[scan.usable]))
    points = local[accept]
    distance = distance[accept]
    if allowance is not None:
        distance = distance - allowance.at(points)
    where = surface_cells(points, normal[accept], cell)
    count = np.bincount(where)

    def mean(values: Array) -> Array:
        return np.bincount(where, values, len(count)) / count

    average = mean(distance)
    middle = np.column_stack([mean(points[:, k]) for k in range(3)])
    spread = np.sqrt(np.maximum(mean((distance - average[where]) ** 2), 0.0))
    full = count >= _MIN_MAP_POINTS
    return Deviations(points, distance, tolerance, middle[full], average[full], spread=spread[full], count=count[full])


def write_deviation_ply(file: Path, deviations: Deviations) -> None:
    """Write points with the scalar `deviation` and a colour: blue inside, red outside, full at the tolerance."""
    share = np.clip(deviations.distance / deviations.tolerance, -1, 1)
    vertex = np.empty(
        len(share), [(n, "f4") for n in ("x", "y", "z", "deviation")] + [(n, "u1") for n in ("red", "green", "blue")]
    )
    vertex["x"], vertex["y"], vertex["z"] = deviations.points.T
    vertex["deviation"] = deviations.distance
    pale = 235 * (1 - np.abs(share))
    vertex["red"], vertex["green"] = np.where(share > 0, 235, pale), pale
    vertex["blue"] = np.where(share < 0, 235, pale)
    write_ply(file, {"vertex": vertex})


def write_deviation_csv(file: Path, deviations: Deviations) -> None:
    """Write one row per cell, the worst first."""
    order = np.argsort(-np.abs(deviations.mean))
    columns = {axis: deviations.middle[order, k] for k, axis in enumerate("xyz")}
    columns |= {"deviation": deviations.mean[order], "spread": deviations.spread[order]}
    verdicts = ["bad" if bad else "good" for bad in deviations.outside[order]]
    write_columns(file, {**columns, "points": deviations.count[order].tolist(), "verdict": verdicts})


def split_instances(scan: JoinedScans, cad: CadSurface, count: int) -> list[JoinedScans]:
    """Return the scan's heaps of points, linked where nearer than the gap between parts, largest first.

    Raises:
        NoResultError: fewer heaps of a part's size than wanted.
    """
    if count == 1:
        return [scan]
    gap = max(_GAP_SPACINGS * scan.spacing, _GAP_SHARE * cad.size)
    cells, where = np.unique(np.floor(scan.points / (gap / 3)).astype(int), axis=0, return_inverse=True)
    # Cells three to a gap: those whose centres lie within it belong together.
    pairs = cKDTree(cells).query_pairs(3.0, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
    labels = connected_components(graph, directed=False)[1][where.ravel()]
    heaps = [labels == label for label in range(labels.max() + 1)]
    # Of a part at most one side is seen, so half its surface is the most a heap can hold.
    big = [heap for heap in heaps if scan.area[heap].sum() > _MIN_INSTANCE_SHARE * cad.mesh.area / 2]
    if len(big) < count:
        raise NoResultError(
            f"{len(big)} separate parts in the scan, {count} wanted; to fix: scan the others, or correct `instances`"
        )
    return [scan.take(heap) for heap in sorted(big, key=lambda heap: -scan.area[heap].sum())[:count]]
