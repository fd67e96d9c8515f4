"""Which joint errs by a law without a name: told beside all else that an arm may do, or in place of it.

All joints and links following the pose at once can do what one joint does, and beside them its law gains nothing. But
where one joint alone explains the views at least as well as all of them together, the errors live there. Compared are
maxima of likelihood and prior: the sizes of all together are charged some three nats for being there at all. An arm of
which every joint and link is off is hardly ever explained by one of its joints alone.

Of all kinds of laws of all joints one may be there, each as likely before: what counts is their mean Bayes factor, and
of a joint the mean of its kinds.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown.joint_laws import JointLaw, joint_laws
from stitch.diagnosis.unknown.law_covariates import covariates_in_words
from stitch.observations.linear_model import LinearModel
from stitch.statistics.mean_factor import log_mean_exp


def significant_laws(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Laws of single joints of which one is there, likeliest first, () if none is.

    With the likeliest joint come those that 20 to 1 does not tell from it, each by its likeliest kind of law, with the
    log Bayes factor of its kinds together over all that the prior holds.
    """
    return _likeliest_law_per_joint(joint_laws(linear)) or _laws_without_arm_errors(linear)


def _laws_without_arm_errors(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Of which one, where neither joints nor links err but by it, is 20 to 1 likelier than none and explains no less
    than all of them together."""
    if linear.pose_errors is None or not linear.pose_errors.joint_processes:
        return ()
    right = linear.without_arm
    tried = joint_laws(right)
    whole = 0.5 * (right.null.deviance - linear.null.deviance)
    if tried[0].log_bayes_factor < whole:
        return ()
    return tuple(replace(law, log_bayes_factor=law.log_bayes_factor - whole) for law in _likeliest_law_per_joint(tried))


def _likeliest_law_per_joint(laws: Sequence[JointLaw]) -> tuple[JointLaw, ...]:
    """Of every joint that 20 to 1 does not tell from the likeliest its likeliest law, () where none is so much
    likelier than nothing.

    Args:
        laws: of all kinds and joints, likeliest first.
    """
    if not laws or log_mean_exp([law.log_bayes_factor for law in laws]) <= ODDS:
        return ()
    of_joint = {k: [law for law in laws if law.joint == k] for k in dict.fromkeys(law.joint for law in laws)}
    factors = {k: [law.log_bayes_factor for law in own] for k, own in of_joint.items()}
    together = {k: float(logsumexp(own) - np.log(len(laws))) for k, own in factors.items()}
    near = [k for k in together if together[k] > max(together.values()) - ODDS]
    return tuple(_law_with_alternatives(of_joint[k], together[k]) for k in sorted(near, key=lambda k: -together[k]))


def _law_with_alternatives(laws: Sequence[JointLaw], together: float) -> JointLaw:
    """The likeliest law of a joint, with what it may follow as well.

    Args:
        laws: of all kinds, likeliest first.
        together: log Bayes factor of them.
    """
    near = [law for law in laws if law.log_bayes_factor > laws[0].log_bayes_factor - ODDS]
    return replace(laws[0], log_bayes_factor=together, may_follow=tuple(dict.fromkeys(map(covariates_in_words, near))))
