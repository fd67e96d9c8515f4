"""How well each candidate explains the views: evidence, p-value, amplitude.

Every form of a candidate is fitted with the variances estimated anew (`variance.py`). The p-value is that of
the Wald F test under the form's own REML; forms are counted (Bonferroni). The evidence is the likelihood
integrated over amplitudes of plausible size, so that more parameters cost what they could have explained.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import f as f_distribution

from stitch.diagnosis.candidates import Candidate, Form
from stitch.frames import Array
from stitch.observations.evidence import ViewEvidence
from stitch.statistics.variance_components import MANY_NUMBERS, VarianceFit, at_variances, fit_variances

# A candidate is seen if one of its parameters, at its plausible size, is at least this many sigmas.
_SEEN = 0.5
# A prior of this many plausible sizes is as good as none, and keeps the unseen finite.
_FREE = 30.0
# Forms that do not gain under the null's variances do not gain under their own either.
_HOPELESS = -4.0
# With thousands of numbers the variances hardly move, and each fit takes a second: the best forms must do, and a
# wide prior in place of that of plausible sizes moves the variances not at all.
_REFITTED, _AMONG_MANY = 20_000, 2


@dataclass(frozen=True)
class Score:
    """One candidate against the null."""

    candidate: Candidate
    observable: bool
    form: Form  # the best one
    p_value: float  # of the candidate, its forms counted; not yet counted over candidates
    gain: float  # log evidence over the null's
    values: Array  # (p,) of the best form, free fit
    sigmas: Array  # (p,)
    covariance: Array  # (p, p)
    fit: VarianceFit

    @property
    def name(self) -> str:
        return self.candidate.name


def score(evidence: ViewEvidence, candidate: Candidate) -> Score:
    """Try all forms of a candidate."""
    full = candidate.forms[0]
    whites = [evidence.whiten_channel(form.columns) for form in candidate.forms]
    seen = bool((np.linalg.norm(whites[0], axis=0) * full.sizes > _SEEN).any()) if whites[0].size else False
    quick = np.array([_null_gain(evidence, form, w) for form, w in zip(candidate.forms, whites, strict=True)])
    size = evidence.evidence.size
    count = _AMONG_MANY if size > MANY_NUMBERS else _REFITTED // size
    worth = np.argsort(-quick, kind="stable")[:count]
    tried = [
        _try(evidence, form) if i in worth and quick[i] >= _HOPELESS else (float(quick[i]), 1.0, evidence.null)
        for i, form in enumerate(candidate.forms)
    ]
    best = max(range(len(tried)), key=lambda i: tried[i][0])
    gains, weights = np.array([gain for gain, *_ in tried]), form_weights(candidate)
    gain = float(logsumexp(gains + np.log(weights)))
    p_values = np.array([p for _, p, _ in tried])
    p = float(min(1.0, np.min(p_values / weights)))
    return _fill(evidence, candidate, seen, tried[best], candidate.forms[best], p, gain)


def promising(evidence: ViewEvidence, candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """The candidates that gain most at the null's variances, with all their parameters or those of one joint."""
    gains = [
        max(_null_gain(evidence, form, evidence.whiten_channel(form.columns)) for form in c.forms) for c in candidates
    ]
    return [candidates[k] for k in np.argsort(-np.array(gains), kind="stable")[:count]]


def _try(evidence: ViewEvidence, form: Form) -> tuple[float, float, VarianceFit]:
    """Log evidence over the null, p-value and free fit of one form."""
    e = evidence.evidence
    G = evidence.in_blocks(form.columns)
    integrated = fit_variances(e, G, form.sizes, start=evidence.null.variances)
    gain = 0.5 * (evidence.null.deviance - integrated.deviance)
    many = e.size > MANY_NUMBERS
    wide = _FREE * form.sizes
    free = at_variances(e, integrated.variances, G, wide) if many else fit_variances(e, G, wide, integrated.variances)
    a = e.A.shape[2]
    theta, covariance = free.mean[a:], free.covariance[a:, a:]
    rank, square = _wald(theta, covariance, form.sizes)
    rest = max(e.size - a - rank, 1)
    return gain, float(f_distribution.sf(square / max(rank, 1), max(rank, 1), rest)), free


def _null_gain(evidence: ViewEvidence, form: Form, white: Array) -> float:
    """Log evidence gained at the null's variances: cheap, and an upper hand for what cannot help."""
    white = white * form.sizes
    information = np.eye(white.shape[1]) + white.T @ white
    b = white.T @ evidence.white_z
    return float(0.5 * b @ np.linalg.solve(information, b) - 0.5 * np.linalg.slogdet(information)[1])


def _wald(theta: Array, covariance: Array, sizes: Array) -> tuple[int, float]:
    """Rank and θᵀC⁻¹θ over the combinations of which the views say more than the wide prior does."""
    values, vectors = np.linalg.eigh(covariance / np.outer(sizes, sizes))
    keep = values < 0.5 * _FREE**2
    projected = vectors[:, keep].T @ (theta / sizes)
    return int(keep.sum()), float(np.sum(projected**2 / np.maximum(values[keep], 1e-300)))


def form_weights(candidate: Candidate) -> Array:
    """(F,) share of the prior of each form: the full forms share one half, those of single joints the other."""
    kept = np.array([form.keep.sum() for form in candidate.forms])
    whole = kept == kept[0]
    return np.asarray(np.where(whole, (0.5 if (~whole).any() else 1.0) / whole.sum(), 0.5 / max((~whole).sum(), 1)))


def _fill(
    evidence: ViewEvidence, candidate: Candidate, seen: bool, tried: tuple[float, float, VarianceFit], form: Form,
    p: float, gain: float,
) -> Score:  # fmt: skip
    a, size = evidence.evidence.A.shape[2], form.columns.shape[1]
    fit = tried[2]
    if len(fit.mean) < a + size:
        nothing = np.zeros(size)
        return Score(candidate, seen, form, 1.0, gain, nothing, np.full(size, np.nan), np.zeros((size, size)), fit)
    covariance = fit.covariance[a:, a:]
    return Score(
        candidate, seen, form, p if seen else 1.0, gain if seen else 0.0, fit.mean[a:],
        np.sqrt(np.maximum(np.diag(covariance), 0)), covariance, fit,
    )  # fmt: skip
