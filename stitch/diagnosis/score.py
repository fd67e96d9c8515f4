"""How well each candidate explains the views: evidence, p-value, amplitude.

Every form of a candidate is fitted with the variances estimated anew (`variance_components.py`). The p-value is that of
the Wald F test under the form's own REML; forms are counted (Bonferroni). The evidence is the likelihood
integrated over amplitudes of plausible size, so that more parameters cost what they could have explained.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.candidates import Candidate, Form
from stitch.diagnosis.form_trial import LONG, FormTrial, Gain, gain_at_null, residual_form_columns, try_form
from stitch.diagnosis.thresholds import LOG_BAYES_FACTOR
from stitch.frames import Array, Mask
from stitch.observations.linear_model import LinearModel
from stitch.statistics.variance_components import MANY_NUMBERS, at_variances
from stitch.system.threads import parallel

# A candidate is seen if one of its parameters, at its plausible size, is at least this many sigmas.
SEEN = 0.5
# Forms that do not gain under the null's variances do not gain under their own either.
_HOPELESS = -4.0
# Under several variances, of which one is nearly that of the maximum, they gain half a nat at the most.
_HOPELESS_ANYWHERE = -1.5
# Forms so far (nats) behind the best one of their candidate add less than a per cent to it.
_FAR = 6.0
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
    log_bayes_factor: float  # over everything else that may be there
    values: Array  # (p,) of the best form, free fit
    covariance: Array  # (p, p); NaN where no form was worth a fit
    scale: float = 1.0  # of the plausible sizes of its parameters, the likeliest
    base_model: LinearModel | None = (
        None  # with the pose errors that remain beside the best form, where these have a prior
    )

    @property
    def name(self) -> str:
        """That of the effect."""
        return self.candidate.name

    @property
    def sizes(self) -> Array:
        """(p,) of its parameters, as believed beside others: plausible ones, unless larger are likelier."""
        return np.asarray(max(self.scale, 1.0) * self.form.sizes)

    @property
    def sigmas(self) -> Array:
        """(p,) standard deviations of the values."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))

    @property
    def fitted(self) -> bool:
        """True if the best form was worth a fit."""
        return bool(np.isfinite(self.covariance).all())


def score(linear: LinearModel, candidate: Candidate) -> Score:
    """Try all forms of a candidate beside everything else that poses may err by.

    The candidate takes the place of its own share of the pose errors: it is asked for by name, all others remain of
    whatever size the views give them.
    """
    base = linear.without([candidate.name])
    starts = (base, *base.alternative_starts)
    gained, shown = zip(*(_gains_at_null(base, at, candidate) for at in starts), strict=True)
    quick, seen = np.array([[gain.log_bayes_factor for gain in own] for own in gained]).T, any(shown)
    likely = quick.max(axis=1)
    # Under a scatter that holds an effect itself no plausible size is seen, and yet a gross one gains.
    seen = seen or bool(likely.max() > LOG_BAYES_FACTOR)
    least = max(_HOPELESS if base.pose_errors is None else _HOPELESS_ANYWHERE, likely.max() - _FAR)
    worth = [i for i in np.argsort(-likely, kind="stable")[: _count_refitted_forms(linear)] if likely[i] >= least]
    tried = [
        try_form(base, form, starts[start].null.variances, gained[start][i].scale)
        if i in worth and candidate.forms[i].columns.any()
        else FormTrial(float(likely[i]))
        for i, (form, start) in enumerate(zip(candidate.forms, quick.argmax(axis=1), strict=True))
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
    return Score(
        candidate,
        seen,
        form,
        p,
        total,
        values=values,
        covariance=covariance,
        scale=best.scale,
        base_model=_base_with_candidate(base, best),
    )


def _count_refitted_forms(linear: LinearModel) -> int:
    """How many forms of a candidate are worth a fit of their own."""
    size = linear.mixed.size
    if linear.pose_errors is not None and size > LONG:
        return 1
    return _AMONG_MANY if size > MANY_NUMBERS else _REFITTED // size


def _base_with_candidate(base: LinearModel, best: FormTrial) -> LinearModel | None:
    if base.pose_errors is None or best.variances is None:
        return None
    return replace(base, null=at_variances(base.mixed, best.variances))


def _gains_at_null(base: LinearModel, at: LinearModel, candidate: Candidate) -> tuple[list[Gain], bool]:
    """What its forms (F,) gain over the base at given variances, which refitted variances can only raise; and whether
    the first form, of all its parameters, is seen."""
    gains, seen = list[Gain](), False
    for form, white in zip(candidate.forms, residual_form_columns(at, candidate), strict=True):
        if not gains:
            seen = bool((np.linalg.norm(white * form.sizes, axis=0) > SEEN).any())
        gain, here = gain_at_null(at, form, white), 0.5 * (base.null.deviance - at.null.deviance)
        gains.append(replace(gain, log_bayes_factor=gain.log_bayes_factor + here))
    return gains, seen


def promising(linear: LinearModel, candidates: Sequence[Candidate], count: int) -> list[tuple[Candidate, float]]:
    """The most likely candidates at the null's variances, with all their parameters or those of one joint.

    Returns:
        With what they gain there (nats), best first.
    """

    def gain(c: Candidate) -> float:
        pairs = zip(c.forms, residual_form_columns(linear, c), strict=True)
        return max(gain_at_null(linear, form, white).log_bayes_factor for form, white in pairs)

    gains = np.array(list(parallel(gain, candidates)))
    return [(candidates[k], float(gains[k])) for k in np.argsort(-gains, kind="stable")[:count]]


def form_weights(candidate: Candidate) -> Array:
    """(F,) share of the prior of each form."""
    return weights_of_masks([form.keep for form in candidate.forms])


def weights_of_masks(masks: Sequence[Mask]) -> Array:
    """(F,) the same by free parameters (P,): the full forms share one half, those of single joints the other."""
    kept = np.array([keep.sum() for keep in masks])
    whole = kept == kept[0]
    return np.asarray(np.where(whole, (0.5 if (~whole).any() else 1.0) / whole.sum(), 0.5 / max((~whole).sum(), 1)))
