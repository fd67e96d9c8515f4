"""Which laws of the dictionary explain what a model leaves, as candidates beside effects.

All forms of all laws are sized at the variances of the model, the likeliest few with all variances anew
(`score.try_form`), as effects are. A law of a joint is also asked as a law of the base (`laws_of_base`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, Form
from stitch.diagnosis.ranking import Ranked, likeliest_first
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import Score, try_form
from stitch.diagnosis.systematic_laws import BODIES, Dictionary, Law, LawEffect, bodies_of, law_of
from stitch.effects.contract import Parameter
from stitch.model.model import Term
from stitch.numerics.distributions import f_limits
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import column_space
from stitch.observations.linear_model import LinearModel

# Laws, and forms of each, that are fitted with all variances (time).
_LAWS_FITTED, _FORMS_OF_A_LAW_FITTED = 6, 2
# Nats by which a place may come nearer to the likeliest once variances are fitted again.
_GAIN_BY_FIT = 2.0
# Random residuals that are drawn for the family-wise p-value, and their seed. Bonferroni's value beyond which it is not
# sought, since no law is clear, and number of observations beyond which drawing takes too long.
_DRAWS, _SEED = 499, 20
_LARGEST_P_VALUE, _MOST_OBSERVATIONS = 1.0, 400


def rank_laws(linear: LinearModel, dictionary: Dictionary) -> tuple[Ranked, ...]:
    """Return the likeliest laws beside a model, best first, with their log posterior as that of effects (`Ranked`).

    All forms are sized at given variances: those of the null, or of another maximum of the null's likelihood. The best
    forms of the likeliest laws are then fitted with all variances. A law has the summed evidence of its forms.
    """
    laws, shares, forms_of = dictionary.laws, dictionary.shares, dictionary.forms_of
    if not laws:
        return ()
    starts = (linear, *linear.alternative_starts)
    gains, scales = np.full(len(laws), -np.inf), np.ones(len(laws))
    best_start = np.zeros(len(laws), np.int64)
    for k, at in enumerate(starts):
        gain, scale = _gains(at, dictionary)
        gain = gain + 0.5 * (linear.null.deviance - at.null.deviance)
        better = gain > gains
        gains, scales = np.where(better, gain, gains), np.where(better, scale, scales)
        best_start[better] = k
    weighted = gains + np.log(shares)
    prior = float(np.log(limits.PRIOR_LAWS / len(forms_of)))
    ranked = list[Ranked]()
    for key in _laws_to_fit(dictionary, weighted):
        forms = sorted(forms_of[key], key=lambda i: -weighted[i])
        fits = dict[int, Score]()
        for i in forms[:_FORMS_OF_A_LAW_FITTED]:
            fits[i] = _fit_law(linear, laws[i], starts[best_start[i]].null.variances, float(scales[i]))
            weighted[i] = fits[i].log_bayes_factor + np.log(shares[i])
        best = max(fits, key=lambda i: weighted[i])
        total = float(logsumexp(weighted[forms]))
        # Bonferroni over the laws, and over the forms of the law by their shares.
        p_value = fits[best].p_value / float(shares[best]) * len(forms_of)
        ranked.append(Ranked(replace(fits[best], log_bayes_factor=total), p_value, total + prior, 0.0, len(forms_of)))
    first, *others = likeliest_first(ranked)
    others = [replace(r, adjusted=min(r.adjusted, 1.0)) for r in others]
    return replace(first, adjusted=_family_wise(linear, dictionary, first)), *others


def _laws_to_fit(dictionary: Dictionary, weighted: Array) -> list[tuple[str, str]]:
    """Return the keys of the likeliest laws, and of the likeliest law of every place that may be the one.

    Args:
        weighted: (L,) log Bayes factor of each form plus the log of its share.
    """
    forms_of = dictionary.forms_of
    order = sorted(forms_of, key=lambda key: -np.logaddexp.reduce(weighted[forms_of[key]]))
    likeliest = order[:_LAWS_FITTED]
    if weighted.max() > limits.LOG_BAYES_FACTOR:
        # The place is reported too, so that every place that comes near is fitted. Reversed: the likeliest law remains.
        best_of_place = {place: key for key in reversed(order) for place in key[:1]}
        near = weighted.max() - limits.ODDS - _GAIN_BY_FIT
        best_keys = [key for key in best_of_place.values() if key not in likeliest]
        likeliest += [key for key in best_keys if weighted[forms_of[key]].max() > near]
    return likeliest


def _family_wise(linear: LinearModel, dictionary: Dictionary, ranked: Ranked) -> float:
    """Return the family-wise p-value of the clearest law: the chance that any law looks as clear in mere scatter.

    Bonferroni's value is too large, since laws resemble each other. Where it does not decide by itself, residuals are
    drawn at random `_DRAWS` times, and the draws counted in which some law is as clear (Monte Carlo test).

    Args:
        ranked: the law, with Bonferroni's value in `adjusted`.
    """
    bonferroni = ranked.adjusted
    decided = bonferroni < limits.ALPHA_UNKNOWN or bonferroni > _LARGEST_P_VALUE
    if decided or linear.mixed.z.size > _MOST_OBSERVATIONS:
        return min(bonferroni, 1.0)
    rng = np.random.default_rng(_SEED)
    known = linear.mixed.size - linear.design.shape[1]
    # Student's t: white residuals over a scatter that is known to so many degrees of freedom.
    residuals = rng.standard_normal((linear.mixed.z.size, _DRAWS)) / np.sqrt(rng.chisquare(known, _DRAWS) / known)
    by_rank: dict[int, list[tuple[Array, float]]] = {}
    for law, share in zip(dictionary.laws, dictionary.shares, strict=True):
        U = column_space(linear.residual(law.reduced_columns(linear.observation)))
        by_rank.setdefault(U.shape[1], []).append((U, share))
    as_clear = np.zeros(_DRAWS, bool)
    for rank, laws in by_rank.items():
        if not rank:
            continue
        # The explained square of each form at which its p-value, corrected by Bonferroni, is that of the law.
        p_values = np.array([bonferroni * share for _, share in laws]) / len(dictionary.forms_of)
        limit = rank * f_limits(np.minimum(p_values, 1.0), rank, known)
        squares = (np.hstack([U for U, _ in laws]).T @ residuals) ** 2
        as_clear |= (squares.reshape(len(laws), rank, -1).sum(axis=1) >= limit[:, None]).any(axis=0)
    return float((1 + as_clear.sum()) / (1 + _DRAWS))


def laws_of_base(
    linear: LinearModel, dictionary: Dictionary, laws: Sequence[Ranked], effect: Score | None = None
) -> tuple[Ranked, ...]:
    """Return the laws of the base by which it would do what a joint's law does, each as likely as the joint's.

    For each given law of a joint that a moving base could be, it is the base with the same driver and shape.

    Args:
        dictionary: all laws that were tried.
        laws: ranked laws; those that are not of a joint are passed over.
        effect: score of a named effect that says the joint's law; None: the law as it was fitted.
    """
    of_base = list[Ranked]()
    for ranked in laws:
        law, scored = law_of(ranked), effect or ranked.score
        if law.place.joint is None or law.place.with_base:
            continue
        if not could_be_base(linear, scored.form.columns @ scored.values, law.shapes):
            continue
        follows = (law.driver.name, law.shape)
        for other in dictionary.laws:
            is_base = other.place.kind in BODIES and other.place.with_base
            if is_base and other.is_full and (other.driver.name, other.shape) == follows:
                base_score = _fit_law(linear, other, linear.null.variances, 1.0)
                of_base.append(replace(ranked, score=base_score))
    return tuple(of_base)


def could_be_base(linear: LinearModel, effect: Array, shapes: Array) -> bool:
    """Return whether the base, moving along and about its own axes by the same shapes, would explain an effect as well.

    It would where what the base leaves of the effect is small on two scales: beside the scatter, so that likelihoods
    differ by less than 20 to 1, and beside the effect itself, so that the two are aliases in these views.

    Args:
        effect: (n,) what the effect does to the reduced observations.
        shapes: (V, R) of its motion over the views; the base has a free coefficient for each along and about each axis.
    """
    # Where the scanner is carried, the base stands where the part does; where it is fixed, with the scanner.
    bodies = [twists for _, _, twists in bodies_of(linear)]
    base = bodies[1] if linear.measurement.eye_to_hand else bodies[0]
    twists = (base[:, :, :, None] * shapes[:, None, None, :]).reshape(6 * len(base), -1)
    basis = column_space(linear.residual(linear.observation.from_twists(twists)))
    white = linear.residual(effect[:, None])[:, 0]
    left_square = float(np.sum((white - basis @ (basis.T @ white)) ** 2))
    alias_square = (1 - limits.ALIAS_CORRELATION**2) * float(np.sum(white**2))
    # A log likelihood is half a sum of squares.
    return left_square < min(2 * limits.ODDS, alias_square)


def law_size(linear: LinearModel, ranked: Ranked) -> tuple[float, float, str]:
    """Return size, sigma and unit of a law: the range of a joint's error (rad), or the largest displacement.

    A displacement is that of the part in a view, against the first view, in the length unit.
    """
    scored = ranked.score
    law = law_of(ranked)
    if law.place.joint is not None:
        change = law.shapes - law.shapes[np.argmin(law.shapes @ scored.values)]
        farthest = change[np.argmax(np.abs(change @ scored.values))]
        unit = "rad"
    else:
        moved = np.stack([linear.observation.part_displacements(column) for column in scored.form.columns.T], axis=2)
        moved = moved - moved[0]
        k = int(np.argmax(np.linalg.norm(moved @ scored.values, axis=1)))
        along = moved[k] @ scored.values
        farthest = along / max(float(np.linalg.norm(along)), 1e-300) @ moved[k]
        unit = linear.measurement.length_unit
    sigma = float(np.sqrt(max(farthest @ scored.covariance @ farthest, 0.0)))
    return abs(float(farthest @ scored.values)), sigma, unit


def _fit_law(linear: LinearModel, law: Law, start: Array, scale: float) -> Score:
    """Return the score of a law as a candidate effect, fitted with all variances.

    Args:
        start: (c,) variances to begin with.
        scale: likeliest multiple of its usual sizes.
    """
    reduced = law.reduced_columns(linear.observation)
    units = np.repeat(np.array(law.place.units)[law.axes], law.shapes.shape[1])
    parameters = tuple(
        Parameter(f"c{i}", str(unit), typical=float(size))
        for i, (unit, size) in enumerate(zip(units, law.sizes, strict=True))
    )
    kind = law.place.kind
    effect = LawEffect(
        law.words, kind, {}, _no_function, needs=(), prefers=(), tier="empirical", group=law.driver.name, law=law
    )
    response = linear.observation.expand(reduced)
    form = Form(Term(effect, parameters), np.ones(len(parameters), bool), response, reduced, law.sizes)
    return try_form(linear, Candidate(effect, (form,), None), form, start, scale)


def _no_function(*_: object) -> None:
    """A law of the dictionary"""


def _gains(linear: LinearModel, dictionary: Dictionary) -> tuple[Array, Array]:
    """Return log Bayes factors (L,) of all L forms at the null's variances, over all scales, and the likeliest scales.

    A scale s multiplies the usual sizes, the unit of the coefficients here. With eigenvalues k of their information and
    the score g along its eigenvectors, log BF at scale s is ½ Σ [s² g² / (1 + s² k) − log(1 + s² k)].
    """
    scales = regime_of(linear).scales
    s = np.array(list(scales))[:, None, None, None]
    log_shares = np.log(list(scales.values()))[:, None, None]
    gains, likeliest = np.zeros((2, len(dictionary.laws)))
    for place, shapes, index in dictionary.stacks:
        information, vector = linear.information_of_motions(place.twists, shapes)
        forms = [dictionary.laws[i] for i in index[0]]
        # Forms with equally many axes at once: arrays are (scales, shapes, forms, coefficients).
        for axis_count in {len(form.axes) for form in forms}:
            same = [f for f, form in enumerate(forms) if len(form.axes) == axis_count]
            columns = np.array([forms[f].column_indices for f in same])
            sizes = np.array([forms[f].sizes for f in same])
            squared_sizes = sizes[:, :, None] * sizes[:, None, :]
            k, vectors = np.linalg.eigh(information[:, columns[:, :, None], columns[:, None, :]] * squared_sizes)
            g = np.einsum("sfij,sfi->sfj", vectors, vector[:, columns] * sizes)
            square = s**2 * np.maximum(k, 0.0)
            evidence = 0.5 * (s**2 * g**2 / (1 + square) - np.log1p(square)).sum(axis=3) + log_shares
            gains[index[:, same]] = logsumexp(evidence, axis=0)
            likeliest[index[:, same]] = s[evidence.argmax(axis=0), 0, 0, 0]
    return gains, likeliest
