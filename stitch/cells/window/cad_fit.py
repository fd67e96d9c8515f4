"""Scan onto CAD: point to plane, robustly weighted, on points that look all ways."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.cells.window.all_ways import sample_normal_space
from stitch.cells.window.allowance import Allowance, AllowancePrior, allowance_columns
from stitch.cells.window.allowance_fit import robust_spread, separable_share, summarise_allowance, varying_ridge
from stitch.cells.window.biweight import TUKEY, biweight, biweight_slope
from stitch.cells.window.cad import CadSurface, NearestPartners, nearest_partners
from stitch.cells.window.cell_weights import cell_weights
from stitch.cells.window.joined_scans import JoinedScans
from stitch.cells.window.regions import Regions
from stitch.errors import NoResultError
from stitch.frames import Array

_MIN_FIT_POINTS = 50
_ROUNDS = 80
# A step below this share of the part is none; and cells along the part for the second kind of weight.
_STILL, _CELLS = 1e-7, 40
# A surface that leaves a direction open by this share of the best one fixes no pose.
_OPEN = 1e-6
NO_ALLOWANCE = AllowancePrior()


@dataclass(frozen=True)
class CadFit:
    """T_base_part and what the fit rests on."""

    T_base_part: Array  # (4, 4)
    covariance: Array  # (6, 6) of ξ about the CAD's centre, T·exp(ξ), rotation (rad) first
    scale: float  # robust 1-sigma of the distances less the allowance
    rms: float  # of the same of all points that have a partner, deformed places too
    inliers: float  # share of the fit's points with weight above a half
    points: int
    allowance: Allowance | None = None  # None: none was spoken of

    @property
    def sigma(self) -> Array:
        """(6,) sigmas of rotation (rad) and translation, about the CAD's centre and axes."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_cad(
    scan: JoinedScans,
    cad: CadSurface,
    T_base_part: Array,
    regions: Regions | None = None,
    prior: AllowancePrior = NO_ALLOWANCE,
) -> CadFit:
    """Refine a coarse T_base_part (4, 4) until it stands still, and with it the allowance if it is wanted.

    The scale follows from the distances' median each round, never below the scan's own noise; what a deformation moved
    beyond 4.7 scales has no say. The rim of a dent leaves less, yet all to one side: so once the fit stands, whole
    cells of the surface are weighted by their means too (`cell_weights`). The points are drawn
    evenly over the directions they look to (`all_ways`).

    Raises:
        NoResultError: too few points meet the CAD, or the surface leaves a direction or the allowance open.
    """
    scan = scan.take(sample_normal_space(scan, T_base_part))
    noise = scan.noise if np.isfinite(scan.noise) else 0.0
    scale, by_cell = cad.size / 100, False
    numbers, size = np.zeros(prior.columns), cad.size / 100
    for _ in range(_ROUNDS):
        seen = _find_correspondences(scan, cad, T_base_part, regions, prior)
        rest = seen.distance - prior.known - seen.stock @ numbers
        # The gate closes by half a round at most, so that a bad start can still be pulled in.
        spread = robust_spread(rest[seen.used], prior)
        scale = max(spread, 0.5 * scale, noise)
        weight = _weights(seen, rest, scale, cad.size / _CELLS if by_cell else None)
        N = _normal_matrix(seen.design, weight, cad)
        shrink, size = varying_ridge(N, numbers, scale, size)
        pull = np.concatenate([np.zeros(6), numbers]) * shrink
        step = np.asarray(np.linalg.solve(N + np.diag(shrink), -seen.design.T @ (weight * rest) - pull), np.float64)
        T_base_part, numbers = moved_about(T_base_part, step[:6], cad.centre), numbers + step[6:]
        if np.abs(step[3:]).max() < _STILL * cad.size and scale <= 1.05 * max(spread, noise):
            if by_cell:
                break
            by_cell = True
    covariance = _sandwich(seen.design, rest, weight, scale, shrink)
    left = rest[seen.used]
    return CadFit(
        T_base_part,
        covariance=covariance[:6, :6],
        scale=scale,
        rms=float(np.sqrt((left**2).mean())),
        inliers=float(np.mean(np.abs(left) < 0.54 * TUKEY * scale)),
        points=len(left),
        allowance=summarise_allowance(seen.local[seen.used], cad, prior, numbers, covariance, N),
    )


