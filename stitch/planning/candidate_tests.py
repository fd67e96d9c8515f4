"""One candidate beside a model of planned views: its log Bayes factor and its F test on whatever these may see.

The variances are the expected ones and stay as they are, so that a test is a few small matrices and thousands of draws
cost nothing.
"""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.form_trial import scales_of
from stitch.diagnosis.score import form_weights
from stitch.diagnosis.thresholds import ALPHA_NAME
from stitch.frames import Array, Mask
from stitch.observations.linear_model import LinearModel
from stitch.statistics.tails import f_limit

# Combinations that views see less than this share of a sigma, at plausible size, count in no p-value.
_MIN_INFORMATION = 1e-2


@dataclass(frozen=True)
class _FormTest:
    """One form at one scale, with p columns: turns what is seen into its log Bayes factor and its squares."""

    weight: float  # share of the candidate's prior
    against: Array  # (p, n) Wᵀ of whitened columns at the sizes of its scale
    inverse: Array  # (p, p) of 1 + WᵀW
    occam: float  # ½ log det of that
    solved: Array  # (r, p) whitens Wᵀz over the combinations that are seen
    limit: float  # of the sum of r squares, beyond which the family-wise p is small enough


@dataclass(frozen=True)
class CandidateTest:
    """All forms of a candidate beside one model."""

    linear: LinearModel
    forms: tuple[_FormTest, ...]

    def evaluate(self, numbers: Array) -> tuple[Array, Mask]:
        """(D,) log Bayes factors, and whether they are significant, of D draws (n, D) of the channel."""
        white, logs, significant = self.linear.whiten(numbers), [], np.zeros(numbers.shape[1], bool)
        for form in self.forms:
            b = form.against @ white
            logs.append(0.5 * np.sum(b * (form.inverse @ b), axis=0) - form.occam + np.log(form.weight))
            significant |= np.sum((form.solved @ b) ** 2, axis=0) > form.limit
        highest = np.max(logs, axis=0)
        return np.asarray(highest + np.log(np.sum(np.exp(logs - highest), axis=0))), significant


def test_of_candidate(linear: LinearModel, candidate: Candidate, tests: int) -> CandidateTest:
    """Of a candidate that is one of so many.

    Args:
        linear: the candidate is none of its pose errors.
    """
    forms, scales = zip(candidate.forms, form_weights(candidate), strict=True), scales_of(linear)
    found = [
        _form_test(linear, scale * form.columns * form.sizes, float(weight), tests, share)
        for form, weight in forms
        for scale, share in scales.items()
    ]
    return CandidateTest(linear, tuple(found))


def covariance_tests(linear: LinearModel, covariance: Array, sigmas: Array) -> tuple[CandidateTest, ...]:
    """Of errors that have a covariance (n, n) in the channel, times the square of each sigma (s,)."""
    half = _factor(covariance)
    return tuple(CandidateTest(linear, (_form_test(linear, sigma * half, 1.0, 1),)) for sigma in sigmas)


def _form_test(linear: LinearModel, columns: Array, weight: float, tests: int, share: float = 1.0) -> _FormTest:
    """Of columns (n, p) at a scale that has such a share of belief; all scales are one test."""
    white = linear.residual(columns)
    known = max(linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white)), 1.0)
    information = white.T @ white
    values, vectors = np.linalg.eigh(information)
    keep = values > _MIN_INFORMATION
    solved = (vectors[:, keep] / np.sqrt(values[keep])).T
    limit = keep.sum() * f_limit(ALPHA_NAME * weight / tests, max(int(keep.sum()), 1), known)
    with_prior = np.eye(len(values)) + information
    return _FormTest(
        weight * share,
        against=white.T,
        inverse=np.asarray(np.linalg.inv(with_prior), float),
        occam=float(np.linalg.slogdet(with_prior)[1]) / 2,
        solved=solved,
        limit=float(limit) if keep.any() else np.inf,
    )


def _factor(covariance: Array) -> Array:
    """(n, r) columns whose products make a covariance (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-12 * values[-1]
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))
