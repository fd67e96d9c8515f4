"""What to measure next: the views after which one of the rival effects is named, or the artefact that tells them apart.

Without rivals, of an error that follows something by no law that anybody knows: the view where least is known of it.
"""

import re
from dataclasses import replace

import numpy as np

from stitch.diagnosis.deciding_view import deciding_views, possible_joints
from stitch.diagnosis.diagnosis import Diagnosis, Proposal
from stitch.diagnosis.naming import does_an_unmodelled_effect_explain_it
from stitch.diagnosis.ranking import Ranked, is_contender
from stitch.diagnosis.sensitivity import alias_matrix
from stitch.diagnosis.thresholds import ALIAS_CORRELATION, CLEAR_DEPENDENCE
from stitch.model.forward import moves_points
from stitch.numerics.frames import Array
from stitch.numerics.units import covariate_text
from stitch.observations.linear_model import LinearModel
from stitch.session.robot import forward
from stitch.system.threads import library_threads_off

# Poses that are tried for an error without a name; the likeliest candidates among which an alias of the best is sought.
_TRIED, _LIKELIEST = 250, 6
# Nats behind the best within which others count beside the rivals, and how many of them.
_NEAR, _OTHERS = 10.0, 3
# What the odds of a view are without.
NOT_IN_ODDS = "The odds do not hold what views left out may say against it."

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
    "mount_creep": "repeat the first view twice, a minute and an hour from now",
    "mount_step": "repeat the first view now",
    "base_compliance": "repeat three views with another payload, the arm stretched out ahead and to either side",
    "joint_thermal": "repeat the first views once that temperature has changed",
    "link_thermal": "repeat the first views once that temperature has changed",
    "joint_step": "repeat the first view now, and one with the joint turned far away",
    "joint_compliance": "repeat three views with another payload",
    "backlash": "repeat three views approached from the other side of every joint",
    "settling": "repeat three views after waiting five seconds before the scan",
    "robot_thermal_growth": "repeat the first views once the arm is warm",
    "mount_droop": "repeat a view with the flange turned by 180° about its axis",
    "fixture_droop": "repeat a view with the part hanging the other way",
    "mount_bend": "repeat a view with the flange turned by 180° about its axis, and one upside down",
    "fixture_bend": "repeat a view with the part hanging the other way, and one lying on either side",
    "fixture_drift": "clamp the part anew and repeat the first views at the end",
    "part_growth": "repeat a view of the part at another temperature, with the cell unchanged",
    "part_sag": "repeat two views with the part hanging the other way",
    "part_slip": "repeat the first view now",
}


def propose_measurements(diagnosis: Diagnosis) -> tuple[Proposal, ...]:
    """Return what to measure next, by the verdict: views that decide, and reference objects to measure (artefacts).

    cannot_tell: what separates the group that is named. missing_effect: what separates the name from its best alias.
    unknown_effect: the same for effects that come close; without such, the view where least is known of the error.
    Empty where there is nothing to separate.
    """
    with library_threads_off():
        to_separate = _effects_to_separate(diagnosis)
        names = tuple(ranked.name for ranked in to_separate)
        artefacts = tuple(Proposal(ARTEFACTS[name], names) for name in names if name in ARTEFACTS)
        rivals = [*to_separate, *_others_near(diagnosis, to_separate)] if to_separate else []
        # So many of the rivals, the first, have no winner yet; the others could only catch up.
        undecided = len(to_separate) if diagnosis.verdict == "cannot_tell" else 0
        views = deciding_views(diagnosis.linear, rivals, undecided=undecided)
        if views is not None:
            return (*_poses(diagnosis.linear, names, *views), *artefacts)
        unknown = least_known_view(diagnosis) if diagnosis.verdict == "unknown_effect" else None
        return artefacts if unknown is None else (unknown, *artefacts)


def _effects_to_separate(diagnosis: Diagnosis) -> list[Ranked]:
    """Return the effects that further views should tell apart; empty where there are none.

    They are the group of a cannot_tell, or the contenders where a joint without a law explains the views as well, or
    the effect that is named and its nearest alias.
    """
    if len(diagnosis.named) > 1:
        return list(diagnosis.named)
    unmodelled = does_an_unmodelled_effect_explain_it.__name__
    if diagnosis.verdict == "unknown_effect" and any(a.name == unmodelled and a.changed for a in diagnosis.answers):
        # As they rank beside all pose errors that remain. Laws without an effect weigh as much; no odds include them.
        return [c.ranked for c in diagnosis.candidates if is_contender(c.ranked)][:_OTHERS]
    fitted = [c.ranked for c in diagnosis.candidates if c.ranked.score.observable and c.ranked.score.fitted]
    likeliest = fitted[:_LIKELIEST]
    if diagnosis.verdict in ("adequate", "unknown_effect") or len(likeliest) < 2:
        return []
    first = diagnosis.named[0] if diagnosis.named else likeliest[0]
    others = [ranked for ranked in likeliest if ranked.name != first.name]
    row = alias_matrix(diagnosis.linear, [first.score, *(ranked.score for ranked in others)])[0, 1:]
    return [first, others[int(row.argmax())]] if row.max() > ALIAS_CORRELATION else []


