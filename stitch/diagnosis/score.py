"""How well each candidate explains the views: evidence, p-value, amplitude.

Every form of a candidate is fitted with the variances estimated anew (`reml`). The p-value is that of
the Wald F test under the form's own REML; forms are counted (Bonferroni). The evidence is the likelihood
integrated over amplitudes of plausible size, so that more parameters cost what they could have explained.

How large an effect is if it is there nobody knows before: its parameters are of plausible size, or all alike three
times, a third or a tenth of it, each as likely, or grossly wrong. With plausible sizes alone, six numbers of which
the views show a tenth of that were charged for all that they could have been, and effects beyond chance (p = 1e-9)
counted for nothing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, Form, candidate_of
from stitch.diagnosis.regime import regime_of
from stitch.effects.contract import find_effect
from stitch.fit.pipelines import linearise
from stitch.model.model import Model, geometry_terms, term_of
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.numerics.distributions import chi2_limit, f_tail
from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import column_space
from stitch.numerics.parameter_selection import log_evidence_at_scales, log_mixture
from stitch.numerics.reml import NOISE, USUAL_NOISE_FACTOR, FurtherColumns, at_variances, fit_variances
from stitch.numerics.units import MILLIMETRES
from stitch.numerics.variance_posterior import satterthwaite
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import USUAL_JOINT_SCATTER, usual_twist
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData
from stitch.system.threads import parallel


@dataclass(frozen=True)
class Score:
    """How well one candidate explains the views, over the null model without it."""

    candidate: Candidate
    observable: bool  # these views could show it at a plausible size
    form: Form  # the best of its F forms
    p_value: float  # adjusted for its forms, not for the number of candidates
    log_bayes_factor: float  # averaged over its forms
    values: Array  # (p,) of the best form, fitted freely
    covariance: Array  # (p, p) of these; NaN where no form was worth a fit
    scale: float = 1.0  # likeliest multiple of the plausible sizes
    variances: Array | None = None  # (c,) fitted beside the best form; None where it was not worth a fit
    # the model in which it was scored, at these variances, where pose errors have a prior
    base_model: LinearModel | None = None
    log_shares: Array | None = None  # (F,) log Bayes factor of every form plus the log of its share of the prior

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.candidate.name

    @property
    def sizes(self) -> Array:
        """(p,) of its parameters, as believed beside others: plausible ones, unless larger are likelier."""
        return max(self.scale, 1.0) * self.form.sizes

    @property
    def sigmas(self) -> Array:
        """(p,) standard deviations of the values."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))

    @property
    def fitted(self) -> bool:
        """True if the best form was worth a fit."""
        return bool(np.isfinite(self.covariance).all())


def score(linear: LinearModel, candidate: Candidate, start: Array | None = None) -> Score:
    """Return how well a candidate explains the views, by its best form, with all other pose errors as random effects.

    The candidate's own random effect is taken out of the model first, since it would explain the same. Forms are rated
    quickly at fixed variances, and the most promising are fitted with all variances (`try_form`).

    Args:
        start: (c,) variances at which the fits begin; None: the best of several starts, as there may be local maxima.
    """
    base = linear.without([candidate.name])
    starts = (base, *base.alternative_starts)
    at_starts = [_gains_at_null(base, at, candidate) for at in starts]
    quick_gains = np.array([[gain for gain, _ in of_forms] for of_forms, _ in at_starts])
    gains = quick_gains.max(axis=0)
    best_start = quick_gains.argmax(axis=0)
    # Where the scatter has absorbed a gross effect, no plausible size seems observable; yet the effect gains.
    observable = any(seen for _, seen in at_starts) or bool(gains.max() > limits.LOG_BAYES_FACTOR)
    weights = form_weights(candidate)
    trials = dict[int, Score]()
    for i in _forms_to_fit(base, candidate, gains, regime_of(linear).forms_refitted):
        _, scale = at_starts[best_start[i]][0][i]
        variances = starts[best_start[i]].null.variances if start is None else start
        trials[i] = try_form(base, candidate, candidate.forms[i], variances, scale)
    # A form without a fit keeps its gain at fixed variances, a lower bound, and a p-value of 1.
    log_shares = np.array([trials[i].log_bayes_factor if i in trials else gains[i] for i in range(len(gains))])
    log_shares = log_shares + np.log(weights)
    log_bayes_factor = float(logsumexp(log_shares))
    p_values = [trials[i].p_value if i in trials else 1.0 for i in range(len(gains))]
    p_value = float(min(1.0, np.min(np.array(p_values) / weights)))
    if not trials:
        form = candidate.forms[int(gains.argmax())]
        nothing = np.zeros(len(form.sizes))
        unknown = np.diag(nothing + np.nan)
        return Score(candidate, observable, form, p_value, log_bayes_factor, nothing, unknown, log_shares=log_shares)
    if not observable:
        p_value, log_bayes_factor = 1.0, 0.0
    best = max(trials.values(), key=lambda trial: trial.log_bayes_factor)
    best = replace(
        best, observable=observable, p_value=p_value, log_bayes_factor=log_bayes_factor, log_shares=log_shares
    )
    if not regime_of(base).prior or best.variances is None:
        return best
    return replace(best, base_model=replace(base, null=at_variances(base.mixed, best.variances)))


