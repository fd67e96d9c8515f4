"""How the scanner moved between views, from the scans alone, and the hand-eye under which the robot moved alike.

The motions B come from scans registered to each other from many starts, without any pose. A motion counts if the
surfaces close; a symmetric part closes in several ways, and then one of them may be the wrong one. The robot's motions
A are those of a hypothesis about its poses. The hand-eye of A·X = X·B is found from pairs of motions (RANSAC; Fischler
& Bolles 1981), so that wrong motions do not count; a hypothesis is judged by the motions that close under it.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.placement import Placement, place_scan, shows_no_surface, surface_of
from stitch.session.capture import Capture, part_size
from stitch.session.session import Mount
from stitch.system.threads import parallel

# A pair of scans counts if this share of the surface near lies on it, and this share of the scan is near.
_MIN_SCAN_CLOSURE, _SHARED = 0.75, 0.35
_SIGMAS = 6.0
# Of the spacing: how far a point lies from its neighbour's tangent plane on a curved surface.
_CURVED = 0.03
_ROW_STEPS = (1, 2)
_START_ROTATIONS_DEG = (30.0, 60.0, 90.0, 135.0, 180.0)
# A motion closes within what no arm exceeds, 10 mrad and 5 mm, beside the registration of two scans.
ROTATION, TRANSLATION_M = 0.015, 0.008
# Below so many motions, chance agrees.
FEWEST = 4
# Pairs of motions from which a rotation of the hand-eye is tried.
_SAMPLES = 60
# Reweighted steps to the least absolute sum.
_ABSOLUTE_STEPS = 12
# A hypothesis is tried if as many angles of rotation agree as this share of the best one's.
_SCREEN = 0.6


@dataclass(frozen=True)
class RelativeScans:
    """M motions between pairs of views."""

    pairs: tuple[tuple[int, int], ...]
    T: Array  # (M, 4, 4) that maps view w's scanner frame into view v's


@dataclass(frozen=True)
class MotionFit:
    """A hypothesis with the hand-eye that fits it best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    closed: float  # share of the motions that close
    open: float  # mean truncated square of what is left, 0 (all close exactly) … 1
    scale: float  # of the robot's lengths against the scans', where it was fitted; else 1


def register_scan_pairs(capture: Capture) -> RelativeScans:
    """Return the scanner's motions between each view and the next two, by surface matching from many starts.

    No pose is used. A motion counts if the surfaces close (`_MIN_SCAN_CLOSURE`) where they are near (`_SHARED`).
    """
    size = part_size([capture])
    count = len(capture.scans)
    turns = _start_rotations()
    usable = [not shows_no_surface(scan) for scan in capture.scans]
    pairs = [(v, v + step) for step in _ROW_STEPS for v in range(count - step)]
    pairs = [(v, w) for v, w in pairs if usable[v] and usable[w]]
    placements = list(parallel(lambda pair: _place_on(capture, *pair, turns, size), pairs, "pairs of scans"))
    good = [i for i, best in enumerate(placements) if best.closure > _MIN_SCAN_CLOSURE and best.near > _SHARED]
    motions = np.array([placements[i].T for i in good]).reshape(-1, 4, 4)
    return RelativeScans(tuple(pairs[i] for i in good), motions)


def _place_on(capture: Capture, v: int, w: int, turns: Array, size: float) -> Placement:
    """Return the best placement of scan w on the surface of scan v: T maps scanner frame w to scanner frame v.

    Args:
        turns: (S, 3, 3) rotations to begin with, the scans' centroids brought together.
        size: of the part, length_unit.
    """
    scan, other = capture.scans[w], capture.scans[v]
    tolerance = _SIGMAS * float(np.hypot(scan.noise, other.noise)) / 2 + _CURVED * other.spacing
    surface = surface_of(capture.scans, np.tile(np.eye(4), (len(capture.scans), 1, 1)), [v], tolerance)
    starts = frames.make(turns, other.points.mean(axis=0) - turns @ scan.points.mean(axis=0))
    return place_scan(scan, surface, starts, size)[0]