def _others_near(diagnosis: Diagnosis, to_separate: list[Ranked]) -> list[Ranked]:
    """Return up to `_OTHERS` further effects of poses within `_NEAR` nats: a further view may put one of them ahead.

    Args:
        to_separate: effects that are rivals already; not empty.
    """
    rows = {c.name: c.ranked for c in diagnosis.candidates}
    # The effects to separate may be scored in another model than the table: log posteriors are shifted to theirs.
    higher = to_separate[0].log_posterior - rows[to_separate[0].name].log_posterior
    least = max(ranked.log_posterior for ranked in to_separate) - _NEAR - higher
    others = [
        replace(ranked, log_posterior=ranked.log_posterior + higher)
        for name, ranked in rows.items()
        if ranked.score.fitted and ranked.log_posterior > least and name not in {r.name for r in to_separate}
    ]
    return [ranked for ranked in others if not moves_points([ranked.score.form.term])][:_OTHERS]


def _poses(
    linear: LinearModel, names: tuple[str, ...], joints: Array, waits: Array, probabilities: Array
) -> tuple[Proposal, ...]:
    """Return a proposal for each view that decides, in the order in which they are to be taken.

    Args:
        names: effects that the views separate.
        joints, waits, probabilities: (K, n), (K,), (K,), of `deciding_views`.
    """
    proposals = []
    for k, (wait, probability) in enumerate(zip(waits.tolist(), probabilities.tolist(), strict=True)):
        what = "take a view near" if k == 0 else "then another near"
        later = f", {wait / 60:.0f} min after the last view" if wait else ""
        pose = _pose(linear, f"{what} {angles_text(joints[k])}{later}", names, joints[k])
        proposals.append(replace(pose, wait_s=wait, probability=probability))
    return tuple(proposals)


def least_known_view(diagnosis: Diagnosis) -> Proposal | None:
    """Return the view that would show most of an error without a name: where no view lies near along its covariate.

    Among reachable poses it is the one farthest from all views in the angle of the joint that the error follows. Along
    time or another covariate it is the first view again. None where the error follows nothing of that kind.
    """
    linear = diagnosis.linear
    views = linear.measurement.views
    if diagnosis.curves:
        curve = diagnosis.curves[0]
        follows, values = curve.covariate, curve.view_values
    elif diagnosis.depends_on and diagnosis.depends_on[0].p_value < CLEAR_DEPENDENCE:
        follows, values = diagnosis.depends_on[0].covariate, diagnosis.depends_on[0].at
    else:
        return None
    angle = re.fullmatch(r"j(\d+)_deg", follows)
    words = covariate_text(follows).partition(" (")[0]
    if angle is None or linear.measurement.robot is None or not views.joints.shape[1]:
        if follows in ("time_s", "view order"):
            return Proposal("repeat the first view now: how far the error has gone since nobody has seen", ())
        if follows in views.covariates:
            known = f"{values.min():.3g} to {values.max():.3g}"
            return Proposal(f"repeat the first view at another {words}: it was {known} so far", ())
        return None
    joint = int(angle[1]) - 1
    possible = possible_joints(linear)[:_TRIED]
    if not len(possible):
        return None
    at = np.degrees(possible[:, joint])
    far = np.abs(at[:, None] - values[None]).min(axis=1)
    k = int(far.argmax())
    where = f"no view has joint {joint + 1} within {far[k]:.0f}° of there, and how it errs is known least"
    return _pose(linear, f"take a view near {angles_text(possible[k])}: {where}", (), possible[k])


def deciding_words(diagnosis: Diagnosis) -> str:
    """Return what the proposed view decides: "between gear_eccentricity and gear_harmonic"."""
    rivals = next((proposal.separates for proposal in diagnosis.next if proposal.probability is not None), ())
    if diagnosis.verdict == "unknown_effect":
        return f"whether it is {', '.join(rivals)} or a joint without a law"
    return f"between {' and '.join(rivals)}"


def angles_text(joints: Array) -> str:
    """Return joint angles (n,) rad as people read them."""
    return ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(np.degrees(joints)))


def _pose(linear: LinearModel, do: str, names: tuple[str, ...], joints: Array) -> Proposal:
    """Return the proposal of one view at joint angles (n,), rad; T_base_flange is that of the rounded angles."""
    assert linear.measurement.robot is not None
    degrees = [round(float(x), 2) for x in np.degrees(joints)]
    T = forward(linear.measurement.robot, np.radians(degrees))
    return Proposal(do, names, degrees, 1, T_base_flange=T.round(9).tolist())