def _forms_to_fit(base: LinearModel, candidate: Candidate, gains: Array, most: int) -> list[int]:
    """Return the indices of the forms that are worth a fit with all variances, `most` of them at the most.

    They are the likeliest ones that the views show at all, and that may still gain. A candidate that cannot gain is
    fitted in one form only, to report its size.

    Args:
        gains: (F,) log Bayes factors at fixed variances.
    """
    regime = regime_of(base)
    is_hopeless = regime.prior and logsumexp(gains + np.log(form_weights(candidate))) < -limits.REFIT_GAIN_WITH_PRIOR
    visible = [i for i in np.argsort(-gains, kind="stable").tolist() if candidate.forms[i].columns.any()]
    least = max(regime.least_quick_gain, gains.max() - limits.NEGLIGIBLE_NATS)
    return [i for i in sorted(visible[: 1 if is_hopeless else most]) if gains[i] >= least]


def try_form(linear: LinearModel, candidate: Candidate, form: Form, start: Array, scale: float) -> Score:
    """Return how well one form of a candidate explains the views, fitted with all variances estimated again.

    Two fits are made. With the prior of plausible sizes, at several scales, the likelihood gives the Bayes factor. With
    a wide prior of `FREE_SIZES` plausible sizes, as good as none, come the values θ and the Wald test θᵀ C⁻¹ θ.

    Args:
        start: (c,) variances at which the fit begins.
        scale: multiple of the plausible sizes that is likeliest there.
    """
    mixed = linear.mixed
    G = FurtherColumns(mixed, (form.selected,))
    integrated = fit_variances(mixed, G, scale * form.sizes, start=start)
    regime = regime_of(linear)
    scales = regime.scales
    if regime.one_scale_is_enough:
        scales = {scale: scales[scale]}
    deviances = {scale: integrated.deviance}
    if len(scales) > 1:
        # What the form explains is no scatter: beside less of it another scale may be the likeliest.
        deviances = {s: integrated.under_prior(s * form.sizes).deviance for s in scales}
        best = min(deviances, key=lambda s: deviances[s])
        if best != scale:
            scale, integrated = best, fit_variances(mixed, G, best * form.sizes, start=integrated.variances)
            deviances[best] = integrated.deviance
    wide = limits.FREE_SIZES * form.sizes
    if regime.free_fit_keeps_variances:
        free = integrated.under_prior(wide)
    else:
        free = fit_variances(mixed, G, wide, integrated.variances)
    a = mixed.A.shape[2]
    theta, covariance = free.mean[a:], free.covariance[a:, a:]
    p_value = _wald_p_value(linear, form, theta, covariance)
    log_bayes_factor = 0.5 * linear.null.deviance + log_mixture(-0.5 * np.array(list(deviances.values())), scales)
    return Score(candidate, True, form, p_value, log_bayes_factor, theta, covariance, scale, integrated.variances)


