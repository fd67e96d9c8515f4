"""Which joint errs by a law without a name: told beside all else that an arm may do, or in place of it.

All joints and links following the pose at once can do what one joint does, and beside them its law gains nothing. But
where one joint alone explains the views at least as well as all of them together, the errors live there. Compared are
maxima of likelihood and prior: the sizes of all together are charged some three nats for being there at all. An arm of
which every joint and link is off is hardly ever explained by one of its joints alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown.joint_laws import JointLaw, joint_laws, laws_by
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import ALL_ANGLES, OWN_ANGLE, THE_WAY


def clear_laws(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Laws of single joints of which one is there, likeliest first, () if none is; log Bayes factors over all that the
    prior holds.

    With the likeliest come those that 20 to 1 does not tell from it, of every joint the likelier kind.
    """
    return _beside(linear) or _alone(linear)


def _beside(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Of which one is 20 to 1 likelier than none beside all that the prior holds; each of its likeliest kind."""
    tried = joint_laws(linear)
    laws = _charged(tried, among=len(tried))
    if not laws or laws[0].log_bayes_factor <= ODDS:
        return ()
    ways = {law.joint: law for law in _charged(laws_by(linear, (THE_WAY,)), among=len(tried))}
    return tuple(max(law, ways[law.joint], key=lambda one: one.log_bayes_factor) for law in _likely(laws))


def _alone(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Of which one, where neither joints nor links err but by it, is 20 to 1 likelier than none and explains no less
    than all of them together."""
    if linear.pose_errors is None or not linear.pose_errors.of_one_joint:
        return ()
    right = linear.arm_right
    tried = laws_by(right, (ALL_ANGLES, OWN_ANGLE, THE_WAY))
    whole = 0.5 * (right.null.deviance - linear.null.deviance)
    best = max((law.log_bayes_factor for law in tried), default=-np.inf)
    laws = _charged(tried, among=len(tried))
    if best < whole or not laws or laws[0].log_bayes_factor < ODDS:
        return ()
    return tuple(replace(law, log_bayes_factor=law.log_bayes_factor - whole) for law in _likely(laws))


def _charged(laws: Sequence[JointLaw], among: int) -> list[JointLaw]:
    """Likeliest first, each charged for all among which it was chosen."""
    laws = [replace(law, log_bayes_factor=law.log_bayes_factor - float(np.log(among))) for law in laws]
    return sorted(laws, key=lambda law: -law.log_bayes_factor)


def _likely(laws: Sequence[JointLaw]) -> tuple[JointLaw, ...]:
    """Those that 20 to 1 does not tell from the first, of every joint the likelier kind."""
    likely = {law.joint: law for law in reversed(laws) if law.log_bayes_factor > laws[0].log_bayes_factor - ODDS}
    return tuple(law for law in laws if law is likely.get(law.joint))
