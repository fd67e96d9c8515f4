"""Find the convention of the poses that explains how the scanner moved: A·X = X·B under every hypothesis.

The motions B come from the scans alone (`register_scan_pairs`), A from the poses with one mistake undone. A hypothesis
is judged by the motions that close under its best hand-eye (`fit_motions`).
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.fit.coarse import SCORE_SHARE, icp_from_starts
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.units import METRES
from stitch.screening.hypotheses import (
    MOST_EXCHANGED,
    UNITS,
    Hypothesis,
    distinct,
    hypotheses,
    known_unit_ratio,
    scale_text,
    stated_hypothesis,
)
from stitch.screening.placement import Placement, place_scan, shows_no_surface, surface_of
from stitch.session.capture import Capture, part_size
from stitch.session.session import Mount, SessionData
from stitch.system.threads import parallel

# How the scanner moved between views, from the scans alone: what every hypothesis about the poses has to explain.
#
# Neighbours in the list are registered to each other from many starts. A motion counts if the surfaces close; a
# symmetric part closes in several ways, and then one of them may be the wrong one.

# A pair counts if this share of the surface near lies on it, and this share of the scan is near.
_MIN_SCAN_CLOSURE, _SHARED = 0.75, 0.35
_SIGMAS = 6.0
# Of the spacing: how far a point lies from its neighbour's tangent plane on a curved surface.
_CURVED = 0.03
_ROW_STEPS = (1, 2)
_START_ROTATIONS_DEG = (0.0, 30.0, 60.0, 90.0, 135.0, 180.0)


@dataclass(frozen=True)
class RelativeScans:
    """M motions between pairs of views."""

    pairs: tuple[tuple[int, int], ...]
    T: Array  # (M, 4, 4) that maps view w's scanner frame into view v's


def register_scan_pairs(capture: Capture) -> RelativeScans:
    """Motions between each view and the next two of the list, without any pose."""
    size = part_size([capture])
    views = len(capture.scans)
    pairs = [(v, v + step) for step in _ROW_STEPS for v in range(views - step)]
    starts = _start_rotations()
    usable = [not shows_no_surface(scan) for scan in capture.scans]
    tried = [(v, w) for v, w in pairs if usable[v] and usable[w]]
    found = list(parallel(lambda pair: _motion_between(capture, *pair, starts, size), tried, "pairs of scans"))
    good = [i for i, best in enumerate(found) if best.closure > _MIN_SCAN_CLOSURE and best.near > _SHARED]
    motions = np.array([found[i].T for i in good]).reshape(-1, 4, 4)
    return RelativeScans(tuple(tried[i] for i in good), motions)


def _motion_between(capture: Capture, v: int, w: int, turns: Array, size: float) -> Placement:
    scan, other = capture.scans[w], capture.scans[v]
    tolerance = _SIGMAS * float(np.hypot(scan.noise, other.noise)) / 2 + _CURVED * other.spacing
    surface = surface_of(capture.scans, np.tile(np.eye(4), (len(capture.scans), 1, 1)), [v], tolerance)
    own, there = scan.points.mean(axis=0), other.points.mean(axis=0)
    starts = frames.make(turns, there - turns @ own)
    return place_scan(scan, surface, starts, size)[0]


def _start_rotations() -> Array:
    """(S, 3, 3) rotations: none, and about twelve axes."""
    golden = (1 + np.sqrt(5)) / 2
    axes = np.array([p for a in (-1, 1) for b in (-golden, golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = [a * np.radians(angle) for angle in _START_ROTATIONS_DEG[1:] for a in axes]
    return np.asarray(Rotation.from_rotvec(np.array([np.zeros(3), *vectors])).as_matrix())


# Positions of which a table of poses has lost something, as the scanner's motions have them by A·X = X·B.

_POSITION_STEPS = 12


def fit_positions(
    R: Array, known: tuple[Array, Array], mount: Mount, motions: RelativeScans, used: Collection[int], R_mount: Array
) -> Array:
    """(V, 3) positions p + Q·u of the flange with the u under which most motions close, least absolute sum (IRLS).

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
    return np.asarray(p + Q @ _least_absolute(rows, right)[3:])


