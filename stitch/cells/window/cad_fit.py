"""Scan onto CAD: point to plane, robustly weighted, on points that look all ways."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.cells.window.biweight import MAD, TUKEY, biweight, biweight_slope
from stitch.cells.window.cad import Nearest, Surface, nearest
from stitch.cells.window.cell_weights import cell_weights
from stitch.cells.window.joined_scans import Joined
from stitch.cells.window.regions import Regions
from stitch.errors import NoResultError
from stitch.frames import Array, Indices

_POINTS = 20_000
_ROUNDS = 80
# A step below this share of the part is none; and cells along the part for the second kind of weight.
_STILL, _CELLS = 1e-7, 40
# Normals are sorted into cells of a quarter of their unit length: about 15°.
_DIRECTIONS = 4
# A surface that leaves a direction open by this share of the best one fixes no pose.
_OPEN = 1e-6


@dataclass(frozen=True)
class CadFit:
    """T_base_part and what the fit rests on."""

    T_base_part: Array  # (4, 4)
    covariance: Array  # (6, 6) of ξ about the CAD's centre, T·exp(ξ), rotation (rad) first
    scale: float  # robust 1-sigma of the distances
    rms: float  # of all distances of points that have a partner, deformed places too
    inliers: float  # share of the fit's points with weight above a half
    points: int

    @property
    def sigma(self) -> Array:
        """(6,) sigmas of rotation (rad) and translation, about the CAD's centre and axes."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit(scan: Joined, cad: Surface, T_base_part: Array, regions: Regions | None = None) -> CadFit:
    """Refine a coarse T_base_part (4, 4) until it stands still.

    The scale follows from the distances' median each round, never below the scan's own noise; what a deformation moved
    beyond 4.7 scales has no say. The rim of a dent leaves less, yet all to one side: so once the fit stands, whole
    cells of the surface are weighted by their means too (`cell_weights`). The points are drawn evenly over the
    directions they look to (normal-space sampling, Rusinkiewicz & Levoy 2001): on a large smooth sheet the few points
    of its flanks alone hold it in its plane.

    Raises:
        NoResultError: too few points meet the CAD, or the surface leaves a direction open.
    """
    scan = scan.take(_all_ways(scan, T_base_part))
    scale, by_cell = cad.size / 100, False
    for _ in range(_ROUNDS):
        local, found, allowed = _look(scan, cad, T_base_part, regions)
        used = found.accept & allowed
        if used.sum() < 50:
            raise NoResultError(f"{used.sum()} points meet the CAD; check the start, the regions and the CAD's unit")
        # The gate closes by half a round at most, so that a bad start can still be pulled in.
        spread = MAD * float(np.median(np.abs(found.distance[used])))
        scale = max(spread, 0.5 * scale, scan.noise if np.isfinite(scan.noise) else 0.0)
        weight = used * biweight(found.distance / (TUKEY * scale))
        if by_cell:
            weight *= cell_weights(local, found, used, cad.size / _CELLS, scale)
        step, design = _step(local, found, weight, cad)
        T_base_part = moved_about(T_base_part, step, cad.centre)
        if np.abs(step[3:]).max() < _STILL * cad.size and scale <= 1.05 * max(spread, scan.noise):
            if by_cell:
                break
            by_cell = True
    distance = found.distance[used]
    return CadFit(
        T_base_part,
        covariance=_sandwich(design, found.distance, weight, scale),
        scale=scale,
        rms=float(np.sqrt((distance**2).mean())),
        inliers=float(np.mean(np.abs(distance) < 0.54 * TUKEY * scale)),
        points=int(used.sum()),
    )


def moved_about(T_base_part: Array, step: Array, centre: Array) -> Array:
    """The pose (4, 4) after a Gauss-Newton step, a twist (6,) about a centre (3,) of the part."""
    shift = frames.make(np.eye(3), centre)
    return np.asarray(T_base_part @ frames.inverse(shift @ frames.exp(step) @ frames.inverse(shift)))


def _sandwich(design: Array, distance: Array, weight: Array, scale: float) -> Array:
    """Covariance (6, 6): the weights are not the inverse variances (Huber & Ronchetti 2009, ch. 7)."""
    u = distance / (TUKEY * scale)
    slope = np.where(weight > 0, weight / np.maximum(biweight(u), 1e-12) * biweight_slope(u), 0.0)
    inverse = np.linalg.inv(np.einsum("ni,n,nj->ij", design, slope, design))
    meat = np.einsum("ni,n,nj->ij", design, (weight * distance) ** 2, design)
    return np.asarray(inverse @ meat @ inverse)


def _all_ways(scan: Joined, T_base_part: Array) -> Indices:
    """Indices of at most _POINTS usable points, as many of each direction as there are to share out."""
    usable = np.flatnonzero(scan.usable)
    directions = np.round(frames.rotate(frames.inverse(T_base_part), scan.normals[usable]) * _DIRECTIONS)
    _, bucket, counts = np.unique(directions.astype(int), axis=0, return_inverse=True, return_counts=True)
    quota, bucket = _quota(counts), bucket.ravel()
    order = np.argsort(bucket, kind="stable")
    first = np.cumsum(counts) - counts
    picked = [order[f + np.linspace(0, c - 1, min(quota, c)).astype(int)] for f, c in zip(first, counts, strict=True)]
    chosen: Indices = usable[np.sort(np.concatenate(picked))] if picked else usable
    return chosen


def _quota(counts: Indices) -> int:
    """The largest share per direction that keeps the sum within _POINTS."""
    low, high = 1, _POINTS
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if np.minimum(counts, middle).sum() <= _POINTS else (low, middle - 1)
    return low


def _look(
    scan: Joined, cad: Surface, T_base_part: Array, regions: Regions | None
) -> tuple[Array, Nearest, NDArray[np.bool_]]:
    T = frames.inverse(T_base_part)
    local = frames.transform(T, scan.points)
    found = nearest(cad, local, frames.rotate(T, scan.normals))
    allowed = np.ones(len(local), bool) if regions is None else regions.used(local)
    return local, found, allowed


def _step(local: Array, found: Nearest, weight: Array, cad: Surface) -> tuple[Array, Array]:
    """One Gauss-Newton step about the CAD's centre: twist (6,) and design (N, 6)."""
    design = np.hstack([np.cross(local - cad.centre, found.normal), found.normal])
    N = np.einsum("ni,n,nj->ij", design, weight, design)
    units = np.repeat([cad.size / 2, 1.0], 3)
    values = np.linalg.eigvalsh(N / np.outer(units, units))
    if values[0] < _OPEN * values[-1]:
        raise NoResultError("the scanned surface leaves a direction open (plane, cylinder or sphere); scan an edge too")
    return np.linalg.solve(N, -design.T @ (weight * found.distance)), design
