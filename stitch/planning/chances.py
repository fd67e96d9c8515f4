"""Chances, before measuring: that an effect would be detected, named, or taken for another.

What planned views would see is drawn: an effect of a given size, beside everything that poses err by otherwise. Every
candidate effect is then judged as a diagnosis judges it (`diagnosis/selection`), at the expected variances: family-wise
p, Bayes factor, and odds over every rival in the model in which neither of the two is among the errors that remain, and
over joints that follow by no law; not over a flange that errs in time by no law.
What a diagnosis asks of views left out is not drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import SEEN, form_weights
from stitch.diagnosis.thresholds import LOG_BAYES_FACTOR, ODDS, PRIOR_PHYSICAL
from stitch.diagnosis.unknown.joint_laws import TIMES, law_covariances, log_posterior_of_any
from stitch.frames import Array, Mask
from stitch.observations.linear_model import LinearModel
from stitch.planning.candidate_tests import CandidateTest, covariance_tests, test_of_candidate
from stitch.statistics.mean_factor import log_mean_exp

DRAWS = 100


@dataclass(frozen=True)
class Chance:
    """Probabilities of what a diagnosis would say of one effect."""

    effect: str
    detected: float  # that something is said to be missing
    named: float  # that it is named, alone
    misnamed: float  # that another is named, alone
    taken_for: str | None  # the one that is named most often in its place


class ExpectedDiagnosis:
    """What a diagnosis of planned views would say, whatever these may see: all candidate effects beside the model."""

    def __init__(self, linear: LinearModel, candidates: Sequence[Candidate]) -> None:
        self.linear, self.candidates = linear, [c for c in candidates if _is_visible(linear, c)]
        self.tests = max(len(self.candidates), 1)
        self._half = np.linalg.cholesky(linear.covariance[0])
        self._of_arm = set({} if linear.pose_errors is None else linear.pose_errors.effects)
        self._tests: dict[tuple[frozenset[str], str], CandidateTest] = {}
        # By candidate the tests of all laws beside it, of each kind of each joint together, at several sizes.
        self._laws: dict[int, list[list[tuple[CandidateTest, ...]]]] = {}

    def simulate_numbers(self, shift: Array, rng: np.random.Generator) -> Array:
        """(n, D) numbers of the channel: shifts (n, D) under all other errors."""
        return np.asarray(self._half @ rng.standard_normal(shift.shape) + shift)

    def chance(self, effect: str, shift: Array, rng: np.random.Generator) -> Chance:
        """What would be said of an effect that shifts the channel by (n, D)."""
        numbers = self.simulate_numbers(shift, rng)
        own = [self._test({c.name}, c).evaluate(numbers) for c in self.candidates]
        factor, significant = np.array([f for f, _ in own]), np.array([s for _, s in own])
        best = self._best(numbers, np.where(significant & (factor > 0), factor, -np.inf))
        alarm = (significant & (factor > LOG_BAYES_FACTOR)).any(axis=0)
        counts = {c.name: float(np.mean(alarm & (best == k))) for k, c in enumerate(self.candidates)}
        named = counts.pop(effect, 0.0)
        other = max(counts, key=lambda name: counts[name], default=None)
        taken_for = other if other is not None and counts[other] > 0 else None
        return Chance(effect, float(alarm.mean()), named, sum(counts.values()), taken_for)

    def _test(self, removed: set[str], candidate: Candidate) -> CandidateTest:
        """A candidate where some effects are none of the errors that remain."""
        key = frozenset(removed & self._of_arm), candidate.name
        if key not in self._tests:
            self._tests[key] = test_of_candidate(self.linear.without(removed), candidate, self.tests)
        return self._tests[key]

    def _best(self, numbers: Array, factor: Array) -> Array:
        """(D,) the candidate that is ahead of every contender by the odds that a name needs; −1 where none is.

        Args:
            factor: (K, D) log Bayes factors, −∞ where a candidate does not contend.
        """
        leader = factor.argmax(axis=0)
        out = np.where(np.isfinite(factor.max(axis=0)), leader, -1)
        for k in np.unique(leader[out >= 0]):
            led = np.flatnonzero((leader == k) & (out >= 0))
            out[led[~self._ahead_of_laws(int(k), numbers[:, led])]] = -1
            for other in np.flatnonzero(np.isfinite(factor[:, led]).any(axis=1)):
                contested = led[np.isfinite(factor[other, led])]
                if other != k:
                    out[contested[~self._ahead(int(k), int(other), numbers[:, contested])]] = -1
        return out

    def _ahead_of_laws(self, k: int, numbers: Array) -> Mask:
        """(D,) whether a candidate is ahead of joints that follow by no law (`joint_laws.py`)."""
        own = self._test({self.candidates[k].name}, self.candidates[k])
        if k not in self._laws:
            found, sizes = law_covariances(own.linear), np.sqrt(TIMES)
            self._laws[k] = [[covariance_tests(own.linear, C, sizes) for C in kind] for kind in found]
        kinds = self._laws[k]
        if not kinds:
            return np.ones(numbers.shape[1], bool)
        rival = log_posterior_of_any(
            np.array([log_mean_exp(np.array([_best_log_factor(law, numbers) for law in kind])) for kind in kinds])
        )
        return np.asarray(own.evaluate(numbers)[0] + np.log(PRIOR_PHYSICAL / self.tests) > rival + ODDS)

    def _ahead(self, k: int, other: int, numbers: Array) -> Mask:
        pair = [self.candidates[k], self.candidates[other]]
        own, rival = (self._test({c.name for c in pair}, c).evaluate(numbers)[0] for c in pair)
        return np.asarray(own > rival + ODDS)


def _best_log_factor(law: Sequence[CandidateTest], numbers: Array) -> Array:
    """(D,) log Bayes factor at the likeliest of its sizes."""
    return np.asarray(np.max([size.evaluate(numbers)[0] for size in law], axis=0))


def _is_visible(linear: LinearModel, candidate: Candidate) -> bool:
    """True if one parameter at its plausible size is half a sigma at the least, as a diagnosis has it."""
    white = linear.without([candidate.name]).residual(candidate.forms[0].columns) * candidate.forms[0].sizes
    return bool((np.linalg.norm(white, axis=0) > SEEN).any())


def usual_shifts(candidate: Candidate, rng: np.random.Generator, draws: int = DRAWS) -> Array:
    """(n, D) what an effect of usual size does: each parameter of a form that is drawn, as large as is plausible."""
    chosen = rng.choice(len(candidate.forms), draws, p=form_weights(candidate))
    out = []
    for k in chosen:
        form = candidate.forms[k]
        out.append(form.columns @ (form.sizes * rng.choice([-1.0, 1.0], len(form.sizes))))
    return np.array(out).T