def _least_absolute(rows: Array, right: Array) -> Array:
    """(U,) least sum of the lengths of rows (M, 3, U) · x − right (M, 3)."""
    weight = np.ones(len(rows))
    for _ in range(_POSITION_STEPS):
        root = np.sqrt(weight)[:, None]
        x = np.linalg.lstsq(
            (root[..., None] * rows).reshape(-1, rows.shape[2]), (root * right).reshape(-1), rcond=1e-9
        )[0]
        left = np.linalg.norm(rows @ x - right, axis=1)
        weight = 1 / np.maximum(left, 1e-3 * np.median(left) + 1e-12)
    return np.asarray(x)


# The hand-eye under which the robot's motions A explain those of the scanner B: A·X = X·B, robustly.
#
# Found from pairs of motions (RANSAC; Fischler & Bolles 1981), so that wrong motions of a symmetric part do not count.

# A motion closes within what no arm exceeds, 10 mrad and 5 mm, beside the registration of two scans.
ROTATION, TRANSLATION_M = 0.015, 0.008
_SAMPLES = 60
# Below so many motions, chance agrees.
FEWEST = 4
# A hypothesis is tried if as many angles of rotation agree as this share of the best one's.
_SCREEN = 0.6


@dataclass(frozen=True)
class MotionFit:
    """A hypothesis with the hand-eye that fits it best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    closed: float  # share of the motions that close
    open: float  # mean truncated square of what is left, 0 (all close exactly) … 1
    scale: float  # of the robot's lengths against the scans', where it was fitted; else 1


def screen_hypotheses(tried: Sequence[Hypothesis], motions: RelativeScans) -> list[Hypothesis]:
    """The first hypothesis, and what could close: motions keep their angle under any hand-eye (Chen 1991)."""
    v, w = np.array(motions.pairs).T
    seen = rotation_angles(motions.T)
    share = []
    for h in tried:
        T = h.T_reference_mount
        used = np.ones(len(T), bool) if h.used is None else np.isin(np.arange(len(T)), h.used)
        kept = used[v] & used[w]
        near = np.abs(rotation_angles(frames.inverse(T[v]) @ T[w]) - seen) < ROTATION
        share.append(float(near[kept].mean()) if kept.any() else 0.0)
    limit = _SCREEN * max(share)
    return [tried[0]] + [h for h, agree in zip(tried[1:], share[1:], strict=True) if agree >= limit]


def rotation_angles(T: Array) -> Array:
    """Angles of rotation (M,) of motions (M, 4, 4)."""
    return np.asarray(np.arccos(np.clip((np.trace(T[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))


def fit_motions(hypothesis: Hypothesis, motions: RelativeScans, length: float, *, scaled: bool = False) -> MotionFit:
    """The hand-eye of one hypothesis.

    Args:
        length: what a motion may leave open, length_unit.
        scaled: fit the scale of the robot's lengths too.
    """
    T, pairs = hypothesis.T_reference_mount, np.array(motions.pairs, int).reshape(-1, 2)
    keep = np.isin(pairs, np.arange(len(T)) if hypothesis.used is None else hypothesis.used).all(axis=1)
    (v, w), B = pairs[keep].T, motions.T[keep]
    if len(v) < FEWEST:
        return MotionFit(hypothesis, np.eye(4), 0.0, 1.0, 1.0)
    A = frames.inverse(T[v]) @ T[w]
    R, turned = _rotation(A, B)
    t, s, moved = _translation(A, B, R, turned < ROTATION, scaled)
    near = (turned < ROTATION) & (moved < length)
    left = np.minimum(1.0, (turned / ROTATION) ** 2 + (moved / length) ** 2)
    return MotionFit(hypothesis, frames.make(R, t), float(near.mean()), float(left.mean()), s)


def _rotation(A: Array, B: Array) -> tuple[Array, Array]:
    """R_X (3, 3) and per motion what is left, rad: the best of many pairs, then all that agree."""
    a, b = (frames.log(T)[:, :3] for T in (A, B))
    pairs = list(combinations(range(len(a)), 2))
    step = max(len(pairs) // _SAMPLES, 1)
    i, j = np.array(pairs[::step]).T
    # A third, the common normal, so that two axes determine the rotation.
    left = np.stack([a[i], a[j], np.cross(a[i], a[j])], axis=2)
    right = np.stack([b[i], b[j], np.cross(b[i], b[j])], axis=2)
    R = frames.nearest_rotation(left @ right.transpose(0, 2, 1))
    rest = _angles(A, B, R)
    best = int(np.argmin(np.minimum(rest / ROTATION, 1.0).mean(axis=1)))
    chosen = R[best]
    for _ in range(3):
        near = _angles(A, B, chosen[None])[0] < 2 * ROTATION
        if near.sum() < 2:
            break
        chosen = frames.nearest_rotation(a[near].T @ b[near])
    if _angles(A, B, chosen[None])[0].clip(max=ROTATION).mean() > rest[best].clip(max=ROTATION).mean():
        chosen = R[best]
    return chosen, _angles(A, B, chosen[None])[0]


def _angles(A: Array, B: Array, R: Array) -> Array:
    """(S, M) rad between R_A and R_X R_B R_Xᵀ for S rotations R_X."""
    turned = R[:, None] @ B[None, :, :3, :3] @ R.transpose(0, 2, 1)[:, None]
    off = turned - A[None, :, :3, :3]
    # ‖R₁ − R₂‖_F = 2√2 sin(θ/2).
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(off, axis=(2, 3)) / np.sqrt(8), 0, 1)))


def _translation(A: Array, B: Array, R: Array, near: Mask, scaled: bool) -> tuple[Array, float, Array]:
    """t_X (3,), scale and per motion what is left: R_A t_X + s t_A = R_X t_B + t_X, least absolute sum (IRLS)."""
    M = len(A)
    rows = A[:, :3, :3] - np.eye(3)
    right = np.einsum("ij,mj->mi", R, B[:, :3, 3]) - (0 if scaled else 1) * A[:, :3, 3]
    if scaled:
        rows = np.concatenate([rows, A[:, :3, 3:]], axis=2)
    weight = np.where(near, 1.0, 1e-6)
    x = np.zeros(rows.shape[2])
    for _ in range(12):
        root = np.sqrt(weight)[:, None]
        x = np.linalg.lstsq((root[..., None] * rows).reshape(3 * M, -1), (root * right).reshape(-1), rcond=1e-9)[0]
        left = np.linalg.norm(rows @ x - right, axis=1)
        weight = np.where(near, 1.0, 1e-6) / np.maximum(left, 1e-3 * np.median(left) + 1e-12)
    return x[:3], float(x[3]) if scaled else 1.0, left


# Poses of half a step before or after the scans: each midway between its own row's and the previous or next one's.
#
# A motion between scans is halved as a screw, and so the motions between poses that were stated follow from it; the
# hand-eye under which they do puts every pose back by half a motion. Programs that interpolate turn evenly and move the
# flange along a line: then its positions are found from the motions, since one of them tells all others.

_FIX = (
    "every pose stands half a row {} its scan: midway between the poses of this scan and the {} one, as if it had been "
    "interpolated to another time: pair scans and poses by their own times"
)
_WORDS = {1: ("after", "next"), -1: ("before", "previous")}


def poses_between_rows(stated: Hypothesis, motions: RelativeScans, length: float) -> Iterator[Hypothesis]:
    """The poses that these would be midway between.

    Args:
        length: what a motion may leave open, length_unit.
    """
    steps = {v: frames.log(motions.T[i]) for i, (v, w) in enumerate(motions.pairs) if w == v + 1}
    for ahead in (1, -1):
        # Half the motion from a row to its neighbour.
        half = {
            v: 0.5 * ahead * steps[min(v, v + ahead)]
            for v in range(len(stated.T_base_flange))
            if min(v, v + ahead) in steps
        }
        pairs = tuple((v, v + 1) for v in half if v + 1 in half and v in steps)
        if len(pairs) < FEWEST:
            continue
        seen = np.array([frames.exp(-half[v]) @ frames.exp(steps[v]) @ frames.exp(half[w]) for v, w in pairs])
        X = fit_motions(stated, RelativeScans(pairs, seen), length).T_mount
        used = tuple(sorted(half))
        T = np.array(stated.T_reference_mount)
        for v in used:
            T[v] = T[v] @ X @ frames.exp(-half[v]) @ frames.inverse(X)
        fix = _FIX.format(*_WORDS[ahead])
        turned = T if stated.mount == "eye_in_hand" else frames.inverse(T)
        along = _positions_along_lines(stated, turned, motions, (ahead, used), X)
        for poses in (turned, frames.make(turned[:, :3, :3], along)):
            yield Hypothesis("shifted", poses, stated.mount, fix, (), used)


def _positions_along_lines(
    stated: Hypothesis, turned: Array, motions: RelativeScans, rows: tuple[int, tuple[int, ...]], T_mount: Array
) -> Array:
    """(V, 3) positions of which those stated are the middles."""
    ahead, used = rows
    middle, views = stated.T_base_flange[:, :3, 3], len(turned)
    p, Q = np.zeros((views, 3)), np.tile(np.eye(3), (views, 1, 1))
    for v in range(1, views):
        p[v], Q[v] = 2 * middle[v - 1 if ahead > 0 else v] - p[v - 1], -Q[v - 1]
    return fit_positions(turned[:, :3, :3], (p, Q), stated.mount, motions, used, T_mount[:3, :3])


# How near the clouds' centroids come to one point under the best hand-eye of each hypothesis: a first, cheap judge.
#
# The centroid of a view leans to the side that it sees, by about as much in every view: under right poses the centroids
# meet within some hundredths of the part's size, under wrong ones within about all of it. All hypotheses and starts are
# minimised side by side (Levenberg 1944; Marquardt 1963).

_STARTS = 12
_CENTROID_STEPS = 40
# Problems minimised at a time: memory.
_BATCH = 4000


def fit_centroids(tried: Sequence[Hypothesis], centroids: Array) -> list[tuple[float, Array]]:
    """Per hypothesis the rms distance of the placed centroids from their mean, and the hand-eye (4, 4).

    Args:
        centroids: (V, 3) of the scans, scanner frame.
    """
    per_batch = max(_BATCH // _STARTS, 1)
    groups = [tried[i : i + per_batch] for i in range(0, len(tried), per_batch)]
    return [pair for group in groups for pair in _fit_batch(group, centroids)]


def _fit_batch(tried: Sequence[Hypothesis], centroids: Array) -> list[tuple[float, Array]]:
    H, V = len(tried), len(centroids)
    poses = np.repeat(np.array([h.T_reference_mount for h in tried]), _STARTS, axis=0)
    used = np.ones((H, V))
    for i, h in enumerate(tried):
        if h.used is not None:
            used[i] = np.isin(np.arange(V), h.used)
    share = np.repeat(used / used.sum(axis=1, keepdims=True), _STARTS, axis=0)
    # Random, yet the same in every run.
    starts = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_matrix()
    X = frames.make(np.tile(starts, (H, 1, 1)), np.zeros(3))
    X[:, :3, 3] = _best_translation(poses, X, centroids, share)
    cost = _centroid_cost(poses, X, centroids, share)
    damping = np.full(len(X), 1e-3)
    for _ in range(_CENTROID_STEPS):
        step = _centroid_step(poses, X, centroids, share, damping)
        new = X @ frames.exp(step)
        new_cost = _centroid_cost(poses, new, centroids, share)
        better = new_cost < cost
        X = np.where(better[:, None, None], new, X)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 8), 1e-9, 1e6)
    cost = cost.reshape(H, _STARTS)
    best = np.argmin(cost, axis=1)
    return [(float(np.sqrt(cost[i, b])), X[i * _STARTS + b]) for i, b in enumerate(best)]


def _centroid_residual(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    """(P, V, 3) placed centroids about their mean."""
    placed = frames.transform(poses @ X[:, None], centroids[None, :, None])[:, :, 0]
    return np.asarray(placed - np.einsum("pv,pvi->pi", share, placed)[:, None])


def _centroid_cost(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    return np.asarray(np.einsum("pv,pvi->p", share, _centroid_residual(poses, X, centroids, share) ** 2))


def _best_translation(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    """(P, 3) that brings the centroids closest together while the rotations stay."""
    R = poses[..., :3, :3]
    M = R - np.einsum("pv,pvij->pij", share, R)[:, None]
    r = _centroid_residual(poses, X, centroids, share)
    normal = np.einsum("pv,pvki,pvkj->pij", share, M, M) + 1e-9 * np.eye(3)
    right = np.einsum("pv,pvki,pvk->pi", share, M, r)
    return np.asarray(-np.linalg.solve(normal, right[..., None])[..., 0])


def _centroid_step(poses: Array, X: Array, centroids: Array, share: Array, damping: Array) -> Array:
    """(P, 6) right twists of the hand-eyes."""
    R = (poses @ X[:, None])[..., :3, :3]
    J = np.concatenate([-R @ frames.skew(centroids)[None], R], axis=3)
    J = J - np.einsum("pv,pvij->pij", share, J)[:, None]
    r = _centroid_residual(poses, X, centroids, share)
    normal = np.einsum("pv,pvki,pvkj->pij", share, J, J, optimize=True)
    right = np.einsum("pv,pvki,pvk->pi", share, J, r, optimize=True)
    # Damped by its own diagonal: rotations and translations have scales of their own.
    diagonal = np.einsum("pii->pi", normal)
    floor = 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12
    damped = normal + (damping[:, None] * diagonal + floor)[:, :, None] * np.eye(6)
    return np.asarray(-np.linalg.solve(damped, right[..., None])[..., 0])


# Tables of poses of which one part was written in another way than the rest: two programs made them, or two people.

# Mistakes that turn each pose by itself.
_OF_ONE_ROW = ("inverse", "quaternion", "euler", "degrees")


def hypotheses_by_table_part(
    tried: Sequence[Hypothesis], motions: RelativeScans, names: Sequence[str]
) -> Iterator[Hypothesis]:
    """The stated poses, up to some row or from it on with a mistake undone that turns them.

    Args:
        tried: hypotheses, the first of which is the poses as stated.
        names: of the views.
    """
    v, w = np.array(motions.pairs).T
    sides = [
        side
        for side in _table_parts(len(names))
        if min((side[v] & side[w]).sum(), (~side[v] & ~side[w]).sum()) >= FEWEST
    ]
    stated, seen = tried[0].T_reference_mount[:, :3, :3], rotation_angles(motions.T)
    for h in tried[1:]:
        if h.kind not in _OF_ONE_ROW or not sides:
            continue
        R = np.array([stated, h.T_reference_mount[:, :3, :3]])
        if np.abs(R[1] - R[0]).max() < ROTATION:
            continue
        near = np.array([[_motions_of_same_angle(R[a][v], R[b][w], seen) for b in (0, 1)] for a in (0, 1)])
        agree = [near[side[v].astype(int), side[w].astype(int), np.arange(len(v))].mean() for side in sides]
        if max(agree) <= max(near[0, 0].mean(), near[1, 1].mean()):
            continue
        # Both sides of one row may turn alike under a reading, and only the hand-eye tells which was read so.
        for side in (own for own, share in zip(sides, agree, strict=True) if share == max(agree)):
            rows = tuple(int(row) for row in np.flatnonzero(side))
            T = np.where(side[:, None, None], h.T_base_flange, tried[0].T_base_flange)
            fix = f"only from {names[rows[0]]} to {names[rows[-1]]}: {h.fix}"
            yield replace(h, T_base_flange=T, fix=fix, rows=rows)


def _table_parts(views: int) -> Iterator[Mask]:
    """(V,) bool of the rows up to each one, and from each one on."""
    for k in range(1, views):
        yield np.arange(views) < k
        yield np.arange(views) >= k


def _motions_of_same_angle(R_v: Array, R_w: Array, seen: Array) -> Mask:
    """(M,) motions between rotations (M, 3, 3) that turn as far as the scanner did."""
    cosine = (np.einsum("mij,mij->m", R_v, R_w) - 1) / 2
    return np.asarray(np.abs(np.arccos(np.clip(cosine, -1, 1)) - seen) < ROTATION)


# A column of the positions that holds one value in all rows, though the scanner moved along it.

# Of the largest span of a column: less is one value.
_ONE_VALUE = 1e-6


def restore_stuck_columns(stated: MotionFit, motions: RelativeScans, length: float) -> Iterator[Hypothesis]:
    """The poses with the values of such a column that the motions ask for, if most rows have others.

    Args:
        length: what a motion may leave open, length_unit.
    """
    h = stated.hypothesis
    T, R_mount = h.T_base_flange, stated.T_mount[:3, :3]
    position, views = T[:, :3, 3], len(T)
    span = np.ptp(position, axis=0)
    for axis in np.flatnonzero(span <= _ONE_VALUE * span.max()):
        Q = np.zeros((views, 3, views))
        Q[np.arange(views), axis, np.arange(views)] = 1.0
        moved = fit_positions(T[:, :3, :3], (position, Q), h.mount, motions, range(views), R_mount)
        column = moved[:, axis]
        if np.median(np.abs(column - np.median(column))) > length:
            fix = (
                f"{'xyz'[axis]} of the positions is {position[0, axis]:.6g} in all rows, and the scans show that it "
                "changes; to fix: export the poses again, with this column"
            )
            yield Hypothesis("scale", frames.make(T[:, :3, :3], moved), h.mount, fix)


# Of its length: how near the direction and the factor of a linear axis are to what they are taken for.
_AXIS_NEAR = 0.05


def poses_on_linear_axis(
    session: SessionData, rows: Indices, stated: MotionFit, motions: RelativeScans
) -> Iterator[Hypothesis]:
    """The poses with a column beside them added along the direction that the motions ask for: a rail, a lift.

    A direction of another length than the column's unit allows is none.
    """
    h = stated.hypothesis
    T, R_mount = h.T_base_flange, stated.T_mount[:3, :3]
    for name in session.views[0].covariates:
        column = np.array([session.views[v].covariates.get(name, np.nan) for v in rows])
        if not np.isfinite(column).all() or np.ptp(column) == 0:
            continue
        Q = column[:, None, None] * np.eye(3)
        moved = fit_positions(T[:, :3, :3], (T[:, :3, 3], Q), h.mount, motions, range(len(T)), R_mount)
        farthest = int(np.argmax(np.abs(column)))
        along = (moved - T[:, :3, 3])[farthest] / column[farthest]
        length = float(np.linalg.norm(along))
        unit = min((1.0, 1000.0, 0.001), key=lambda u: abs(np.log(max(length, 1e-12) / u)))
        if abs(length / unit - 1) > _AXIS_NEAR:
            continue
        axis = int(np.argmax(np.abs(along)))
        exact = np.eye(3)[axis] * np.sign(along[axis]) * unit
        straight = np.linalg.norm(along - exact) < _AXIS_NEAR * unit
        by = exact if straight else along * unit / length
        sign, times = ("+" if by[axis] > 0 else "-"), "" if unit == 1 else f" {unit:g} *"
        where = f"write {'xyz'[axis]} {sign}{times} {name} in place of {'xyz'[axis]}"
        if not straight:
            where = f"add {name} times ({', '.join(f'{x:.4g}' for x in by)}) to x, y, z"
        fix = f"{name} is a linear axis that carries the robot, and the positions leave it out; to fix: {where}"
        yield Hypothesis("linear_axis", frames.make(T[:, :3, :3], T[:, :3, 3] + column[:, None] * by), h.mount, fix)


# Another hypothesis is refuted by the surfaces if it leaves this much more between them. Under rows in any order, where
# none is right, the best of 58 readings led by 1.12 at most (four views) and by 1.04 (seven to twelve); right ones led
# by 1.4 to 2.0 where all views overlap, by less where they go all round a part: there the motions decide.
CLEARLY_BETTER = 1.25


@dataclass(frozen=True)
class SurfaceFit:
    """A hypothesis with the hand-eye under which its views fall together best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    misfit: float  # length_unit: rms distance between views, truncated; what it is truncated at where none overlap
    meets: bool  # some views overlap


