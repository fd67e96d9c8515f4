"""Whether an effect holds in halves of the views: found in one, judged in the other, which took no part in choosing it.

The views are halved in the order of time, by the region of their poses, and alternately. In each half the form of the
effect is chosen anew and its sizes are fitted; the other half says how much likelier its numbers are with that effect
than without (partial Bayes factor; Berger & Pericchi 1996, J. Am. Stat. Assoc. 91:109). What imitates something else
among all the views has another size or sign in each half. All of it beside the pose errors that remain with the effect.
"""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Form
from stitch.diagnosis.score import Score
from stitch.diagnosis.thresholds import HALVES_P_VALUE, MIN_STEADINESS
from stitch.frames import Array, Indices
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.statistics.folds import halves_of
from stitch.statistics.least_squares import column_space
from stitch.statistics.tails import chi2_tail

# A prior of this many plausible sizes keeps what a half does not see finite, and moves nothing else.
_FREE = 30.0


@dataclass(frozen=True)
class Halves:
    """What the halves say of an effect that all views together suggest."""

    log_bayes_factor: float  # of what each half predicts of the other, mean over the ways to halve
    p_value: float  # that the sizes in both halves are one and the same, Bonferroni over the ways to halve
    share: float  # smallest share of the effect of all views that a half finds; < 0: the sign changes

    def rejection_reason(self, name: str) -> str | None:
        """What speaks against an effect that explains much, if anything does."""
        if self.log_bayes_factor <= 0:
            return f"{name} found in one half of the views does not help in the other"
        # A clear effect whose form is not quite right differs a little, beyond chance: it is there all the same.
        if self.p_value < HALVES_P_VALUE and self.share < MIN_STEADINESS:
            return f"{name} has another size or sign in each half of the views (p = {self.p_value:.1g})"
        return None


@dataclass(frozen=True)
class _HalfEvidence:
    """What some views say of the parameters (p,) of a form: log likelihood vᵀθ − ½ θᵀIθ."""

    information: Array  # (p, p)
    vector: Array  # (p,)

    def fitted(self, prior: Array) -> tuple[Array, Array]:
        """Mean (p,) and precision (p, p) with a prior (p,) around zero."""
        precision = self.information + np.diag(prior**-2)
        return np.asarray(np.linalg.solve(precision, self.vector), float), precision


def validate_in_halves(scored: Score) -> Halves | None:
    """The best form of a candidate, and all its forms, in halves of the views; None where pose errors have no prior."""
    base = scored.base_model
    if base is None or not isinstance(base.observation, SurfaceObservation):
        return None
    surfaces = base.observation
    gains, p_values, shares = [], [], []
    ways = halves_of(surfaces.capture.T_reference_mount, surfaces.unconstrained.overlaps.gram.lever)
    for way in ways:
        bases = [explained_basis(base, surfaces, other) for other in reversed(way)]
        gains.append(sum(_predictive_factor(scored, base, *pair) for pair in (bases, bases[::-1])))
        a, b = (_half_evidence(base, U, scored.form) for U in bases)
        p_values.append(_size_consistency(a, b, scored.form.sizes))
        shares.append(_least_confirmed_share(a, b, scored.form.sizes))
    return Halves(float(np.mean(gains)), min(1.0, len(ways) * min(p_values)), min(shares))


def explained_basis(base: LinearModel, surfaces: SurfaceObservation, out: Indices) -> Array:
    """(n, r) orthonormal basis of what the model, and the views that are left out moving freely, explain."""
    free = np.eye(surfaces.reduced_poses.reduction.shape[1])[:, (6 * out[:, None] + np.arange(6)).ravel()]
    return column_space(np.hstack([base.white_design, base.whiten(surfaces.reduce(free))]))


def _half_evidence(base: LinearModel, explained: Array, form: Form) -> _HalfEvidence:
    white = base.whiten(form.columns)
    white = white - explained @ (explained.T @ white)
    return _HalfEvidence(white.T @ white, white.T @ base.white_z)


def _predictive_factor(scored: Score, base: LinearModel, chosen_in: Array, tested_in: Array) -> float:
    """Log Bayes factor in one half of the form that the other half prefers, at the sizes found there; before any view
    these are of the scale that all views together prefer."""
    forms = scored.candidate.forms
    seen, priors = (
        [_half_evidence(base, chosen_in, form) for form in forms],
        [scored.scale * form.sizes for form in forms],
    )
    best = max(range(len(forms)), key=lambda i: _log_predictive_gain(seen[i], 0 * priors[i], np.diag(priors[i] ** -2)))
    mean, precision = seen[best].fitted(priors[best])
    return _log_predictive_gain(_half_evidence(base, tested_in, forms[best]), mean, precision)


def _log_predictive_gain(seen: _HalfEvidence, mean: Array, precision: Array) -> float:
    """Log of the likelihood over that of no effect, averaged over a normal prior."""
    scale = 1 / np.sqrt(np.diag(precision))
    units = np.outer(scale, scale)
    P, told, v, m = precision * units, seen.information * units, seen.vector * scale, mean / scale
    pull = v + P @ m
    square = pull @ np.linalg.solve(told + P, pull) - m @ P @ m
    return float(0.5 * square - 0.5 * (np.linalg.slogdet(told + P)[1] - np.linalg.slogdet(P)[1]))


def _size_consistency(a: _HalfEvidence, b: _HalfEvidence, sizes: Array) -> float:
    """p-value of a χ² test of the difference, over the combinations that both halves see."""
    (mean_a, one), (mean_b, other) = (s.fitted(_FREE * sizes) for s in (a, b))
    d = (mean_a - mean_b) / sizes
    covariance = sum(np.linalg.inv(p * np.outer(sizes, sizes)) for p in (one, other))
    values, vectors = np.linalg.eigh(covariance)
    told = values < 0.5 * _FREE**2
    return chi2_tail(float(np.sum((vectors.T @ d)[told] ** 2 / values[told])), int(told.sum())) if told.any() else 1.0


def _least_confirmed_share(a: _HalfEvidence, b: _HalfEvidence, sizes: Array) -> float:
    """Of what both together find, the share that the one finds that finds less, along its direction."""
    told = a.information + b.information
    both = _HalfEvidence(told, a.vector + b.vector).fitted(sizes)[0]
    along = told @ both / max(float(both @ told @ both), 1e-300)
    return min(float(along @ s.fitted(sizes)[0]) for s in (a, b))
