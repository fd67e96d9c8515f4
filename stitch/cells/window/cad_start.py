"""Where the part lies, without a guess: principal axes and features give candidates, the surface decides."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from stitch import frames
from stitch.cells.window.cad import CadSurface, sample_partners
from stitch.cells.window.cad_fit import moved_about
from stitch.cells.window.joined_scans import JoinedScans
from stitch.closed_form import feature_matching
from stitch.errors import NoResultError
from stitch.frames import Array, Indices
from stitch.measurement.scan import even_indices

_MIN_START_POINTS = 50
_START_POINTS = 1500  # of the scan that judge a candidate
_KEEP = 6  # candidates that are refined
_REFINE = 20  # steps of a candidate's refinement
_FEATURE_RUNS, _FEATURE_DRAWS, _FEATURE_SAMPLES = 3, 50_000, 6000
# A start of which less than a third of the scan meets the CAD is none.
_LEAST_SHARE = 1 / 3
# A pose that so much of the scan agrees with needs no second opinion.
_CERTAIN = 0.95


@dataclass(frozen=True)
class CadStart:
    """A coarse pose and how well it stands against the next best different one."""

    T_base_part: Array  # (4, 4)
    share: float  # of the scan's points that meet the CAD
    runner_up: float  # the same of the best pose elsewhere; close to `share` means a symmetric part


def find_cad_start(scan: JoinedScans, cad: CadSurface) -> CadStart:
    """Try the 24 ways to lay principal axes on principal axes, and feature matches where none of them meets; refine.

    Features are FPFH with RANSAC (Rusu et al. 2009): they serve where the scan shows only a piece of
    the part, principal axes where it is too smooth for features.

    Raises:
        NoResultError: no candidate brings a third of the scan onto the CAD.
    """
    if scan.usable.sum() < _MIN_START_POINTS:
        raise NoResultError(f"{scan.usable.sum()} usable points in the scan; the rest are edges or seen too flat")
    index = _spread_sample(scan)
    points, normals = scan.points[index], scan.normals[index]
    gate, fine = cad.size / 25, cad.size / 250
    ranked = sorted(_axis_candidates(points, cad), key=lambda T: -_inlier_share(T, points, normals, cad, gate))
    refined = [_refine(T, points, normals, cad, gate) for T in ranked[:_KEEP]]
    shares = [_inlier_share(T, points, normals, cad, fine) for T in refined]
    if max(shares) < _CERTAIN:
        refined += [_refine(T, points, normals, cad, gate) for T in _feature_candidates(points, normals, cad)]
        shares = [_inlier_share(T, points, normals, cad, fine) for T in refined]
    best = int(np.argmax(shares))
    elsewhere = [
        s for T, s in zip(refined, shares, strict=True) if _pose_distance(T, refined[best], cad) > cad.size / 50
    ]
    if shares[best] < _LEAST_SHARE:
        raise NoResultError(
            f"scan and CAD do not meet: {shares[best]:.0%} of the points at best; check the CAD's unit, or cut away "
            "what is not the part"
        )
    return CadStart(refined[best], shares[best], max(elsewhere, default=0.0))


def _spread_sample(scan: JoinedScans) -> Indices:
    """Indices of points evenly over the surface: one per voxel, then evenly thinned."""
    usable = np.flatnonzero(scan.usable)
    size = np.ptp(scan.points[usable], axis=0).max() / 70
    _, first = np.unique(np.floor(scan.points[usable] / size).astype(int), axis=0, return_index=True)
    kept = usable[np.sort(first)]
    if len(kept) < _MIN_START_POINTS:
        raise NoResultError(
            f"the scans reach over {70 * size:.3g}, mostly empty; correct a scanner's pose, or cut them"
        )
    picked: Indices = kept[even_indices(len(kept), _START_POINTS)]
    return picked


def _axis_candidates(points: Array, cad: CadSurface) -> list[Array]:
    """The 24 turns that lay the scan's principal axes onto the CAD's."""
    clouds = (points, cad.samples[::20])
    scan_axes, cad_axes = (np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2] for p in clouds)
    turns = [np.eye(3)[list(p)] * signs for p in permutations(range(3)) for signs in product((1, -1), repeat=3)]
    found = []
    for turn in turns:
        R = scan_axes.T @ turn @ cad_axes
        if np.linalg.det(R) > 0:
            found.append(frames.make(R, points.mean(axis=0) - R @ cad.samples.mean(axis=0)))
    return found


def _feature_candidates(points: Array, normals: Array, cad: CadSurface) -> list[Array]:
    """Poses (4, 4) from feature matching, one per seed."""
    size = cad.size / 60
    step = max(1, len(cad.samples) // _FEATURE_SAMPLES)
    scan = feature_matching.compute_fpfh(points, normals, 5 * size)
    part = feature_matching.compute_fpfh(cad.samples[::step], cad.normals[::step], 5 * size)
    found = []
    for seed in range(_FEATURE_RUNS):
        T_part_base = feature_matching.register_ransac(scan, part, reach=1.5 * size, draws=_FEATURE_DRAWS, seed=seed)
        found.append(frames.inverse(T_part_base))
    return found


def _partners(T_base_part: Array, points: Array, normals: Array, cad: CadSurface) -> tuple[Array, Array, Array]:
    """Points in the part frame, their samples and the samples' normals."""
    T = frames.inverse(T_base_part)
    local = frames.transform(T, points)
    index = sample_partners(cad, local, frames.rotate(T, normals))
    return local, cad.samples[index], cad.normals[index]


def _inlier_share(T_base_part: Array, points: Array, normals: Array, cad: CadSurface, gate: float) -> float:
    local, samples, directions = _partners(T_base_part, points, normals, cad)
    seen = frames.rotate(frames.inverse(T_base_part), normals)
    same = np.einsum("ij,ij->i", seen, directions) > 0.8
    return float(np.mean(same & (np.linalg.norm(local - samples, axis=1) < gate)))


def _refine(T_base_part: Array, points: Array, normals: Array, cad: CadSurface, gate: float) -> Array:
    """Point-to-plane steps with a gate that closes to a tenth."""
    for width in gate * np.geomspace(4.0, 0.1, _REFINE):
        local, samples, directions = _partners(T_base_part, points, normals, cad)
        off = local - samples
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


def _pose_distance(T_a: Array, T_b: Array, cad: CadSurface) -> float:
    corners = cad.samples[:: max(1, len(cad.samples) // 200)]
    return float(np.linalg.norm(frames.transform(T_a, corners) - frames.transform(T_b, corners), axis=1).max())