def surface_misfit(capture: Capture, hypothesis: Hypothesis, starts: Sequence[Array]) -> SurfaceFit:
    """Close in from some hand-eyes (4, 4).

    Args:
        capture: the scans; its own poses do not count.
    """
    posed = replace(capture, T_reference_mount=hypothesis.T_reference_mount)
    if hypothesis.used is not None:
        left_out = np.setdiff1d(np.arange(len(capture.scans)), hypothesis.used)
        posed = posed.without(left_out)
    named = [(str(i), T) for i, T in enumerate(starts)]
    ends = icp_from_starts([posed], named, part_size([posed]))
    if not ends:
        return SurfaceFit(hypothesis, np.asarray(starts[0]), SCORE_SHARE * part_size([posed]), False)
    best = min(ends, key=lambda end: end.score)
    return SurfaceFit(hypothesis, best.T_mount, best.score, True)


# Which mistake, undone, lets the surfaces of all views fall together: asked where motions between scans do not tell.
#
# Parts that look alike from several sides, such as plates with holes, close pair by pair in wrong ways, so that too few
# motions agree under any hypothesis. All views at once close under the right one alone.

# Hypotheses that the surfaces see: those that the motions like best.
_HYPOTHESES_TRIED = 5


def hypotheses_by_surface(capture: Capture, found: Sequence[MotionFit]) -> tuple[SurfaceFit, ...]:
    """The mistakes under which the views fall together clearly better than as stated, best first; () if none does.

    Those that cannot be told from the best stand behind it.

    Args:
        found: hypotheses about the poses, the likeliest first (see `explained`).
    """
    stated = next((e for e in found if e.hypothesis.kind == "stated"), None)
    if stated is None:
        return ()
    tried = [stated, *[e for e in found if e.hypothesis.kind != "stated"][:_HYPOTHESES_TRIED]]
    posed = [_scaled_hypothesis(e) for e in tried]
    near = fit_centroids(posed, np.array([scan.points.mean(axis=0) for scan in capture.scans]))
    starts = [[T, e.T_mount] for (_, T), e in zip(near, tried, strict=True)]
    fallen = [surface_misfit(capture, h, own) for h, own in zip(posed, starts, strict=True)]
    best, *others = sorted(fallen[1:], key=lambda f: f.misfit)
    if not best.meets or best.misfit * CLEARLY_BETTER > fallen[0].misfit:
        return ()
    return (best, *(f for f in others if f.misfit <= CLEARLY_BETTER * best.misfit))