def _wald_p_value(linear: LinearModel, form: Form, theta: Array, covariance: Array) -> float:
    """Return the p-value of θᵀ C⁻¹ θ, over the combinations of parameters of which the views say more than the prior.

    Args:
        theta: (p,) values θ of the form's parameters, under the wide prior of `FREE_SIZES` plausible sizes.
        covariance: C (p, p) of these.
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(form.sizes, form.sizes))
    seen = values < 0.5 * limits.FREE_SIZES**2
    square = float(np.sum((vectors[:, seen].T @ (theta / form.sizes)) ** 2 / np.maximum(values[seen], 1e-300)))
    rank = int(seen.sum())
    # The scatter along the columns of a form is known to fewer degrees of freedom than numbers are left, where views
    # tell several components apart; among very many numbers to as many.
    degrees_of_freedom: float = max(linear.mixed.size - linear.mixed.A.shape[2] - rank, 1)
    if not regime_of(linear).one_scale_is_enough:
        white = linear.in_blocks(linear.residual(form.columns))
        degrees_of_freedom = max(linear.satterthwaite.degrees_of_freedom(white), 1.0)
    return f_tail(square / max(rank, 1), max(rank, 1), degrees_of_freedom)


def promising(linear: LinearModel, candidates: Sequence[Candidate], count: int) -> list[tuple[Candidate, float]]:
    """Return up to `count` candidates with the largest gain at the variances of the null model, best first.

    Returns:
        Candidates with the log Bayes factor (nats) of their best form there.
    """

    def largest_gain(candidate: Candidate) -> float:
        return max(_gain_at_null(linear, *sums)[0] for sums in _information_by_form(linear, candidate))

    gains = np.array(list(parallel(largest_gain, candidates)))
    return [(candidates[k], float(gains[k])) for k in np.argsort(-gains, kind="stable")[:count]]


def form_weights(candidate: Candidate) -> Array:
    """Return (F,) share of the prior of each form."""
    return weights_of_masks([form.keep for form in candidate.forms])


def weights_of_masks(masks: Sequence[Mask]) -> Array:
    """Return the share (F,) of the prior of each form, by its mask (P,) of free parameters.

    Forms with as many free parameters as the first share one half, the smaller ones the other.
    """
    kept = np.array([keep.sum() for keep in masks])
    whole = kept == kept[0]
    return np.where(whole, (0.5 if (~whole).any() else 1.0) / whole.sum(), 0.5 / max((~whole).sum(), 1))


def _gains_at_null(base: LinearModel, at: LinearModel, candidate: Candidate) -> tuple[list[tuple[float, float]], bool]:
    """Return (gain, likeliest scale) of each of F forms at given variances, and whether the effect is observable.

    A gain is a log Bayes factor over `base`; fitting the variances again can only raise it. An effect is observable if
    a parameter of its first form, at plausible size, is at least `SEEN_SIGMAS` sigmas.

    Args:
        base: the null model.
        at: the same model at the variances to use.
    """
    gains = list[tuple[float, float]]()
    seen = False
    for information, vector in _information_by_form(at, candidate):
        if not gains:
            seen = bool((np.diag(information) > limits.SEEN_SIGMAS**2).any())
        gain, scale = _gain_at_null(at, information, vector)
        gains.append((gain + 0.5 * (base.null.deviance - at.null.deviance), scale))
    return gains, seen


def _information_by_form(linear: LinearModel, candidate: Candidate) -> Iterator[tuple[Array, Array]]:
    """Yield for each form the matrix I (p, p) and vector v (p,) of its log likelihood vᵀθ − ½ θᵀIθ.

    θ are its parameters in units of their plausible sizes. I and v are computed once per term, for all its parameters;
    forms with fewer of them select rows and columns.
    """
    of_terms = candidate.forms_by_term
    sums = linear.information([whole.selected for whole, *_ in of_terms])
    for forms, (information, vector) in zip(of_terms, sums, strict=True):
        for form in forms:
            among = np.flatnonzero(form.keep[forms[0].keep])
            yield information[np.ix_(among, among)] * np.outer(form.sizes, form.sizes), vector[among] * form.sizes


def _gain_at_null(linear: LinearModel, information: Array, vector: Array) -> tuple[float, float]:
    """Return the log Bayes factor at the variances of `linear`, averaged over all scales, and the likeliest scale.

    It needs no fit, and so sorts out forms that cannot help.

    Args:
        information, vector: (p, p) and (p,) of the log likelihood, parameters in units of their plausible sizes.
    """
    shares = regime_of(linear).scales
    evidence = log_evidence_at_scales(information, vector, shares)
    likeliest = int((evidence + np.log(list(shares.values()))).argmax())
    return log_mixture(evidence, shares), list(shares)[likeliest]


def start_with_effects(
    session: SessionData,
    effects: Sequence[str],
    arm: ModelFile | None,
    measurement: Measurement,
    model: Model,
    gate: float,
) -> Model:
    """Return the model from which a fit begins: the given one, with further effects.

    Effects with a grid, events and time constants, begin at their best fit; all others at zero.

    Args:
        effects: names of effects to add.
        arm: another run's effects of joints and links, which replace those of the model; None: these stay.
        gate: largest distance between partners, length_unit.
    """
    if arm:
        known_arm = bind_to_session(arm, measurement)
        model = replace(model, terms=known_arm.terms, effects_covariance=known_arm.effects_covariance)
    if not any(term.is_geometry for term in model.terms):
        model = model.with_terms([*geometry_terms(measurement), *model.terms])
    terms = [term_of(measurement, find_effect(name)) for name in effects]
    if any(term.gridded.any() for term in terms):
        linear = linearise(session, measurement, model, gate)
        for k, term in enumerate(terms):
            candidate = candidate_of(linear, term.effect) if term.gridded.any() else None
            if candidate is not None:
                best = score(linear, candidate)
                terms[k] = best.form.at(best.values)
    return model.with_terms([*model.terms, *terms])


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
    """Return the repeatability that the session states under [robot]; else the scatter that no sound arm exceeds.

    Rotations are in rad, translations in length_unit.
    """
    stated, (rotation, translation) = session.repeatability, limits.IMPLAUSIBLE
    implausible = translation / MILLIMETRES[session.length_unit]
    return ScatterLimit(
        rotation=rotation if stated.sigma_rotation is None else stated.sigma_rotation,
        translation=implausible if stated.sigma_translation is None else stated.sigma_translation,
        rotation_stated=stated.sigma_rotation is not None,
        translation_stated=stated.sigma_translation is not None,
    )


def expected_scatter(linear: LinearModel, limit: ScatterLimit) -> ScatterLimit:
    """Return the scatter expected of the poses: as stated, else that of an ordinary arm, flange and joints."""
    flange = usual_twist(linear.measurement.length_unit)[[0, 3]]
    usual = np.sqrt(flange**2 + USUAL_JOINT_SCATTER**2 * linear.flange_per_joint)
    rotation, translation = (limits.ORDINARY_SCATTER * usual).tolist()
    return replace(
        limit,
        rotation=limit.rotation if limit.rotation_stated else rotation,
        translation=limit.translation if limit.translation_stated else translation,
    )


def beyond_expected(linear: LinearModel, expected: ScatterLimit) -> bool:
    """Return whether the residual of the views is larger than an expected scatter and chance allow.

    With the projection M = 1 − UUᵀ beside hand-eye and effects, and the expected covariance C of the reduced
    observations in units of their noise, |M z|² has the mean tr(MC) and the variance 2 tr(MCMC). A χ² of matching
    degrees of freedom gives the limit (Satterthwaite). C is not estimated: the estimate would absorb the excess.
    """
    mixed = linear.mixed
    noise = np.diagonal(mixed.components[NOISE], axis1=1, axis2=2)
    per_noise = 1 / np.sqrt(np.maximum(noise, 1e-300))
    variances = np.array([expected.rotation**2, expected.translation**2, USUAL_NOISE_FACTOR])
    C = np.einsum("c,cbij->bij", variances, mixed.components[: NOISE + 1])
    C = C * per_noise[:, :, None] * per_noise[:, None]
    design = (mixed.A * per_noise[:, :, None]).reshape(-1, mixed.A.shape[2])
    # U by blocks, as C, and the same as one matrix.
    U = column_space(design).reshape((*mixed.A.shape[:2], -1))
    z = (mixed.z * per_noise).ravel()
    flat_U = U.reshape(len(z), -1)
    residual = z - flat_U @ (flat_U.T @ z)
    CU = C @ U
    UCU = np.einsum("bik,bil->kl", U, CU)
    # Numbers that hold noise alone are kept apart, with their count and their sum of squares.
    count, noise_square = mixed.noise_only
    trace_MC = float(np.trace(C, axis1=1, axis2=2).sum() - np.trace(UCU)) + count * USUAL_NOISE_FACTOR
    trace_MCMC = float((C**2).sum() - 2 * (CU**2).sum() + (UCU**2).sum()) + count * USUAL_NOISE_FACTOR**2
    degrees_of_freedom = max(trace_MC**2 / max(trace_MCMC, 1e-300), 1e-9)
    chance = limits.ALPHA_UNKNOWN / 2 if expected.stated else limits.ALPHA
    limit = trace_MC * chi2_limit(chance, degrees_of_freedom) / degrees_of_freedom
    return float(residual @ residual) + noise_square > limit


def implausible(linear: LinearModel, limit: ScatterLimit) -> bool:
    """Return whether the poses scatter more than any sound arm, or more than is stated and chance allows.

    Repeating errors count as scatter here, since the views may not tell them apart. An estimated variance with ν
    degrees of freedom may exceed a stated one by the factor χ²(ν)/ν. ν is computed at the stated variance, because an
    estimate that is large by chance would look too well known.
    """
    linear = linear.restricted(())
    plausible = ((limit.rotation, limit.rotation_stated), (limit.translation, limit.translation_stated))
    for i, (allowed, stated) in enumerate(plausible):
        chance = 1.0
        if stated:
            # Degrees of freedom of the variance if its standard deviation were as stated.
            variances = linear.null.variances.copy()
            variances[i] = allowed**2
            spread = satterthwaite(linear.mixed, at_variances(linear.mixed, variances)).spread
            known = 2 / max(float(spread[i, i]), 1e-9)
            chance = float(np.sqrt(chi2_limit(limits.ALPHA_UNKNOWN / 2, known) / known))
        if np.sqrt(linear.null.variances[i]) > chance * allowed:
            return True
    return False
