"""Laws without a name as rivals of those that have one: what a single joint does by no law that anybody wrote down.

A name is worth no more than what it is compared with. All joints and links following the pose at once (`smooth` in the
prior of pose errors) is a poor rival: it may do so much that it is believed to do little of anything. One joint that is
off by a smooth function of the joint angles is what a coupling, a hose or a gear with play really does, and where it
explains the views about as well as an effect of the library, these views cannot tell which it is. Likewise one joint
that is off by a function of its own angle that changes within a few degrees, as by a worn tooth or a wave of a gear, or
by any function of the way it came, as by friction, which is neither play nor settling; or that changes as time passes,
as where its motor warms, which is no drift of mount or part; or by a law of its load that is not that of a spring.

Three more laws such functions hold too, but with a number of their own in nearly every view: a joint that follows its
own angle and one other's, as two do that drag each other, one that errs in waves along its angle, as teeth of gears and
belts do, and one that errs in time alone, whatever the pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.diagnosis.thresholds import PRIOR_UNKNOWN
from stitch.diagnosis.unknown.process_size import size_process
from stitch.diagnosis.unknown.smooth_processes import process_with_covariance
from stitch.frames import Array
from stitch.observations.error_model import with_pose_errors
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import SMOOTH_SCALE
from stitch.statistics import amplitude_scales
from stitch.statistics.kernels import SmoothErrors
from stitch.statistics.mean_factor import log_mean_exp
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.variance_components import VarianceFit, at_variances, fit_variances

# Of all laws those whose size is sought with all variances.
_FITTED = 12
# Of how many usual variances such a law may be where the search for its size begins.
TIMES = (0.01, 1.0, 30.0)
# What not knowing its size costs a law, nats: as much as an effect (`form_trial.py`), so that neither has an advantage.
ANY_SIZE = -float(np.log(amplitude_scales.ANY_SIZE[1.0]))


@dataclass(frozen=True)
class JointLaw:
    """One joint that follows a law without a name."""

    joint: int  # counted from 1
    follows: str  # ALL_ANGLES, TWO_ANGLES, OWN_ANGLE, WAVES, …
    process: int  # of that kind; the likeliest, where a joint has several
    log_bayes_factor: float  # over everything else that may be there, at the likeliest size; their mean, of several
    base: LinearModel  # without the law
    fit: VarianceFit | None = None  # of the views with it; None where it was only sized at the null's variances
    may_follow: tuple[str, ...] = ()  # in words, the likeliest first: what 20 to 1 does not tell apart

    @property
    def errors(self) -> SmoothErrors:
        """Of its kind, of all joints."""
        assert self.base.pose_errors is not None
        return self.base.pose_errors.joint_processes[self.follows]

    @cached_property
    def model(self) -> LinearModel:
        """With the law as the last of its pose errors, all sizes fitted."""
        errors = self.base.pose_errors
        assert errors is not None
        own = self.base.reduce(self.base.reduce(self.errors.twist_covariance(self.process)).T)
        every = errors.with_component(f"joint {self.joint} by no known law", own, SMOOTH_SCALE)
        mixed = with_pose_errors(self.base.mixed, every)
        null = self.fit or _fit_law(self.base, mixed)
        return replace(self.base, mixed=mixed, pose_errors=every, null=null, full_model=None)

    def fitted(self) -> "JointLaw":
        """With all variances sought anew: what a law explains is no scatter."""
        null = self.model.null
        return replace(self, log_bayes_factor=0.5 * (self.base.null.deviance - null.deviance), fit=null)


def joint_laws(base: LinearModel) -> tuple[JointLaw, ...]:
    """What a law of each kind of each joint explains beside a model, likeliest first; () without joints or prior of
    errors.

    Its size is fitted with all others; `some_law` charges it for that.
    """
    return tuple(sorted(laws_of_kinds(base, _kinds(base)), key=lambda law: -law.log_bayes_factor))


def joint_law_log_posterior(base: LinearModel) -> float:
    """That some joint follows such a law, of any kind, as those of effects in the same model
    (`Ranked`); −∞ where the views tell of none."""
    laws = joint_laws(base)
    return float(log_posterior_of_any(np.array([law.log_bayes_factor for law in laws]))) if laws else -np.inf


def log_posterior_of_any(log_bayes_factors: Array) -> Array:
    """(…) log posterior that one of the laws is there, from the log Bayes factors (L, …) of each: all kinds of laws of
    all joints share the prior alike, and none of their sizes is known."""
    return np.asarray(log_mean_exp(log_bayes_factors) + np.log(PRIOR_UNKNOWN) - ANY_SIZE)


def law_covariances(base: LinearModel) -> list[list[Array]]:
    """(n, n) in the channel of the laws of usual size, those of one kind of one joint together."""
    of_one_joint = {} if base.pose_errors is None else base.pose_errors.joint_processes
    return [
        [SMOOTH_SCALE**2 * base.reduce(base.reduce(smooth.twist_covariance(p)).T) for p in smooth.of_joint(joint)]
        for smooth in of_one_joint.values()
        for joint in dict.fromkeys(smooth.joints)
    ]


def _kinds(base: LinearModel) -> Sequence[str]:
    """All that the views tell of."""
    return () if base.pose_errors is None else tuple(base.pose_errors.joint_processes)


def laws_of_kinds(base: LinearModel, kinds: Sequence[str]) -> list[JointLaw]:
    """Of every joint, by each of these kinds that the views tell of.

    All variances are sought anew for the likeliest few; for the others their likelihood at the null's is a bound.
    """
    of_one_joint = {} if base.pose_errors is None else base.pose_errors.joint_processes
    tried = [
        _law_at_null(base, follows, process)
        for follows in kinds
        if follows in of_one_joint
        for process in range(len(of_one_joint[follows].joints))
    ]
    tried.sort(key=lambda law: -law.log_bayes_factor)
    tried = [law.fitted() if k < _FITTED else law for k, law in enumerate(tried)]
    every: dict[tuple[int, str], list[JointLaw]] = {}
    for law in tried:
        every.setdefault((law.joint, law.follows), []).append(law)
    return [_average_laws(laws) for laws in every.values()]


def _average_laws(laws: Sequence[JointLaw]) -> JointLaw:
    """The likeliest of a joint's laws of a kind; which of them it is, nobody knows."""
    likeliest = max(laws, key=lambda law: law.log_bayes_factor)
    return replace(likeliest, log_bayes_factor=float(log_mean_exp([law.log_bayes_factor for law in laws])))


def _law_at_null(base: LinearModel, follows: str, process: int) -> JointLaw:
    assert base.pose_errors is not None
    smooth = base.pose_errors.joint_processes[follows]
    joint, motions = smooth.joints[process] + 1, smooth.columns[:, process].reshape(-1, 6, 1)
    sized = size_process(base, process_with_covariance(joint, motions, smooth.kernel_of(process)))
    return JointLaw(joint, follows, process, sized.gain, base)


def _fit_law(base: LinearModel, mixed: MixedModel) -> VarianceFit:
    """At the maximum, sought from the likeliest of several starts."""
    nulls = [at.null.variances for at in (base, *base.alternative_starts)]
    starts: list[Array] = [np.append(null, times * SMOOTH_SCALE**2) for null in nulls for times in TIMES]
    return fit_variances(mixed, start=min(starts, key=lambda start: at_variances(mixed, start).deviance))
