"""What to measure next: the pose that separates two candidate effects best, or the artefact that does.

Two effects a and b are told apart by what of a's pattern b cannot imitate: λ = |y_a − best of b|² in units
of the scatter. A further view adds six rows to both patterns; among poses that the arm can take and in which
the scanner would see the part as it has before, the one that adds most to the two that stay most alike is proposed.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch.diagnosis.design.candidate_views import candidate_views
from stitch.diagnosis.score import Score
from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.selection.verdict import Selection
from stitch.diagnosis.sensitivity.aliases import alias_matrix
from stitch.diagnosis.thresholds import ALIAS_CORRELATION, SEPARATION_LAMBDA
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.observations.linear_model import LinearModel

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


def propose_measurements(linear: LinearModel, selection: Selection) -> list[Proposal]:
    """What would tell the named group apart; without a group, the clearest candidate from what resembles it."""
    group = _effects_to_separate(linear, selection)
    names = tuple(score.name for score in group)
    artefacts = [Proposal(ARTEFACTS[name], names) for name in names if name in ARTEFACTS]
    found = _best_pose(linear, group) if _can_move(linear.measurement) else None
    if found is None:
        return artefacts
    joints, count, separated = found
    told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(joints))
    times = "a view" if count == 1 else f"{count} views"
    pose = Proposal(f"take {times} near {told}", separated, [round(float(x), 2) for x in joints], count)
    return [pose, *artefacts]


def _effects_to_separate(linear: LinearModel, selection: Selection) -> list[Score]:
    """What to separate: the group that was named, or the best candidate and its nearest alias; else nothing."""
    if len(selection.named) > 1:
        return [r.score for r in selection.named]
    seen = [r for r in selection.ranked if r.score.observable and r.score.fitted][:6]
    if selection.verdict == "adequate" or len(seen) < 2:
        return []
    first: Ranked = selection.named[0] if selection.named else seen[0]
    others = [r.score for r in seen if r.name != first.name]
    row = alias_matrix(linear, [first.score, *others])[0, 1:]
    return [first.score, others[int(row.argmax())]] if row.max() > ALIAS_CORRELATION else []


def _can_move(measurement: Measurement) -> bool:
    return measurement.robot is not None and measurement.views.joints.shape[1] > 0


def _best_pose(linear: LinearModel, group: list[Score]) -> tuple[Array, int, tuple[str, ...]] | None:
    """Joint angles (n,) in degrees where the two that stay most alike gain most, the number of such views, and what
    they separate; None if poses cannot separate anything.
    """
    pairs = [(gains, (a.name, b.name)) for a, b in combinations(group, 2) if (gains := _gains(linear, a, b))]
    pairs = [(gains, names) for gains, names in pairs if gains.of_views.max() > 1e-3 * SEPARATION_LAMBDA]
    if not pairs:
        return None
    k = int(np.min([gains.of_views for gains, _ in pairs], axis=0).argmax())
    counts = [np.ceil(max(SEPARATION_LAMBDA - g.known, 0.0) / max(g.of_views[k], 1e-12)) for g, _ in pairs]
    separated = dict.fromkeys(score.name for score in group if any(score.name in names for _, names in pairs))
    return np.degrees(pairs[0][0].joints[k]), int(np.clip(max(counts), 1, 99)), tuple(separated)


@dataclass(frozen=True)
class _Gains:
    """How much apart two candidate effects are, and how much each of K views would add to it."""

    known: float
    joints: Array  # (K, n) rad, the same for every two candidate effects
    of_views: Array  # (K,)


def _gains(linear: LinearModel, a: Score, b: Score) -> _Gains | None:
    """None if poses cannot show the effects."""
    candidate = candidate_views(linear, a, b)
    if candidate is None or not len(candidate.joints):
        return None
    # What is known already, as normal equations of [hand-eye and model | b] against a's pattern.
    X = np.hstack([linear.white_design, linear.whiten(b.form.columns) * b.form.sizes])
    y = linear.whiten(a.form.columns) @ a.values
    ridge = np.diag(np.concatenate([np.zeros(linear.white_design.shape[1]), np.full(len(b.form.sizes), 0.01)]))
    M, c, square = X.T @ X + ridge, X.T @ y, float(y @ y)
    known = square - float(c @ np.linalg.lstsq(M, c, rcond=1e-12)[0])
    gains = []
    for k in range(len(candidate.joints)):
        base = np.hstack([candidate.design[k], candidate.b[k] * b.form.sizes])
        Xn, yn = (np.linalg.solve(candidate.half[k], v) for v in (base, candidate.a[k] @ a.values))
        cn = c + Xn.T @ yn
        gains.append(square + float(yn @ yn) - float(cn @ np.linalg.lstsq(M + Xn.T @ Xn, cn, rcond=1e-12)[0]) - known)
    return _Gains(known, candidate.joints, np.array(gains))
