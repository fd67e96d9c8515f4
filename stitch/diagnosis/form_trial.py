"""One form of a candidate beside a model: what it gains, and its free amplitudes.

How large an effect is if it is there nobody knows before: its parameters are of plausible size, or all alike three
times, a third or a tenth of it, each as likely, or grossly wrong. With plausible sizes alone, six numbers of which the
views show a tenth of that were charged for all that they could have been, and effects beyond chance (p = 1e-9) counted
for nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate, Form
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.amplitude_scales import ANY_SIZE, PLAUSIBLE, log_mixture
from stitch.statistics.tails import f_tail
from stitch.statistics.variance_components import at_variances, fit_variances

# A prior of this many plausible sizes is as good as none, and keeps the unseen finite.
_FREE = 30.0
# Among more numbers than this the variances are the same under both priors, and a fit takes half a second.
LONG = 250


def scales_of(linear: LinearModel) -> dict[float, float]:
    """Of the plausible sizes of an effect's parameters, with the share of belief in each: labelled points show sizes
    whatever their prior, beside a prior of pose errors any may be the true one."""
    return ANY_SIZE if linear.pose_errors is not None else PLAUSIBLE


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
    mixed, G, wide = linear.mixed, linear.in_blocks(form.columns), _FREE * form.sizes
    integrated = fit_variances(mixed, G, scale * form.sizes, start=start)
    scales = scales_of(linear)
    if mixed.size > LONG and linear.pose_errors is None:
        scales = {scale: scales[scale]}
    found = {scale: integrated.deviance}
    if len(scales) > 1:
        # What the form explains is no scatter: beside less of it another scale may be the likeliest.
        found = {s: at_variances(mixed, integrated.variances, G, s * form.sizes).deviance for s in scales}
        best = min(found, key=lambda s: found[s])
        if best != scale:
            scale, integrated = best, fit_variances(mixed, G, best * form.sizes, start=integrated.variances)
            found[best] = integrated.deviance
    if mixed.size > LONG or linear.pose_errors is not None:
        free = at_variances(mixed, integrated.variances, G, wide)
    else:
        free = fit_variances(mixed, G, wide, integrated.variances)
    a = mixed.A.shape[2]
    theta, covariance = free.mean[a:], free.covariance[a:, a:]
    rank, square = _wald(theta, covariance, form.sizes)
    p = f_tail(square / max(rank, 1), max(rank, 1), _scatter_degrees(linear, form, max(mixed.size - a - rank, 1)))
    gained = 0.5 * linear.null.deviance + log_mixture(-0.5 * np.array(list(found.values())), scales)
    return FormTrial(gained, p, theta, covariance, integrated.variances, scale)


def _scatter_degrees(linear: LinearModel, form: Form, rest: int) -> float:
    """Degrees of freedom to which the scatter along the columns of a form is known: fewer than numbers are left, where
    views tell several components apart; among very many numbers as many."""
    if linear.pose_errors is None and linear.mixed.size > LONG:
        return rest
    return max(linear.satterthwaite.degrees_of_freedom(linear.in_blocks(linear.residual(form.columns))), 1.0)


def residual_form_columns(linear: LinearModel, candidate: Candidate) -> Iterator[Array]:
    """(n, p) per form what its columns say beside the model; those of one joint are among those of all."""
    whole = candidate.forms[0]
    white = linear.residual(whole.columns)
    for form in candidate.forms:
        if form.term is not whole.term:
            whole, white = form, linear.residual(form.columns)
        yield white[:, form.keep[whole.keep]]


def gain_at_null(linear: LinearModel, form: Form, white: Array) -> Gain:
    """At the null's variances: cheap, and an upper hand for what cannot help."""
    white = white * form.sizes
    told, b = white.T @ white, white.T @ linear.white_residual
    shares = scales_of(linear)
    scales = np.array(list(shares))
    information = np.eye(len(b)) + scales[:, None, None] ** 2 * told
    squares = scales**2 * (np.linalg.solve(information, np.tile(b[:, None], (len(scales), 1, 1)))[..., 0] @ b)
    found = 0.5 * (squares - np.linalg.slogdet(information)[1])
    return Gain(log_mixture(found, shares), float(scales[(found + np.log(list(shares.values()))).argmax()]))


def _wald(theta: Array, covariance: Array, sizes: Array) -> tuple[int, float]:
    """Rank and θᵀC⁻¹θ over the combinations of which the views say more than the wide prior does."""
    values, vectors = np.linalg.eigh(covariance / np.outer(sizes, sizes))
    keep = values < 0.5 * _FREE**2
    projected = vectors[:, keep].T @ (theta / sizes)
    return int(keep.sum()), float(np.sum(projected**2 / np.maximum(values[keep], 1e-300)))