def _scaled_hypothesis(found: MotionFit) -> Hypothesis:
    """The hypothesis with the robot's lengths in the scans' unit."""
    T = found.hypothesis.T_base_flange
    return replace(found.hypothesis, T_base_flange=frames.make(T[:, :3, :3], found.scale * T[:, :3, 3]))


# A hypothesis closes if this share of the motions does; and it must leave clearly less open than another to be told
# from it: (1 − score) counts open motions.
_MIN_CLOSED_SHARE = 0.6
_CLEARER, _CLEAR_OPEN = 0.6, 0.02
# Short of that: this share under one reading, and under the stated one so little of it that chance does as much.
_MANY_CLOSED, _FEW_CLOSED, _AS_MANY = 0.4, 0.2, 0.75
# Poses whose motions nearly all close need no other convention.
_ALL = 0.95


def rank_hypotheses(session: SessionData, motions: RelativeScans, rows: Indices | None = None) -> list[MotionFit]:
    """Return all hypotheses about the poses of a session, best first; empty if the scans show too little motion.

    Args:
        rows: of the session between which the motions are, by their index among these; None: all.
    """
    if len(motions.pairs) < FEWEST:
        return []
    length = TRANSLATION_M / METRES[session.length_unit]
    every = np.arange(len(session.views)) if rows is None else rows
    stated = stated_hypothesis(session, every)
    out = [fit_motions(stated, motions, length)]
    scaled = _other_length_unit(fit_motions(stated, motions, length, scaled=True))
    if out[0].closed < _ALL:
        tried = hypotheses(session, every, _accused_views(out[0], motions, length))
        tried += restore_stuck_columns(out[0], motions, length)
        tried += poses_on_linear_axis(session, every, out[0], motions)
        tried += poses_between_rows(stated, motions, length)
        tried += hypotheses_by_table_part(tried, motions, [session.names[v] for v in every])
        out += fit_hypotheses(tried, motions, session.length_unit)[1:]
    # A scale that leaves nothing of the positions closes as well as what explains them.
    if scaled.hypothesis.kind != "scale" or scaled.closed * _AS_MANY > max(e.closed for e in out):
        out.append(scaled)
    return sorted(out, key=lambda e: (e.open, e.hypothesis.kind != "stated"))


