"""Laws without a name as rivals of those that have one: what a single joint does by no law that anybody wrote down.

A name is worth no more than what it is compared with. All joints and links following the pose at once (`smooth` in the
prior of pose errors) is a poor rival: it may do so much that it is believed to do little of anything. One joint that is
off by a smooth function of the joint angles is what a coupling, a hose or a gear with play really does, and where it
explains the views about as well as an effect of the library, these views cannot tell which it is. Likewise one joint
that is off by a function of its own angle that changes within a few degrees, as by a worn tooth or a wave of a gear, or
by any function of the way it came, as by friction, which is neither play nor settling; or that changes as time passes,
as where its motor warms, which is no drift of mount or part; or by a law of its load that is not that of a spring.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.form_trial import SCALES
from stitch.diagnosis.thresholds import PRIOR_UNKNOWN
from stitch.frames import Array
from stitch.observations.error_model import with_errors
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import ALL_ANGLES, ITS_LOAD, OWN_ANGLE, SMOOTH, THE_WAY, WITH_TIME, PoseErrors
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.variance_components import VarianceFit, at_variances, fit_variances

# Of how many usual variances such a law may be where the search for its size begins.
TIMES = (0.01, 1.0, 30.0)
# What not knowing its size costs a law, nats: as much as an effect (`form_trial.py`), so that neither has an advantage.
ANY_SIZE = float(np.log(len(SCALES)))


@dataclass(frozen=True)
class JointLaw:
    """One joint that follows a law without a name."""

    joint: int  # counted from 1
    follows: str  # ALL_ANGLES, OWN_ANGLE, THE_WAY, WITH_TIME or ITS_LOAD
    log_bayes_factor: float  # over everything else that may be there, at the likeliest size
    model: LinearModel  # with the law as the last of its pose errors, all sizes fitted


def joint_laws(base: LinearModel) -> tuple[JointLaw, ...]:
    """What such a law of each joint explains beside a model, likeliest first; () without joints or prior of errors.

    Its size is fitted with all others; `some_law` charges it for that.
    """
    laws = laws_by(base, (ALL_ANGLES, OWN_ANGLE))
    return tuple(sorted(laws, key=lambda law: -law.log_bayes_factor))


def log_posterior(base: LinearModel) -> float:
    """That some joint follows such a law, of any kind, as those of effects in the same model
    (`Ranked`); −∞ where the views tell of none."""
    laws = laws_by(base, (ALL_ANGLES, OWN_ANGLE, THE_WAY, WITH_TIME, ITS_LOAD))
    return float(some_law(np.array([law.log_bayes_factor for law in laws]))) if laws else -np.inf


def some_law(log_bayes_factors: Array) -> Array:
    """(…) log posterior that one of the laws is there, from the log Bayes factors (L, …) of each: all kinds of laws of
    all joints share the prior alike, and none of their sizes is known."""
    every = logsumexp(log_bayes_factors, axis=0) - np.log(len(log_bayes_factors))
    return np.asarray(every + np.log(PRIOR_UNKNOWN) - ANY_SIZE)


def law_covariances(base: LinearModel) -> list[Array]:
    """(n, n) in the channel of the laws of all joints, of every kind; usual size."""
    errors = base.pose_errors
    if errors is None or not errors.of_one_joint:
        return []
    every = [smooth.of(k) for smooth in errors.of_one_joint.values() for k in smooth.joints]
    return [SMOOTH**2 * base.reduce(base.reduce(law).T) for law in every]


def laws_by(base: LinearModel, kinds: Sequence[str]) -> list[JointLaw]:
    """Of every joint, by each of these kinds that the views tell of."""
    errors = base.pose_errors
    if errors is None or not errors.of_one_joint:
        return []
    found = list[JointLaw]()
    for follows in (kind for kind in kinds if kind in errors.of_one_joint):
        smooth = errors.of_one_joint[follows]
        found += [_law(base, errors, joint + 1, follows, smooth.of(joint)) for joint in smooth.joints]
    return found


def _law(base: LinearModel, errors: PoseErrors, joint: int, follows: str, covariance: Array) -> JointLaw:
    """Of a joint, counted from 1, by the covariance (6V, 6V) of the twists."""
    every = errors.beside(f"joint {joint}", base.reduce(base.reduce(covariance).T), SMOOTH)
    mixed = with_errors(base.mixed, every)
    fit = _fit(base, mixed)
    model = replace(base, mixed=mixed, pose_errors=every, null=fit, whole=None)
    return JointLaw(joint, follows, 0.5 * (base.null.deviance - fit.deviance), model)


def _fit(base: LinearModel, mixed: MixedModel) -> VarianceFit:
    """At the maximum, sought from the likeliest of several starts."""
    nulls = [at.null.variances for at in (base, *base.elsewhere)]
    starts: list[Array] = [np.append(null, times * SMOOTH**2) for null in nulls for times in TIMES]
    return fit_variances(mixed, start=min(starts, key=lambda start: at_variances(mixed, start).deviance))
