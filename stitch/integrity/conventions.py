"""Which convention of the poses explains how the scanner moved: A·X = X·B under every hypothesis.

The motions B come from the scans alone (`relative_scans.py`), A from the poses with one mistake undone. A hypothesis
is judged by the motions that close under its best hand-eye, found from pairs of motions (RANSAC; Fischler & Bolles
1981) so that wrong motions of a symmetric part do not count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from stitch import frames
from stitch.frames import Array, Mask
from stitch.integrity.hypotheses import UNITS, Hypothesis, distinct, hypotheses
from stitch.integrity.relative_scans import RelativeScans
from stitch.measurement.session import Session
from stitch.units import METRES

# A motion closes within what no arm exceeds, 10 mrad and 5 mm, beside the registration of two scans.
ROTATION, TRANSLATION_M = 0.015, 0.008
_SAMPLES = 60
# A hypothesis closes if this share of the motions does; and it must leave clearly less open than another to be told
# from it: (1 − score) counts open motions.
_CLOSES = 0.6
_CLEARER = 0.6
# Poses whose motions nearly all close need no other convention.
_ALL = 0.95
# A hypothesis is tried if as many angles of rotation agree as this share of the best one's.
_SCREEN = 0.6
# A factor is one between units if it is this near.
_UNIT_NEAR = 0.05
# Motions: below, chance agrees.
_FEWEST = 4


@dataclass(frozen=True)
class Explained:
    """A hypothesis with the hand-eye that fits it best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    closed: float  # share of the motions that close
    open: float  # mean truncated square of what is left, 0 (all close exactly) … 1
    scale: float  # of the robot's lengths against the scans', where it was fitted; else 1


def explained(session: Session, motions: RelativeScans) -> list[Explained]:
    """All hypotheses about the poses of a session, best first; empty if the scans show too little motion."""
    if len(motions.pairs) < _FEWEST:
        return []
    length = TRANSLATION_M / METRES[session.length_unit]
    tried_all = hypotheses(session)
    out = [_fit(tried_all[0], motions, length, scaled) for scaled in (False, True)]
    if out[0].closed < _ALL:
        screened = _screened(tried_all, motions)
        out += [_fit(h, motions, length, False) for h in distinct(screened, 1e-3, 1e-3 * length)[1:]]
    return sorted(out, key=lambda e: (e.open, e.hypothesis.kind != "stated"))


def verdict(found: Sequence[Explained]) -> tuple[Explained, ...]:
    """The hypotheses that explain the motions as well as any, if the poses as stated do not; () if they do."""
    if not found:
        return ()
    stated = next(e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0)
    best = found[0]
    if stated.open <= best.open / _CLEARER + 0.02 or best.closed < _CLOSES:
        return ()
    close = [e for e in found if e.open <= best.open / _CLEARER + 0.01 and e.closed >= 0.9 * best.closed]
    return tuple(e for e in close if e.hypothesis.kind != "stated" or e.scale != 1.0)


def _screened(tried: Sequence[Hypothesis], motions: RelativeScans) -> list[Hypothesis]:
    """The stated poses, and what could close: motions keep their angle of rotation under any hand-eye (Chen 1991)."""
    v, w = np.array(motions.pairs).T
    seen = _turn(motions.T)
    share = []
    for h in tried:
        T = h.T_reference_mount
        used = np.ones(len(T), bool) if h.used is None else np.isin(np.arange(len(T)), h.used)
        kept = used[v] & used[w]
        near = np.abs(_turn(frames.inverse(T[v]) @ T[w]) - seen) < ROTATION
        share.append(float(near[kept].mean()) if kept.any() else 0.0)
    limit = _SCREEN * max(share)
    return [tried[0]] + [h for h, agree in zip(tried[1:], share[1:], strict=True) if agree >= limit]


def _turn(T: Array) -> Array:
    """Angles of rotation (M,) of motions (M, 4, 4)."""
    return np.asarray(np.arccos(np.clip((np.trace(T[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))


def _fit(hypothesis: Hypothesis, motions: RelativeScans, length: float, scaled: bool) -> Explained:
    used = set(range(len(hypothesis.T_base_flange)) if hypothesis.used is None else hypothesis.used)
    keep = [i for i, (v, w) in enumerate(motions.pairs) if v in used and w in used]
    T = hypothesis.T_reference_mount
    if len(keep) < _FEWEST:
        return Explained(hypothesis, np.eye(4), 0.0, 1.0, 1.0)
    A = np.array([frames.inverse(T[v]) @ T[w] for v, w in (motions.pairs[i] for i in keep)])
    B = motions.T[keep]
    R, turned = _rotation(A, B)
    t, s, moved = _translation(A, B, R, turned < ROTATION, scaled)
    near = (turned < ROTATION) & (moved < length)
    left = np.minimum(1.0, (turned / ROTATION) ** 2 + (moved / length) ** 2)
    out = Explained(hypothesis, frames.make(R, t), float(near.mean()), float(left.mean()), s)
    return _named_unit(out) if scaled else out


def _named_unit(found: Explained) -> Explained:
    """The stated poses with another unit of length."""
    s = found.scale
    h = found.hypothesis
    if s <= 0:
        return replace(found, open=1.0, closed=0.0)
    factor = min(UNITS, key=lambda u: abs(np.log(s / u)))
    if abs(s / factor - 1) < _UNIT_NEAR:
        fix = (
            f"the clouds are {factor:.6g} times as large as the poses say ({UNITS[factor]}): "
            "check cloud_unit and length_unit"
        )
        return replace(found, hypothesis=replace(h, kind="unit", fix=fix))
    fix = f"the clouds are {s:.5g} times as large as the robot's motions say: check their scale"
    return replace(found, hypothesis=replace(h, kind="scale", fix=fix))


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
