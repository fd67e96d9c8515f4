"""What further views are for: a hand-eye known twice as well, two effects told apart; how far some views get."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.thresholds import SEPARATION_LAMBDA
from stitch.frames import Array
from stitch.planning.expected_hand_eye import displacement
from stitch.planning.view_bed import EffectColumns
from stitch.planning.view_search import TwistChannel, separations

# Keeps what too few views leave open finite: a radian, and many times any part.
_OPEN = 1e-8
# Whatever the unit, no logarithm of a length comes near.
_NEVER = -50.0


@dataclass(frozen=True)
class HalvedHandEye:
    """The hand-eye's U at a point, down to a share of what the present views give it."""

    channel: TwistChannel
    middle: Array  # (3,) scanner frame
    now: float  # U of the present views, length_unit; NaN where they give none
    share: float = 0.5

    def U(self, normal: Array) -> Array:
        """(...) of normal matrices (..., q, q)."""
        scale = 1 / np.sqrt(np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), 1e-300))
        scaled = normal * scale[..., :, None] * scale[..., None, :]
        inverse = np.linalg.inv(scaled + _OPEN * np.eye(normal.shape[-1]))
        covariance = (inverse * scale[..., :, None] * scale[..., None, :])[..., :6, :6]
        flat = covariance.reshape(-1, 6, 6)
        return np.array([displacement(C, self.middle) for C in flat]).reshape(covariance.shape[:-2])

    def progress(self, normal: Array) -> Array:
        """(...) 1 where U has come down to that share; without a present U what its logarithm falls by, never 1."""
        if not np.isfinite(self.now):
            return np.asarray(_NEVER - np.log(self.U(normal)))
        return np.asarray(np.clip(np.log(self.U(normal) / self.now) / np.log(self.share), 0.0, 1.0))


@dataclass(frozen=True)
class SplitPair:
    """Two effects of usual size, each told from the other."""

    channel: TwistChannel
    names: tuple[str, str]
    effects: tuple[EffectColumns, EffectColumns]  # their columns are the channel's last

    def progress(self, normal: Array) -> Array:
        """(...) share of the forms that are told apart, of the effect that is told worse; 1 if all are."""
        counts = [e.columns.shape[1] for e in self.effects]
        at = normal.shape[-1] - sum(counts)
        a, b = slice(at, at + counts[0]), slice(at + counts[0], at + sum(counts))
        both = []
        for own, rival, effect in ((a, b, self.effects[0]), (b, a, self.effects[1])):
            apart = separations(normal, own, rival) @ effect.forms.T
            both.append(np.minimum(apart / SEPARATION_LAMBDA, 1.0) @ effect.weights)
        return np.asarray(np.minimum(*both))


Goal = HalvedHandEye | SplitPair


def mean_progress(goals: Sequence[Goal], chosen: Sequence[int], others: Sequence[int]) -> Array:
    """(K,) mean progress of all goals with each of some more views."""
    return np.asarray(np.mean([goal.progress(goal.channel.with_each(chosen, others)) for goal in goals], axis=0))


def present_progress(goals: Sequence[Goal], chosen: Sequence[int]) -> float:
    """The same of the chosen views alone."""
    return float(np.mean([goal.progress(goal.channel.normal(chosen)) for goal in goals]))