def _start_rotations() -> Array:
    """Return rotations (S, 3, 3): the identity, and by several angles about the twelve axes of an icosahedron."""
    golden = (1 + np.sqrt(5)) / 2
    axes = np.array([p for a in (-1, 1) for b in (-golden, golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = [axis * np.radians(angle) for angle in _START_ROTATIONS_DEG for axis in axes]
    return Rotation.from_rotvec(np.array([np.zeros(3), *vectors])).as_matrix()


def alike(T: Array, other: Array, length: float) -> Mask:
    """Return (M,) True for motions (M, 4, 4) that differ by no more than one may leave open: `length`, length_unit."""
    moved = np.linalg.norm((frames.inverse(T) @ other)[:, :3, 3], axis=1)
    return (frames.angle_between(T, other) < ROTATION) & (moved < length)


def screen_hypotheses(tried: Sequence[Hypothesis], motions: RelativeScans) -> list[Hypothesis]:
    """Return the first hypothesis, and those whose motions turn by the scanner's angles about as often as the best.

    Under any hand-eye mount and scanner turn by the same angle (Chen 1991), so that this test needs none.
    """
    v, w = np.array(motions.pairs).T
    angles = frames.angle_between(np.eye(4), motions.T)
    shares = []
    for h in tried:
        T = h.T_reference_mount
        used = np.ones(len(T), bool) if h.used is None else np.isin(np.arange(len(T)), h.used)
        kept = used[v] & used[w]
        near = np.abs(frames.angle_between(T[v], T[w]) - angles) < ROTATION
        shares.append(float(near[kept].mean()) if kept.any() else 0.0)
    limit = _SCREEN * max(shares)
    return [tried[0]] + [h for h, share in zip(tried[1:], shares[1:], strict=True) if share >= limit]


def fit_motions(hypothesis: Hypothesis, motions: RelativeScans, length: float, *, scaled: bool = False) -> MotionFit:
    """Return the hand-eye X of one hypothesis, A·X = X·B, by its rotation first, and how many motions close under it.

    A are motions of the mount under the hypothesis, B those of the scanner. With too few of them the fit is the
    identity, under which none closes.

    Args:
        length: what a motion may leave open, length_unit; of rotations it is `ROTATION`.
        scaled: fit a factor on the robot's lengths too.
    """
    T = hypothesis.T_reference_mount
    pairs = np.array(motions.pairs, int).reshape(-1, 2)
    keep = np.isin(pairs, np.arange(len(T)) if hypothesis.used is None else hypothesis.used).all(axis=1)
    v, w = pairs[keep].T
    if len(v) < FEWEST:
        return MotionFit(hypothesis, np.eye(4), 0.0, 1.0, 1.0)
    A = frames.inverse(T[v]) @ T[w]
    B = motions.T[keep]
    R, turned = _fit_rotation(A, B)
    t, scale, moved = _fit_translation(A, B, R, turned < ROTATION, scaled)
    near = (turned < ROTATION) & (moved < length)
    left = np.minimum(1.0, (turned / ROTATION) ** 2 + (moved / length) ** 2)
    return MotionFit(hypothesis, frames.make(R, t), float(near.mean()), float(left.mean()), scale)


def _fit_rotation(A: Array, B: Array) -> tuple[Array, Array]:
    """Return the rotation R_X (3, 3) of A·X = X·B, and per motion the angle (M,), rad, that it leaves.

    RANSAC: pairs of motions each determine a rotation; the best one is refined by all motions that agree with it, and
    kept as it was if that makes it worse.

    Args:
        A, B: (M, 4, 4) motions of mount and scanner.
    """
    a = frames.log(A)[:, :3]
    b = frames.log(B)[:, :3]
    pairs = list(combinations(range(len(a)), 2))
    step = max(len(pairs) // _SAMPLES, 1)
    i, j = np.array(pairs[::step]).T
    # A third, the common normal, so that two axes determine the rotation.
    left = np.stack([a[i], a[j], np.cross(a[i], a[j])], axis=2)
    right = np.stack([b[i], b[j], np.cross(b[i], b[j])], axis=2)
    R = frames.nearest_rotation(left @ right.transpose(0, 2, 1))
    rest = _angles_left(A, B, R)
    best = int(np.argmin(np.minimum(rest / ROTATION, 1.0).mean(axis=1)))
    chosen = R[best]
    for _ in range(3):
        near = _angles_left(A, B, chosen[None])[0] < 2 * ROTATION
        if near.sum() < 2:
            break
        chosen = frames.nearest_rotation(a[near].T @ b[near])
    if _angles_left(A, B, chosen[None])[0].clip(max=ROTATION).mean() > rest[best].clip(max=ROTATION).mean():
        chosen = R[best]
    return chosen, _angles_left(A, B, chosen[None])[0]


def _angles_left(A: Array, B: Array, R: Array) -> Array:
    """(S, M) rad between R_A and R_X R_B R_Xᵀ for S rotations R_X."""
    turned = R[:, None] @ B[None, :, :3, :3] @ R.transpose(0, 2, 1)[:, None]
    off = turned - A[None, :, :3, :3]
    # ‖R₁ − R₂‖_F = 2√2 sin(θ/2).
    return 2 * np.arcsin(np.clip(np.linalg.norm(off, axis=(2, 3)) / np.sqrt(8), 0, 1))


def _fit_translation(A: Array, B: Array, R: Array, near: Mask, scaled: bool) -> tuple[Array, float, Array]:
    """Return t_X (3,), the scale s, and per motion the residual length (M,) of R_A t_X + s t_A = R_X t_B + t_X.

    Least absolute sum, so that wrong motions pull little.

    Args:
        A, B: (M, 4, 4) motions of mount and scanner.
        R: R_X (3, 3).
        near: (M,) motions whose rotations agree; others hardly count.
        scaled: s is free; else it is 1.
    """
    rows = A[:, :3, :3] - np.eye(3)
    right = np.einsum("ij,mj->mi", R, B[:, :3, 3]) - (0 if scaled else 1) * A[:, :3, 3]
    if scaled:
        rows = np.concatenate([rows, A[:, :3, 3:]], axis=2)
    x = _least_absolute(rows, right, np.where(near, 1.0, 1e-6))
    return x[:3], float(x[3]) if scaled else 1.0, np.linalg.norm(rows @ x - right, axis=1)


def _least_absolute(rows: Array, right: Array, weight: Array) -> Array:
    """Return x (U,) that minimises Σ weight · |rows x − right|, by reweighted least squares in `_ABSOLUTE_STEPS` steps.

    Args:
        rows: (M, 3, U).
        right: (M, 3).
        weight: (M,).
    """
    reweighted = weight
    x: Any = None
    for _ in range(_ABSOLUTE_STEPS):
        root = np.sqrt(reweighted)[:, None]
        stacked = (root[..., None] * rows).reshape(-1, rows.shape[2])
        x = np.linalg.lstsq(stacked, (root * right).reshape(-1), rcond=1e-9)[0]
        left = np.linalg.norm(rows @ x - right, axis=1)
        reweighted = weight / np.maximum(left, 1e-3 * np.median(left) + 1e-12)
    return x


def fit_positions(
    R: Array, known: tuple[Array, Array], mount: Mount, motions: RelativeScans, used: Collection[int], R_mount: Array
) -> Array:
    """Return positions p + Q·u (V, 3) of the flange, with the unknown u under which the motions close best.

    A·X = X·B for motions A of the mount and B of the scanner is linear in u and the hand-eye's translation; both are
    found by the least absolute sum.

    Args:
        R: (V, 3, 3) rotations of T_base_flange.
        known: p (V, 3) and Q (V, 3, U), length_unit.
        used: views whose motions count.
        R_mount: (3, 3) of the hand-eye.
    """
    p, Q = known
    keep = [i for i, (v, w) in enumerate(motions.pairs) if v in used and w in used]
    v, w = np.array([motions.pairs[i] for i in keep]).T
    back = R[v].transpose(0, 2, 1)
    if mount == "eye_in_hand":
        turned, from_v, from_w = back @ R[w], -back, back
    else:
        turned = R[v] @ R[w].transpose(0, 2, 1)
        from_v, from_w = np.broadcast_to(np.eye(3), turned.shape), -turned
    rows = np.concatenate([turned - np.eye(3), from_v @ Q[v] + from_w @ Q[w]], axis=2)
    fixed = np.einsum("mij,mj->mi", from_v, p[v]) + np.einsum("mij,mj->mi", from_w, p[w])
    right = motions.T[keep][:, :3, 3] @ R_mount.T - fixed
    return p + Q @ _least_absolute(rows, right, np.ones(len(rows)))[3:]
