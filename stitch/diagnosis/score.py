"""How well each candidate explains the views: evidence, p-value, amplitude.

Every form of a candidate is fitted with the variances estimated anew (`reml`). The p-value is that of
the Wald F test under the form's own REML; forms are counted (Bonferroni). The evidence is the likelihood
integrated over amplitudes of plausible size, so that more parameters cost what they could have explained.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, Form, candidate_of
from stitch.diagnosis.regime import regime_of
from stitch.effects.contract import Effect, find_effect
from stitch.fit.pipelines import linearise
from stitch.model.model import Model, Term, term_of
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.numerics.distributions import chi2_limit, f_tail
from stitch.numerics.frames import Array, Mask
from stitch.numerics.parameter_selection import log_evidence_at_scales, log_mixture
from stitch.numerics.reml import FurtherColumns, at_variances, fit_variances
from stitch.numerics.units import METRES
from stitch.numerics.variance_posterior import satterthwaite
from stitch.observations.linear_model import LinearModel
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData
from stitch.system.threads import parallel

# One form of a candidate beside a model: what it gains, and its free amplitudes.
#
# How large an effect is if it is there nobody knows before: its parameters are of plausible size, or all alike three
# times, a third or a tenth of it, each as likely, or grossly wrong. With plausible sizes alone, six numbers of which
# the views show a tenth of that were charged for all that they could have been, and effects beyond chance (p = 1e-9)
# counted for nothing.


@dataclass(frozen=True)
class FormTrial:
    """One form against the null."""

    log_bayes_factor: float
    p_value: float = 1.0
    values: Array | None = None  # (p,) free fit; None where the form was not worth one
    covariance: Array | None = None
    variances: Array | None = None  # (c,)
    scale: float = 1.0  # of the plausible sizes, the likeliest


@dataclass(frozen=True)
class Gain:
    """Log Bayes factor of a form at given variances over all its scales, and the likeliest of these."""

    log_bayes_factor: float
    scale: float


def try_form(linear: LinearModel, form: Form, start: Array, scale: float) -> FormTrial:
    """One form with its variances estimated anew.

    Args:
        start: (c,) variances to begin with.
        scale: the one that is likeliest there.
    """
    mixed, wide = linear.mixed, limits.FREE_SIZES * form.sizes
    G = FurtherColumns(mixed, (form.selected,))
    integrated = fit_variances(mixed, G, scale * form.sizes, start=start)
    regime = regime_of(linear)
    scales = regime.scales
    if regime.long_without_prior:
        scales = {scale: scales[scale]}
    found = {scale: integrated.deviance}
    if len(scales) > 1:
        # What the form explains is no scatter: beside less of it another scale may be the likeliest.
        found = {s: at_variances(mixed, integrated.variances, G, s * form.sizes).deviance for s in scales}
        best = min(found, key=lambda s: found[s])
        if best != scale:
            scale, integrated = best, fit_variances(mixed, G, best * form.sizes, start=integrated.variances)
            found[best] = integrated.deviance
    if regime.free_fit_keeps_variances:
        mean, every = integrated.under_prior(wide)
    else:
        free = fit_variances(mixed, G, wide, integrated.variances)
        mean, every = free.mean, free.covariance
    a = mixed.A.shape[2]
    theta, covariance = mean[a:], every[a:, a:]
    rank, square = _wald(theta, covariance, form.sizes)
    p = f_tail(square / max(rank, 1), max(rank, 1), _scatter_degrees(linear, form, max(mixed.size - a - rank, 1)))
    gained = 0.5 * linear.null.deviance + log_mixture(-0.5 * np.array(list(found.values())), scales)
    return FormTrial(gained, p, theta, covariance, integrated.variances, scale)


def _scatter_degrees(linear: LinearModel, form: Form, rest: int) -> float:
    """Degrees of freedom to which the scatter along the columns of a form is known: fewer than numbers are left, where
    views tell several components apart; among very many numbers as many."""
    if regime_of(linear).long_without_prior:
        return rest
    return max(linear.satterthwaite.degrees_of_freedom(linear.in_blocks(linear.residual(form.columns))), 1.0)


def information_by_form(linear: LinearModel, candidate: Candidate) -> Iterator[tuple[Array, Array]]:
    """Per form what the views tell of its parameters (p,) beside the model, in plausible sizes (`log_evidence`): those
    of one joint are among those of all."""
    of_terms = [list(forms) for _, forms in groupby(candidate.forms, key=lambda form: id(form.term))]
    every = linear.information([whole.selected for whole, *_ in of_terms])
    for forms, (told, vector) in zip(of_terms, every, strict=True):
        for form in forms:
            own = np.flatnonzero(form.keep[forms[0].keep])
            yield told[np.ix_(own, own)] * np.outer(form.sizes, form.sizes), vector[own] * form.sizes


def gain_at_null(linear: LinearModel, told: Array, vector: Array) -> Gain:
    """Of what the views tell at the null's variances: cheap, and an upper hand for what cannot help."""
    shares = regime_of(linear).scales
    found = log_evidence_at_scales(told, vector, shares)
    return Gain(log_mixture(found, shares), list(shares)[int((found + np.log(list(shares.values()))).argmax())])


