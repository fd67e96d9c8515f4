"""What to measure next: the pose that separates two suspects best, or the artefact that does.

Two effects a and b are told apart by what of a's pattern b cannot imitate: λ = |y_a − best of b|² in units
of the scatter. A further view adds six rows to both patterns; among poses that the arm can take and in which
the scanner would see the part as it has before, the one that adds most is proposed.
"""

from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch import robot as kinematics
from stitch.diagnosis.aliases import SIMILAR, alias_matrix
from stitch.diagnosis.candidates import with_values
from stitch.diagnosis.pose_evidence import PoseEvidence
from stitch.diagnosis.score import Score
from stitch.diagnosis.select import Ranked, Selection
from stitch.effects.chain import Chain, placed, twists
from stitch.effects.columns import POINTS
from stitch.effects.views import torques_of
from stitch.frames import Array

_SAMPLES = 6000
_TRIED = 250
_SPREAD = np.radians(40.0)  # about joint angles that were driven before
_LIMIT = np.radians(170.0)  # of joints whose limits nobody stated, unless they were beyond already
# P(correct) = Φ(√(λ/2)) = 0.95.
_ENOUGH = 5.4

ARTEFACTS = {
    "range_scale": "scan a sphere or ball bar of known size, or the part's CAD: overlaps alone hardly show a scale",
    "range_nonlinearity": "scan one patch at three distances, near, at the standoff and far",
    "incidence_bias": "scan one patch straight and at 60° from the same distance",
    "intensity_bias": "scan a flat plate with a black and a white half",
    "field_curvature": "scan a flat plate that fills the field, then the same turned by 180° about the view axis",
    "lens_distortion": "repeat a view with the scanner or the part turned by 180° about the view axis",
    "scanner_thermal_scale": "repeat the first view once the scanner is warm, and again after it has cooled",
    "latency": "repeat a sweep at half the speed and in the other direction",
    "mount_drift": "repeat the first views at the end without a pause",
    "mount_warmup": "repeat one view every two minutes after switching on",
    "joint_compliance": "repeat three views with another payload",
    "backlash": "repeat three views approached from the other side of every joint",
    "settling": "repeat three views after waiting five seconds before the scan",
    "robot_thermal_growth": "repeat the first views once the arm is warm",
    "fixture_drift": "clamp the part anew and repeat the first views at the end",
    "part_growth": "repeat a view of the part at another temperature, with the cell unchanged",
    "part_sag": "repeat two views with the part hanging the other way",
    "part_slip": "repeat the first view now",
}


@dataclass(frozen=True)
class Proposal:
    """One measurement."""

    do: str  # plain words
    separates: tuple[str, ...]
    joints_deg: list[float] | None = None
    views: int | None = None  # how many such views are needed


def propose(evidence: PoseEvidence, selection: Selection) -> list[Proposal]:
    """What would tell the named group apart; without a group, the clearest suspect from what resembles it."""
    pair = _pair(evidence, selection)
    if pair is None:
        return []
    out = []
    pose = _best_pose(evidence, *pair) if _can_move(evidence.chain) and isinstance(evidence, PoseEvidence) else None
    names = (pair[0].name, pair[1].name)
    if pose is not None:
        joints, count = pose
        told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(joints))
        times = "a view" if count == 1 else f"{count} views"
        out.append(Proposal(f"take {times} near {told}", names, [round(float(x), 2) for x in joints], count))
    out += [Proposal(ARTEFACTS[name], names) for name in names if name in ARTEFACTS]
    return out


def _pair(evidence: PoseEvidence, selection: Selection) -> tuple[Score, Score] | None:
    """The two to separate: the first of the group, or the best suspect and its nearest alias."""
    if len(selection.named) > 1:
        return selection.named[0].score, selection.named[1].score
    seen = [r for r in selection.ranked if r.score.observable and np.isfinite(r.score.sigmas).all()][:6]
    if selection.verdict == "adequate" or len(seen) < 2:
        return None
    first: Ranked = selection.named[0] if selection.named else seen[0]
    others = [r.score for r in seen if r.name != first.name]
    row = alias_matrix(evidence, [first.score, *others])[0, 1:]
    return (first.score, others[int(row.argmax())]) if row.max() > SIMILAR else None


def _can_move(chain: Chain) -> bool:
    return chain.robot is not None and chain.views.joints.shape[1] > 0


