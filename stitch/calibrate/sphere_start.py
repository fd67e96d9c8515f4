"""First hand-eye from sphere centres: decoupled where the poses allow it, else from many rotations.

G (V, 4, 4) is T_reference_mount: T_base_flange with the scanner on the robot, T_flange_base with the
sphere on it. The centre is fixed in the reference frame: c = G_v X q_v for the centres q_v seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.calibrate.sphere_views import SphereView, centres
from stitch.frames import Array

# Recorded "equal" orientations differ by up to 0.08° in real logs.
_EQUAL = np.radians(0.1)
_ROTATIONS = 600
_REFINED = 24
# Two hand-eyes further apart than this (rad) are two answers.
_DISTINCT = 0.2
# Singular values below this share of the first give no direction.
_RANK = 0.02


@dataclass(frozen=True)
class SphereStart:
    """A first hand-eye."""

    T_mount: Array  # (4, 4) T_mount_scanner
    signs: Array  # (V,) side of the laser plane on which the centre lies
    rms: float  # of the centres about their common place
    runner_up: float  # rms of the best clearly different answer; inf if none was found


def solve_decoupled(G: Array, q: Array) -> Array | None:
    """Rotation from pairs of equal orientation, then translation from clearly different ones.

    R_v R_X (q_1 − q_2) = p_2 − p_1 within a group of equal orientations R_v; then
    (R_i − R_j) t_X = x_j − x_i with x the groups' centres assembled with t_X = 0.

    Args:
        q: (V, 3) centres in the scanner frame.

    Returns:
        (4, 4) hand-eye, or None where the poses do not allow it.
    """
    groups = equal_orientations(G)
    seen, moved = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for group in groups:
        i, j = np.triu_indices(len(group), 1)
        a, b = group[i], group[j]
        seen.append(q[a] - q[b])
        moved.append((G[b, :3, 3] - G[a, :3, 3]) @ G[group[0], :3, :3])
    correlation = np.concatenate(moved).T @ np.concatenate(seen)
    values = np.linalg.svd(correlation, compute_uv=False)
    if values[1] <= _RANK**2 * values[0]:
        return None
    R = frames.nearest_rotation(correlation)
    turns = np.array([G[group[0], :3, :3] for group in groups])
    placed = [(q[g] @ (G[g[0], :3, :3] @ R).T + G[g, :3, 3]).mean(axis=0) for g in groups]
    i, j = np.triu_indices(len(groups), 1)
    left = (turns[i] - turns[j]).reshape(-1, 3)
    if not len(left) or np.linalg.svd(left, compute_uv=False)[-1] < _RANK:
        return None
    right = (np.array(placed)[j] - np.array(placed)[i]).reshape(-1)
    return frames.make(R, np.linalg.lstsq(left, right, rcond=None)[0])


def equal_orientations(G: Array) -> list[Array]:
    """Indices (n,) of views in groups of one orientation."""
    left, groups = np.arange(len(G)), []
    while len(left):
        same = frames.angle_between(np.broadcast_to(G[left[0]], G[left].shape), G[left]) < _EQUAL
        groups.append(left[same])
        left = left[~same]
    return groups


def global_start(G: Array, views: Sequence[SphereView], coarse: Array | None = None) -> SphereStart:
    """Best of many rotations; for each the sides of the laser planes that agree best.

    Args:
        coarse: (4, 4) hand-eye of the session, tried first.
    """
    rotations = Rotation.random(_ROTATIONS, rng=np.random.default_rng(0)).as_matrix()
    if coarse is not None:
        rotations = np.concatenate([coarse[None, :3, :3], rotations])
    tried = sorted((_solve_sides(G, views, R) for R in rotations), key=lambda start: start.rms)
    best: list[SphereStart] = []
    for start in tried[:_REFINED]:
        for _ in range(6):
            moved = refine_start(G, views, start)
            same = np.array_equal(moved.signs, start.signs)
            start = moved
            if same:
                break
        best.append(start)
    best.sort(key=lambda start: start.rms)
    others = [b.rms for b in best if frames.angle_between(b.T_mount, best[0].T_mount) > _DISTINCT]
    return SphereStart(best[0].T_mount, best[0].signs, best[0].rms, min(others, default=float("inf")))


def _solve_sides(G: Array, views: Sequence[SphereView], R: Array) -> SphereStart:
    """Translation and centre by linear least squares, then the sides, a few times, for one rotation."""
    signs = np.array([v.side for v in views])
    design = np.concatenate([-G[:, :3, :3], np.broadcast_to(np.eye(3), (len(G), 3, 3))], axis=2).reshape(-1, 6)
    inverse = np.linalg.pinv(design, rcond=1e-6)
    T, rms = np.eye(4), np.inf
    for _ in range(4):
        y = (G[:, :3, :3] @ (centres(views, signs) @ R.T)[..., None])[..., 0] + G[:, :3, 3]
        x = inverse @ y.ravel()
        rms = float(np.sqrt(np.mean((y.ravel() - design @ x) ** 2)))
        T = frames.make(R, x[:3])
        signs = choose_sides(G, views, T, x[3:])
    return SphereStart(T, signs, rms, np.inf)


def choose_sides(G: Array, views: Sequence[SphereView], T_mount: Array, centre: Array) -> Array:
    """Sides (V,) on which the centre (3,) of the reference frame lies; those that the session says stay."""
    seen = frames.transform(frames.inverse(G @ T_mount), centre[None])[:, 0]
    found = np.array([1.0 if (s - v.foot) @ v.normal >= 0 else -1.0 for s, v in zip(seen, views, strict=True)])
    said = np.array([v.side for v in views])
    return np.where(said != 0, said, found)


def refine_start(G: Array, views: Sequence[SphereView], start: SphereStart) -> SphereStart:
    """Hand-eye and centre together from the centres with the sides as they stand, then the sides anew."""
    q = centres(views, start.signs)
    soft = np.array([np.eye(3) - (1 - _offset_weight(v)) * np.outer(v.normal, v.normal) for v in views])

    def residual(x: Array) -> Array:
        T = G @ start.T_mount @ frames.exp(x[:6])
        return np.asarray((soft @ (q - frames.transform(frames.inverse(T), x[None, 6:])[:, 0])[..., None]).ravel())

    place = (frames.transform(G @ start.T_mount, q[:, None])[:, 0]).mean(axis=0)
    fit = least_squares(residual, np.concatenate([np.zeros(6), place]), x_scale="jac", max_nfev=30)
    T = start.T_mount @ frames.exp(fit.x[:6])
    signs = choose_sides(G, views, T, fit.x[6:])
    return SphereStart(T, signs, float(np.sqrt(np.mean(fit.fun**2))), np.inf)


def _offset_weight(view: SphereView) -> float:
    """Weight of the offset √(R² − ρ²): its sigma is ρ/√(R² − ρ²) times that of the radius ρ found."""
    if not view.is_line:
        return 1.0
    radius = float(np.linalg.norm(view.points - view.foot, axis=1).mean())
    return min(1.0, view.offset / radius)