def _accused_views(stated: MotionFit, motions: RelativeScans, length: float) -> list[int]:
    """Return the views of which the largest share of motions stays open under the poses as stated."""
    T = stated.hypothesis.T_reference_mount
    v, w = np.array(motions.pairs).T
    off = frames.inverse(stated.T_mount) @ frames.inverse(T[v]) @ T[w] @ stated.T_mount @ frames.inverse(motions.T)
    wrong = (rotation_angles(off) > ROTATION) | (np.linalg.norm(off[:, :3, 3], axis=1) > length)
    open_share = np.array(
        [wrong[(v == i) | (w == i)].mean() if np.any((v == i) | (w == i)) else 1 for i in range(len(T))]
    )
    return sorted(np.argsort(-open_share, kind="stable")[:MOST_EXCHANGED].tolist())


def fit_hypotheses(
    tried: Sequence[Hypothesis], motions: RelativeScans, length_unit: str, *, scaled: bool = False
) -> list[MotionFit]:
    """Fit hypotheses that could close, the first always, in their order; those that move alike are one.

    Args:
        scaled: fit the scale of the robot's lengths too.
    """
    if len(motions.pairs) < FEWEST:
        return []
    length = TRANSLATION_M / METRES[length_unit]
    kept = distinct(screen_hypotheses(tried, motions), 1e-3, 1e-3 * length)
    return [fit_motions(h, motions, length, scaled=scaled) for h in kept]