def _wald(theta: Array, covariance: Array, sizes: Array) -> tuple[int, float]:
    """Rank and θᵀC⁻¹θ over the combinations of which the views say more than the wide prior does."""
    values, vectors = np.linalg.eigh(covariance / np.outer(sizes, sizes))
    keep = values < 0.5 * limits.FREE_SIZES**2
    projected = vectors[:, keep].T @ (theta / sizes)
    return int(keep.sum()), float(np.sum(projected**2 / np.maximum(values[keep], 1e-300)))


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
    variances: Array | None = None  # (c,) beside the best form; None where it was not worth a fit
    # with the pose errors that remain beside the best form, where these have a prior
    base_model: LinearModel | None = None

    @property
    def name(self) -> str:
        """Return the name of the effect."""
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


def score(linear: LinearModel, candidate: Candidate, start: Array | None = None) -> Score:
    """Try all forms of a candidate beside everything else that poses may err by.

    The candidate takes the place of its own share of the pose errors: it is asked for by name, all others remain of
    whatever size the views give them.

    Args:
        start: (c,) variances to begin with; None: those of the null, or where else their maximum may lie.
    """
    base = linear.restricted(linear.causes - {candidate.name})
    starts = (base, *base.alternative_starts)
    gained, shown = zip(*(_gains_at_null(base, at, candidate) for at in starts), strict=True)
    quick, seen = np.array([[gain.log_bayes_factor for gain in own] for own in gained]).T, any(shown)
    likely, begin = quick.max(axis=1), [at.null.variances if start is None else start for at in starts]
    # Under a scatter that holds an effect itself no plausible size is seen, and yet a gross one gains.
    seen = seen or bool(likely.max() > limits.LOG_BAYES_FACTOR)
    least = max(regime_of(base).least_quick_gain, likely.max() - limits.NEGLIGIBLE_NATS)
    worth = [i for i in np.argsort(-likely, kind="stable")[: regime_of(linear).forms_refitted] if likely[i] >= least]
    tried = [
        try_form(base, form, begin[at], gained[at][i].scale)
        if i in worth and candidate.forms[i].columns.any()
        else FormTrial(float(likely[i]))
        for i, (form, at) in enumerate(zip(candidate.forms, quick.argmax(axis=1), strict=True))
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
    beside = None
    if regime_of(base).prior and best.variances is not None:
        beside = replace(base, null=at_variances(base.mixed, best.variances))
    return Score(
        candidate,
        seen,
        form,
        p,
        total,
        values=values,
        covariance=covariance,
        scale=best.scale,
        variances=best.variances,
        base_model=beside,
    )


def _gains_at_null(base: LinearModel, at: LinearModel, candidate: Candidate) -> tuple[list[Gain], bool]:
    """Return the gain of each form (F,) over the base at given variances, which a refit can only raise; and whether the
    first form, of all its parameters, is seen."""
    gains, seen = list[Gain](), False
    for told, vector in information_by_form(at, candidate):
        if not gains:
            seen = bool((np.diag(told) > limits.SEEN_SIGMAS**2).any())
        gain, here = gain_at_null(at, told, vector), 0.5 * (base.null.deviance - at.null.deviance)
        gains.append(replace(gain, log_bayes_factor=gain.log_bayes_factor + here))
    return gains, seen


def promising(linear: LinearModel, candidates: Sequence[Candidate], count: int) -> list[tuple[Candidate, float]]:
    """The most likely candidates at the null's variances, with all their parameters or those of one joint.

    Returns:
        With what they gain there (nats), best first.
    """

    def gain(c: Candidate) -> float:
        return max(gain_at_null(linear, *told).log_bayes_factor for told in information_by_form(linear, c))

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


# Values to begin a fit with: those that the views suggest at first sight.


def start_with_effects(
    session: SessionData,
    effects: Sequence[str],
    arm: ModelFile | None,
    measurement: Measurement,
    model: Model,
    gate: float,
) -> Model:
    """The model with another run's arm in place of its effects, if any, and with further effects by name.

    Args:
        gate: largest distance between partners where the session has scans, length_unit.
    """
    if arm:
        known_arm = bind_to_session(arm, measurement)
        model = replace(model, terms=known_arm.terms, effects_covariance=known_arm.effects_covariance)
    linear = partial(linearise, session, measurement, model, gate)
    return model.with_terms(
        [*model.terms, *_initial_terms(measurement, [find_effect(name) for name in effects], linear)]
    )


def _initial_terms(
    measurement: Measurement, effects: Sequence[Effect], linear_now: Callable[[], LinearModel]
) -> list[Term]:
    """A term for each effect; events and time constants at the value that explains most.

    Args:
        linear_now: the linear model before these effects, asked only where one has an event or a time constant.
    """
    zero = [term_of(measurement, effect) for effect in effects]
    if not any(term.gridded.any() for term in zero):
        return zero
    linear = linear_now()
    return [_suggest_values(linear, term) if term.gridded.any() else term for term in zero]


def _suggest_values(linear: LinearModel, zero: Term) -> Term:
    candidate = candidate_of(linear, zero.effect)
    if candidate is None:
        return zero
    best = score(linear, candidate)
    return best.form.at(best.values)


# How far the poses of the arm may scatter before something else than repeatability must be there.


@dataclass(frozen=True)
class ScatterLimit:
    """Standard deviations of the flange poses that are plausible, per axis."""

    rotation: float  # rad
    translation: float  # length_unit
    rotation_stated: bool = False
    translation_stated: bool = False

    @property
    def stated(self) -> bool:
        """True if the session states a repeatability: the judgement does not rest on what is usual."""
        return self.rotation_stated or self.translation_stated


def scatter_limit(session: SessionData) -> ScatterLimit:
    """Return what the session states under [robot] repeatability, else the largest usual scatter."""
    stated, (rotation, translation) = session.repeatability, limits.IMPLAUSIBLE
    usual = translation * METRES["mm"] / METRES[session.length_unit]
    return ScatterLimit(
        rotation=rotation if stated.sigma_rotation is None else stated.sigma_rotation,
        translation=usual if stated.sigma_translation is None else stated.sigma_translation,
        rotation_stated=stated.sigma_rotation is not None,
        translation_stated=stated.sigma_translation is not None,
    )


def implausible(linear: LinearModel, limit: ScatterLimit) -> bool:
    """True if the poses scatter as no arm does, or by more than is stated and chance explains.

    All of it counts, what repeats too: the views may not tell which it is. An estimated variance of ν degrees of
    freedom exceeds a stated one by χ²(ν)/ν at most; ν where the scatter is as stated, since what is large by chance
    looks well known.
    """
    linear = linear.restricted(())
    for i, (allowed, stated) in enumerate(
        ((limit.rotation, limit.rotation_stated), (limit.translation, limit.translation_stated))
    ):
        chance = 1.0
        if stated:
            known = _degrees_of_freedom(linear, i, allowed)
            chance = float(np.sqrt(chi2_limit(limits.ALPHA_UNKNOWN / 2, known) / known))
        if np.sqrt(linear.null.variances[i]) > chance * allowed:
            return True
    return False


def _degrees_of_freedom(linear: LinearModel, component: int, sigma: float) -> float:
    """Return the degrees of freedom of a component's variance if its standard deviation were `sigma`."""
    variances = linear.null.variances.copy()
    variances[component] = sigma**2
    known = satterthwaite(linear.mixed, at_variances(linear.mixed, variances))
    return 2 / max(float(known.spread[component, component]), 1e-9)