def _best_pose(evidence: PoseEvidence, a: Score, b: Score) -> tuple[Array, int] | None:
    """Joint angles (n,) in degrees and the number of such views; None if poses cannot separate them."""
    if a.candidate.effect.place in POINTS or b.candidate.effect.place in POINTS:
        return None
    joints = _reachable(evidence)
    if not len(joints):
        return None
    chain = _imagined(evidence.chain, joints)
    carrier = placed(chain, ())[0] @ evidence.T_mount
    to_centre = frames.make(np.eye(3), -evidence.freed.overlaps.gram.centre)
    own = frames.adjoint(to_centre @ carrier)
    rows = {s.name: _rows(evidence, chain, s) for s in (a, b)}
    half = _view_scatter(evidence, chain)
    # What is known already, as normal equations of [hand-eye and model | b] against a's pattern.
    X = np.hstack([evidence.white_model, np.linalg.solve(evidence.half, b.form.columns) * b.form.sizes])
    y = np.linalg.solve(evidence.half, a.form.columns) @ a.values
    ridge = np.diag(np.concatenate([np.zeros(evidence.white_model.shape[1]), np.full(len(b.form.sizes), 0.01)]))
    M, c, square = X.T @ X + ridge, X.T @ y, float(y @ y)
    known = square - float(c @ np.linalg.lstsq(M, c, rcond=1e-12)[0])
    best, chosen = 0.0, None
    extra = evidence.white_model.shape[1] - 6
    for k in range(len(joints)):
        base = np.hstack([own[k], np.zeros((6, extra)), rows[b.name][k] * b.form.sizes])
        Xn, yn = (np.linalg.solve(half[k], v) for v in (base, rows[a.name][k] @ a.values))
        cn = c + Xn.T @ yn
        gain = square + float(yn @ yn) - float(cn @ np.linalg.lstsq(M + Xn.T @ Xn, cn, rcond=1e-12)[0]) - known
        if gain > best:
            best, chosen = gain, k
    if chosen is None or best < 1e-3 * _ENOUGH:
        return None
    count = int(np.ceil(max(_ENOUGH - known, best) / best))
    return np.degrees(joints[chosen]), min(count, 99)


def _rows(evidence: PoseEvidence, chain: Chain, scored: Score) -> Array:
    """(K, 6, p) twists of imagined views per unit of the form's free parameters."""
    term = with_values(scored.form, np.zeros(len(scored.values)))
    found = twists(chain, (), term, evidence.T_mount, evidence.freed.overlaps.gram.centre)
    return np.asarray(found[scored.form.keep].transpose(1, 2, 0))


def _reachable(evidence: PoseEvidence) -> Array:
    """(K, n) joint angles in which the scanner sees the part about as it has before."""
    chain = evidence.chain
    assert chain.robot is not None
    rng = np.random.default_rng(0)
    seen = chain.views.joints
    joints = seen[rng.integers(0, len(seen), _SAMPLES)] + rng.uniform(-_SPREAD, _SPREAD, (_SAMPLES, seen.shape[1]))
    limit = np.maximum(_LIMIT, np.abs(seen).max(axis=0))
    joints = joints[(np.abs(joints) < limit).all(axis=1)]
    T = kinematics.forward(chain.robot, joints)
    poses = (frames.inverse(T) if chain.eye_to_hand else T) @ evidence.T_mount
    centre = evidence.freed.overlaps.gram.centre[None]
    place = frames.transform(frames.inverse(poses), centre)[:, 0]
    before = frames.transform(frames.inverse(evidence.capture.poses(evidence.T_mount)), centre)[:, 0]
    margin = 0.15 * np.linalg.norm(before, axis=1).mean()
    inside = ((place > before.min(axis=0) - margin) & (place < before.max(axis=0) + margin)).all(axis=1)
    # A view direction far from all others would share no surface with them.
    towards, known = poses[:, :3, 2], evidence.capture.poses(evidence.T_mount)[:, :3, 2]
    inside &= (towards @ known.T).max(axis=1) > np.cos(np.radians(50.0))
    return np.asarray(joints[inside][:_TRIED])


def _imagined(chain: Chain, joints: Array) -> Chain:
    """The chain with views that nobody has taken yet, right after the last one, each approached from there."""
    assert chain.robot is not None
    views, count = chain.views, len(joints)
    last = np.repeat(views.joints[-1:], count, axis=0)
    torques = torques_of(chain.robot, np.vstack([joints, views.joints]))
    pause = float(np.median(np.diff(views.time))) if views.has("time") and views.count > 1 else 0.0
    imagined = replace(
        views, count=count, joints=joints, previous=last, approach=np.sign(joints - last),
        time=np.full(count, views.time[-1] + pause), velocity=None,
        torques=replace(torques, values=torques.values[:count]),
        covariates={name: np.full(count, values[-1]) for name, values in views.covariates.items()},
    )  # fmt: skip
    return replace(chain, views=imagined, T_base_flange=kinematics.forward(chain.robot, joints), scan_views=())


def _view_scatter(evidence: PoseEvidence, chain: Chain) -> Array:
    """(K, 6, 6) Cholesky factors of the pose scatter of one view about the centre."""
    to_centre = frames.make(np.eye(3), -evidence.freed.overlaps.gram.centre)
    T = np.broadcast_to(np.eye(4), chain.T_base_flange.shape) if chain.eye_to_hand else chain.T_base_flange
    carried = frames.adjoint(to_centre @ T)
    variances = np.repeat(np.maximum(evidence.null.variances[:2], 1e-300), 3)
    return np.asarray(np.linalg.cholesky(carried * variances @ carried.transpose(0, 2, 1)))