def moved_about(T_base_part: Array, step: Array, centre: Array) -> Array:
    """The pose (4, 4) after a Gauss-Newton step, a twist (6,) about a centre (3,) of the part."""
    shift = frames.make(np.eye(3), centre)
    return np.asarray(T_base_part @ frames.inverse(shift @ frames.exp(step) @ frames.inverse(shift)))


def _weights(correspondences: "_Correspondences", rest: Array, scale: float, cell: float | None) -> Array:
    """(N,) by what is left of each point's distance, and of its whole cell's where cells have a size."""
    by_point = np.asarray(correspondences.used * biweight(rest / (TUKEY * scale)))
    if cell is None:
        return by_point
    return by_point * cell_weights(
        correspondences.local, replace(correspondences.partners, distance=rest), correspondences.used, cell, scale
    )


def _sandwich(design: Array, rest: Array, weight: Array, scale: float, shrink: Array) -> Array:
    """Covariance (6 + K, 6 + K): the weights are not the inverse variances (Huber & Ronchetti 2009, ch. 7).

    What is shrunk is as large as believed, which is an error of its own.
    """
    u = rest / (TUKEY * scale)
    slope = np.where(weight > 0, weight / np.maximum(biweight(u), 1e-12) * biweight_slope(u), 0.0)
    inverse = np.linalg.inv(np.einsum("ni,n,nj->ij", design, slope, design) + np.diag(shrink))
    meat = np.einsum("ni,n,nj->ij", design, (weight * rest) ** 2, design) + np.diag(shrink) * scale**2
    return np.asarray(inverse @ meat @ inverse)


@dataclass(frozen=True)
class _Correspondences:
    """N points at one pose: part frame, partners, which may count, and how distances answer."""

    local: Array  # (N, 3)
    partners: NearestPartners
    used: NDArray[np.bool_]  # (N,)
    stock: Array  # (N, K) columns of the allowance
    design: Array  # (N, 6 + K) of the twist about the CAD's centre and the allowance

    @property
    def distance(self) -> Array:
        return self.partners.distance


def _find_correspondences(
    scan: JoinedScans, cad: CadSurface, T_base_part: Array, regions: Regions | None, prior: AllowancePrior
) -> _Correspondences:
    T = frames.inverse(T_base_part)
    local = frames.transform(T, scan.points)
    found = nearest_partners(cad, local, frames.rotate(T, scan.normals))
    used = found.accept if regions is None else found.accept & regions.used(local)
    if used.sum() < _MIN_FIT_POINTS:
        raise NoResultError(f"{used.sum()} points meet the CAD; check the start, the regions and the CAD's unit")
    stock = allowance_columns(local, cad, prior)
    design = np.hstack([np.cross(local - cad.centre, found.normal), found.normal, -stock])
    return _Correspondences(local, found, used, stock, design)


def _normal_matrix(design: Array, weight: Array, cad: CadSurface) -> Array:
    """(6 + K, 6 + K) of a Gauss-Newton step: a twist about the CAD's centre, and the numbers of the allowance."""
    N = np.einsum("ni,n,nj->ij", design, weight, design)
    units = np.repeat([cad.size / 2, 1.0], 3)
    values = np.linalg.eigvalsh(N[:6, :6] / np.outer(units, units))
    if values[0] < _OPEN * values[-1]:
        shift = ", and of a plate the allowance is a shift along its normal" if len(N) > 6 else ""
        raise NoResultError(
            f"the scanned surface leaves a direction open (plane, cylinder or sphere){shift}; scan an edge too"
        )
    if len(N) > 6:
        separable_share(N)
    return np.asarray(N)