def equivalent_hypotheses(found: Sequence[MotionFit]) -> list[MotionFit]:
    """The hypotheses that these motions cannot tell from the best, best first; empty if none explains them."""
    ranked = sorted(found, key=lambda e: e.open)
    if not ranked or ranked[0].closed < _MIN_CLOSED_SHARE:
        return []
    return [e for e in ranked if e.open <= ranked[0].open / _CLEARER + _CLEAR_OPEN]


def proven_hypotheses(found: Sequence[MotionFit]) -> tuple[MotionFit, ...]:
    """The hypotheses that explain the motions as well as any, if the poses as stated do not; () if they do."""
    if not found:
        return ()
    stated = next(e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0)
    best = found[0]
    if stated.open <= best.open / _CLEARER + _CLEAR_OPEN or best.closed < _MIN_CLOSED_SHARE:
        return ()
    close = [e for e in found if e.open <= best.open / _CLEARER + 0.01 and e.closed >= 0.9 * best.closed]
    return tuple(e for e in close if e.hypothesis.kind != "stated" or e.scale != 1.0)


def likeliest_hypotheses(found: Sequence[MotionFit]) -> tuple[MotionFit, ...]:
    """The readings that agree with many motions where the stated one agrees with hardly any; () if none does.

    Less than `verdict` asks for: a part that slides on itself closes half of the motions under any reading. So it is
    for sessions of which views are accused anyway.
    """
    if not found:
        return ()
    stated = max(e.closed for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0)
    most = max(e.closed for e in found)
    if most < _MANY_CLOSED or stated > _FEW_CLOSED * most:
        return ()
    return tuple(sorted((e for e in found if e.closed >= _AS_MANY * most), key=lambda e: -e.closed))


def _other_length_unit(found: MotionFit) -> MotionFit:
    """The stated poses with another unit of length."""
    s = found.scale
    h = found.hypothesis
    if s <= 0:
        return replace(found, open=1.0, closed=0.0)
    factor = known_unit_ratio(s)
    if factor is not None:
        fix = (
            f"the clouds are {factor:.6g} times as large as the poses say ({UNITS[factor]}); to fix: correct "
            "cloud_unit or length_unit"
        )
        return replace(found, hypothesis=replace(h, kind="unit", fix=fix))
    return replace(found, hypothesis=replace(h, kind="scale", fix=scale_text(s)))
