"""How well each candidate explains the views: evidence, p-value, amplitude.

Every form of a candidate is fitted with the variances estimated anew (`variance.py`). The p-value is that of
the Wald F test under the form's own REML; forms are counted (Bonferroni). The evidence is the likelihood
integrated over amplitudes of plausible size, so that more parameters cost what they could have explained.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.candidates import Candidate, Form
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.tails import f_tail
from stitch.statistics.variance_components import MANY_NUMBERS, at_variances, fit_variances

# A candidate is seen if one of its parameters, at its plausible size, is at least this many sigmas.
_SEEN = 0.5
# A prior of this many plausible sizes is as good as none, and keeps the unseen finite.
_FREE = 30.0
# Forms that do not gain under the null's variances do not gain under their own either.
_HOPELESS = -4.0
# Under several variances, of which one is nearly that of the maximum, they gain half a nat at the most.
_HOPELESS_ANYWHERE = -1.5
# Forms so far (nats) behind the best one of their candidate add less than a per cent to it.
_FAR = 6.0
# With thousands of numbers the variances hardly move, and each fit takes a second: the best forms must do, and a
# wide prior in place of that of plausible sizes moves the variances not at all.
_REFITTED, _AMONG_MANY = 20_000, 2
# With many components of the pose errors a fit among more numbers than this takes half a second.
_LONG = 250


@dataclass(frozen=True)
class Score:
    """One candidate against the null."""

    candidate: Candidate
    observable: bool
    form: Form  # the best one
    p_value: float  # of the candidate, its forms counted; not yet counted over candidates
    log_bayes_factor: float  # over everything else that may be there
    values: Array  # (p,) of the best form, free fit
    covariance: Array  # (p, p); NaN where no form was worth a fit
    beside: LinearModel | None = None  # with the pose errors that remain beside the best form, where these have a prior

    @property
    def name(self) -> str:
        """That of the effect."""
        return self.candidate.name

    @property
    def sigmas(self) -> Array:
        """(p,) standard deviations of the values."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))

    @property
    def fitted(self) -> bool:
        """True if the best form was worth a fit."""
        return bool(np.isfinite(self.covariance).all())


@dataclass(frozen=True)
class _Tried:
    """One form against the null."""

    log_bayes_factor: float
    p_value: float = 1.0
    values: Array | None = None  # (p,) free fit; None where the form was not worth one
    covariance: Array | None = None
    variances: Array | None = None  # (c,)


def score(linear: LinearModel, candidate: Candidate) -> Score:
    """Try all forms of a candidate beside everything else that poses may err by.

    The candidate takes the place of its own share of the pose errors: it is asked for by name, all others remain of
    whatever size the views give them.
    """
    base = linear.without([candidate.name])
    full = candidate.forms[0]
    starts = (base, *base.elsewhere)
    whites = [at.residual(full.columns) * full.sizes for at in starts]
    seen = any(bool((np.linalg.norm(white, axis=0) > _SEEN).any()) for white in whites if white.size)
    quick = np.array([[_quick(base, at, form) for at in starts] for form in candidate.forms])
    likely = quick.max(axis=1)
    least = _HOPELESS if base.pose_errors is None else max(_HOPELESS_ANYWHERE, likely.max() - _FAR)
    worth = [i for i in np.argsort(-likely, kind="stable")[: _refitted(linear)] if likely[i] >= least]
    tried = [
        _try(base, form, starts[int(quick[i].argmax())].null.variances)
        if i in worth and candidate.forms[i].columns.any()
        else _Tried(float(likely[i]))
        for i, form in enumerate(candidate.forms)
    ]
    weights = form_weights(candidate)
    k = max(range(len(tried)), key=lambda i: tried[i].log_bayes_factor)
    total = float(logsumexp(np.array([t.log_bayes_factor for t in tried]) + np.log(weights)))
    p = float(min(1.0, np.min(np.array([t.p_value for t in tried]) / weights)))
    best, form = tried[k], candidate.forms[k]
    if best.values is None or best.covariance is None:
        nothing = np.zeros(len(form.sizes))
        values, covariance = nothing, np.diag(nothing + np.nan)
    else:
        p, total, values, covariance = p if seen else 1.0, total if seen else 0.0, best.values, best.covariance
    return Score(candidate, seen, form, p, total, values=values, covariance=covariance, beside=_beside(base, best))


def _refitted(linear: LinearModel) -> int:
    """How many forms of a candidate are worth a fit of their own."""
    size = linear.mixed.size
    if linear.pose_errors is not None and size > _LONG:
        return 1
    return _AMONG_MANY if size > MANY_NUMBERS else _REFITTED // size


def _beside(base: LinearModel, best: _Tried) -> LinearModel | None:
    if base.pose_errors is None or best.variances is None:
        return None
    return replace(base, null=at_variances(base.mixed, best.variances))


def _quick(base: LinearModel, at: LinearModel, form: Form) -> float:
    """Log Bayes factor over the base at given variances: what refitted variances can only raise."""
    return _at_null(at, form, at.residual(form.columns)) + 0.5 * (base.null.deviance - at.null.deviance)


def promising(linear: LinearModel, candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """The most likely candidates at the null's variances, with all their parameters or those of one joint."""
    quick = [max(_at_null(linear, form, linear.residual(form.columns)) for form in c.forms) for c in candidates]
    return [candidates[k] for k in np.argsort(-np.array(quick), kind="stable")[:count]]


def _try(linear: LinearModel, form: Form, start: Array) -> _Tried:
    """One form with its variances estimated anew."""
    mixed, G, wide = linear.mixed, linear.in_blocks(form.columns), _FREE * form.sizes
    integrated = fit_variances(mixed, G, form.sizes, start=start)
    if mixed.size > MANY_NUMBERS or linear.pose_errors is not None:
        free = at_variances(mixed, integrated.variances, G, wide)
    else:
        free = fit_variances(mixed, G, wide, integrated.variances)
    a = mixed.A.shape[2]
    theta, covariance = free.mean[a:], free.covariance[a:, a:]
    rank, square = _wald(theta, covariance, form.sizes)
    rest = max(mixed.size - a - rank, 1)
    p = f_tail(square / max(rank, 1), max(rank, 1), rest)
    return _Tried(0.5 * (linear.null.deviance - integrated.deviance), p, theta, covariance, integrated.variances)


def _at_null(linear: LinearModel, form: Form, white: Array) -> float:
    """Log Bayes factor at the null's variances: cheap, and an upper hand for what cannot help."""
    white = white * form.sizes
    information = np.eye(white.shape[1]) + white.T @ white
    b = white.T @ linear.white_residual
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
