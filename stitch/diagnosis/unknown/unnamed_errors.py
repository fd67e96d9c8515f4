"""What the poses do wrong again without a name: which processes of the prior the views want, and how large they are."""

from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown.clear_joints import significant_laws
from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.diagnosis.unknown.law_covariates import JOINT_ANGLES
from stitch.diagnosis.unknown.process_size import FittedProcess
from stitch.diagnosis.unknown.time_curve import TimeCurve, time_curve
from stitch.diagnosis.unknown.time_laws import significant_time_law
from stitch.diagnosis.unknown.unnamed_courses import significant_course
from stitch.observations.flange_errors import DRIFT_MEMORY
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import STOP_COMPONENTS
from stitch.statistics.variance_components import fit_variances
from stitch.statistics.variance_prior import NOISE

# Processes that stand for the same in words; what is in none of them is an arm's own, of every joint and link.
_FOLLOW_JOINTS, _WANDER_IN_TIME = "follow the joints", "wander in time"


@dataclass(frozen=True)
class RepeatingError:
    """One kind of errors that repeat, beside all others."""

    words: str  # "they …"
    log_bayes_factor: float  # over the same errors without it
    joints: bool  # follows the pose rather than time
    of_one: bool = False  # one joint, or one course of time, stands out
    laws: tuple[JointLaw, ...] = ()  # of single joints, where they are clear
    curve: TimeCurve | None = None  # of the flange in time, where that is clear
    process: FittedProcess | None = None  # and the rest beside it, where the null counts it as scatter


def reportable(unnamed: tuple[RepeatingError, ...], implausible: bool) -> tuple[RepeatingError, ...]:
    """Those of them that are said: where poses scatter as no arm does, only beside a law that stands out."""
    return unnamed if not implausible or any(u.of_one for u in unnamed) else ()


def find_repeating_errors(linear: LinearModel) -> tuple[RepeatingError, ...]:
    """Kinds of errors without which the views cannot do, clearest first; () where white scatter explains them.

    Without a prior of pose errors the likeliest alone (`unnamed_courses.py`).

    Each is left out of the prior in turn, all other sizes fitted anew. A size that is not wanted goes to where its
    prior piles up and costs nothing; one that is wanted pays for its prior's tail alone and not for its width, about
    three nats (`variance_prior.py`), which the odds of 20 to 1 stand for.
    """
    if linear.pose_errors is None:
        return _course_errors(linear)
    law = _likelier_errors(_joint_law_errors(linear), _time_law_errors(linear))
    if _log_evidence_gain(linear, linear.independent_only.null.deviance) < ODDS:
        return () if law is None else (law,)
    names = linear.pose_errors.names
    kinds = {
        _FOLLOW_JOINTS: tuple(n for n, of_arm in zip(names, linear.pose_errors.arm_components, strict=True) if of_arm),
        _WANDER_IN_TIME: tuple(DRIFT_MEMORY),
        "are shared by the scans of a stop": STOP_COMPONENTS,
    }
    found = [
        RepeatingError(words, _log_evidence_gain(linear, _deviance_without(linear, kind)), words == _FOLLOW_JOINTS)
        for words, kind in kinds.items()
        if any(name in kind for name in names)
    ]
    wanted = sorted((u for u in found if u.log_bayes_factor > ODDS), key=lambda u: -u.log_bayes_factor)
    if law is not None:
        # What one joint does is part of what follows the joints, and as clear.
        alike = [u.log_bayes_factor for u in found if u.joints == law.joints]
        law = replace(law, log_bayes_factor=max([law.log_bayes_factor, *alike]))
        return (law, *(u for u in wanted if u.joints != law.joints))
    # Where each can stand in for the other, the likelier alone is said to be there.
    return tuple(wanted) or (max(found, key=lambda u: u.log_bayes_factor),)


def _joint_law_errors(linear: LinearModel) -> RepeatingError | None:
    """That of one joint, beside all that the prior holds or in place of what an arm does."""
    laws = significant_laws(linear)
    if not laws:
        return None
    which = " or ".join(f"joint {joint}" for joint in sorted(law.joint for law in laws))
    followed = dict.fromkeys(number for law in laws for number in law.may_follow)
    # Of laws that nobody knows none is certain to be of the kind that explains most.
    words = f"come from {which} above all, likeliest by {' or '.join(followed)}"
    if JOINT_ANGLES in followed:
        words = f"{_FOLLOW_JOINTS}, {which} above all"
    return RepeatingError(words, laws[0].log_bayes_factor, joints=True, of_one=True, laws=laws)


def _time_law_errors(linear: LinearModel) -> RepeatingError | None:
    """That of the flange in time."""
    law = significant_time_law(linear)
    if law is None:
        return None
    factor, curve = law.log_bayes_factor, time_curve(law)
    return RepeatingError(law.course.words, factor, joints=False, of_one=True, curve=curve, process=law.fitted)


def _likelier_errors(joint: RepeatingError | None, time: RepeatingError | None) -> RepeatingError | None:
    """Of a joint's law and one in time, which can stand in for each other; both where 20 to 1 tells neither."""
    found = sorted((u for u in (joint, time) if u is not None), key=lambda u: -u.log_bayes_factor)
    if len(found) == 2 and found[0].log_bayes_factor - found[1].log_bayes_factor < ODDS:
        return replace(found[0], words=f"{found[0].words}, or {found[1].words}")
    return found[0] if found else None


def _course_errors(linear: LinearModel) -> tuple[RepeatingError, ...]:
    """Where poses count as scattering independently."""
    course = significant_course(linear)
    if course is None:
        return ()
    words = _WANDER_IN_TIME if course.joint is None else f"{_FOLLOW_JOINTS}, joint {course.joint} above all"
    return (RepeatingError(words, course.log_bayes_factor, course.joint is not None, process=course),)


def _log_evidence_gain(linear: LinearModel, deviance: float) -> float:
    return 0.5 * (deviance - linear.null.deviance)


def _deviance_without(linear: LinearModel, kind: tuple[str, ...]) -> float:
    """Of the null without some components."""
    assert linear.pose_errors is not None and linear.mixed.further is not None
    keep = np.array([name not in kind for name in linear.pose_errors.names], bool)
    every = np.append(np.ones(NOISE + 1, bool), keep)
    further = linear.mixed.further.select(keep)
    mixed = replace(linear.mixed, components=linear.mixed.components[every], further=further)
    plain = np.append(linear.scatter_only.null.variances, 1e-2 * further.scales**2)
    return min(fit_variances(mixed, start=start).deviance for start in (linear.null.variances[every], plain))
