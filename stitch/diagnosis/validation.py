"""What a candidate would leave on views that took no part in finding it, in the linear approximation.

`cross_validate` leaves out folds of neighbours and single views. `extrapolate` leaves out ends of joints' ranges: a
wrong effect may imitate among the measured poses what is not known, and err beyond them; left-out neighbours in time or
pose lie among the others and do not show it. The ends judge together. Where more than one thing is missing, a right
effect takes away what hid another at some end and makes that one a little worse; an imitation helps at many ends and is
far off at others. So a further end must be likely to become better, the ends being samples of it.

`objection_in_halves` finds an effect in one half of the views and judges it in the other. The views are halved in the
order of time, by the region of their poses, and alternately. In each half the form of the effect is chosen anew and its
sizes are fitted; the other half says how much likelier its numbers are with that effect than without (partial Bayes
factor; Berger & Pericchi 1996, J. Am. Stat. Assoc. 91:109). What imitates something else has another size or sign in
each half. The pose errors that remain with the effect stand beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Form
from stitch.diagnosis.score import Score, score
from stitch.numerics.distributions import chi2_tail, normal_tail
from stitch.numerics.folds import JointEnd, halves_of
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import mean_square_share
from stitch.numerics.parameter_selection import log_evidence
from stitch.numerics.units import listed
from stitch.observations.linear_model import CoefficientPrior, LinearModel, LinearTrial, PointSums


@dataclass(frozen=True)
class CrossValidation:
    """Mean square of what remains over that of the present model."""

    inside: float  # fitted on all views
    heldout: float  # each fold judged by a fit without it
    poses: float  # the same for the poses, in units of their scatter: of clouds without the sensor's noise
    poses_sigma: float  # spread of `poses` over folds; each view is in two of them: some 0.6 standard errors
    steadiness: float  # smallest share of the amplitude that remains when one view is left out; < 0: sign changes
    heldout_sigma: float = 0.0  # standard error of `heldout`, folds as samples
    # Per fold what it keeps with the candidate when it is left out, of its points and of its poses.
    fold_squares: tuple[tuple[float, ...], ...] = ()

    def as_good_as(self, other: "CrossValidation") -> bool:
        """Return whether points and poses of views left out are predicted as well as by another candidate, within the
        uncertainty of the ratio."""
        return all(share <= 1 + sigma for share, sigma in self._shares_of(other))

    def better_than(self, other: "CrossValidation") -> bool:
        """Return whether another candidate predicts both points and poses of views left out worse, beyond the
        uncertainty."""
        return all(share < 1 - sigma for share, sigma in self._shares_of(other))

    def _shares_of(self, other: "CrossValidation") -> list[tuple[float, float]]:
        """Return what is left of what another candidate leaves, with its uncertainty: of points and of poses."""
        pairs = zip(self.fold_squares, other.fold_squares, strict=True)
        return [mean_square_share(np.array(squares), np.array(of_other)) for squares, of_other in pairs]

    @property
    def helps(self) -> bool:
        """True if views left out are predicted better, by more than folds differ."""
        return self.poses <= 1 - self.poses_sigma

    def fit_rejection_reason(self, name: str, share: float, *, zero: bool) -> str | None:
        """Return why a fitted effect is dropped, by views left out; None where it stays.

        It is dropped if the error of their points rose beyond its uncertainty. Where that error neither rose nor fell,
        their poses decide, and whether the effect differs from zero.

        Args:
            name: of the effect.
            share: of the mean square error on views left out that the fit with the effect leaves.
            zero: no parameter of the fitted effect differs from zero.
        """
        left = f"it leaves {share:.2f} ± {self.heldout_sigma:.2f} of the mean square error on views left out"
        if share > 1 + self.heldout_sigma:
            return f"with {name} the error on views left out rose: {left}"
        if share >= 1 - self.heldout_sigma and (zero or not self.helps):
            return f"{name} does not help on views left out beyond its uncertainty: {left}"
        return None

    def rejection_reason(self, name: str) -> str | None:
        """Return why an effect does not belong in a model of many poses; None where it lowers the error enough.

        Many poses show even effects that hardly help, so a least gain is asked for.
        """
        if self.helps and self.poses <= limits.MAX_REMAINING_SHARE:
            return None
        share = f"{self.poses:.3f} ± {self.poses_sigma:.3f}"
        return f"{name} hardly helps on views left out: it leaves {share} of the mean square error"


def cross_validate(linear: LinearModel, scored: Score) -> CrossValidation:
    """Return what remains with the best form of a candidate in the model, in the fit and on views left out.

    All is linear. The errors of points are those of a fit in which poses scatter independently, as in `add`. Those of
    poses, which decide whether the effect helps, have all other pose errors as random effects.
    """
    independent = linear.restricted(())
    base = scored.base_model or linear
    trial, point_squares, pose_squares = _squares_by_fold(base, scored)
    independent_trial, independent_pose_squares = trial, pose_squares
    if base is not independent:
        again = score(independent, scored.candidate)
        independent_trial, point_squares, independent_pose_squares = _squares_by_fold(independent, again)
    heldout, heldout_sigma = mean_square_share(*point_squares)
    poses, poses_sigma = mean_square_share(*pose_squares)
    present = independent.baseline_trial
    square = independent_trial.squares(independent_trial.solve()).sum()
    return CrossValidation(
        inside=float(square / present.squares(present.solve()).sum()),
        heldout=heldout,
        poses=poses,
        poses_sigma=poses_sigma,
        steadiness=_steadiness(base, trial, scored.form.response),
        heldout_sigma=heldout_sigma,
        fold_squares=tuple(tuple(map(float, folds[0])) for folds in (point_squares, independent_pose_squares)),
    )


def group_helps(share: float, sigma: float) -> bool:
    """Return whether a group leaves less on views left out, by more than folds differ."""
    return share <= 1 - sigma


def group_share(linear: LinearModel, group: Sequence[Score]) -> tuple[float, float]:
    """Return the mean square error of left-out poses with a group of effects in the model, over that without them.

    Returns:
        The ratio, and its standard error with folds as samples. Effects of points count by what they do to poses.
    """
    trial, priors = _with_and_without(linear, group)
    folds = linear.observation.folds
    scatter = [[trial.scatter(fold, x) for x in trial.solve_each(priors, fold)] for fold in folds]
    return mean_square_share(*np.array(scatter).reshape(-1, 2).T)


def _squares_by_fold(linear: LinearModel, scored: Score) -> tuple[LinearTrial, Array, Array]:
    """Return the fit with a candidate, and what G folds of views leave when each is predicted by a fit without it.

    Returns:
        The fit; sums of squares (2, G) of the folds' points, with the candidate and without; and (2, G) of their poses.
    """
    points = scored.candidate.points
    sums = None if points is None else points.select(scored.form.keep)
    trial, priors = _with_and_without(linear, [scored], sums)
    squares, scatter = [], []
    for fold in linear.observation.folds:
        affected = linear.observation.affected_squares(fold)
        without = trial.solve_each(priors, fold)
        squares.append([trial.squares(x, affected).sum() for x in without])
        scatter.append([trial.scatter(fold, x) for x in without])
    return trial, np.array(squares).reshape(-1, 2).T, np.array(scatter).reshape(-1, 2).T


def _with_and_without(
    linear: LinearModel, group: Sequence[Score], sums: PointSums | None = None
) -> tuple[LinearTrial, list[CoefficientPrior]]:
    """Return a fit with candidates in the model, and the priors of one with them and of one without.

    If a fold carries most of an effect, the rest hardly shows it. So effects are believed to be about as large as with
    all views, √(value² + sigma²), of either sign. Nothing is believed of the coefficients of the model as it is.

    Args:
        sums: over the points that the candidates move; None: they move none, or count by what they do to poses.
    """
    precision = np.zeros(linear.design.shape[1])
    with_effects = [precision]
    for scored in group:
        size = np.hypot(scored.values, np.nan_to_num(scored.sigmas))
        with_effects.append(1 / np.maximum(size, limits.NEGLIGIBLE_SIZE * scored.form.sizes) ** 2)
    trial = linear.trial(np.hstack([linear.design, *(scored.form.response for scored in group)]), sums)
    priors = [CoefficientPrior(p, np.zeros(len(p))) for p in (np.concatenate(with_effects), precision)]
    return trial, priors


def _steadiness(linear: LinearModel, trial: LinearTrial, response: Array) -> float:
    """Return the smallest share of an effect that remains in a fit without one view; 0 for an effect of zero.

    With the whitened columns X and values θ, and θ_v without view v, it is min over v of (Xθ)ᵀ X θ_v / |Xθ|². An effect
    that a single view carries has a share near zero.

    Args:
        trial: fit with the effect, its parameters last.
        response: (·, k) of the observation to them.
    """
    whole = trial.solve()
    size = response.shape[1]
    theta = whole[-size:]
    if not theta.any():
        return 0.0
    white = linear.residual(linear.reduce(response))
    along = white.T @ (white @ theta)
    strength = max(float(along @ theta), 1e-300)
    return min(float(along @ trial.solve(np.array([v]))[-size:]) / strength for v in trial.influential_views(whole))


@dataclass(frozen=True)
class Extrapolation:
    """What a candidate leaves at the ends of joints' ranges, each predicted from all other views."""

    share: float  # mean square distance over that of the present model, all ends together
    sigma: float  # standard error of `share`, ends as samples
    worst: JointEnd
    worst_share: float  # the same at the end that is made worse most clearly
    worst_sigma: float  # standard error of `worst_share`, views as samples
    likely: float  # probability that a further end is predicted better

    @property
    def helps(self) -> bool:
        """True if the ends together are predicted better by more than a standard error, and a further one probably."""
        return self.share <= 1 - self.sigma and self.likely >= limits.LIKELY_TO_HELP

    @property
    def errs_somewhere(self) -> bool:
        """True if an end is predicted worse by more than a standard error."""
        return self.worst_share > 1 + self.worst_sigma

    @property
    def unseen(self) -> bool:
        """True if the ends together are as well predicted with the effect as without."""
        return limits.MAX_REMAINING_SHARE <= self.share <= 1 / limits.MAX_REMAINING_SHARE

    def rejection_reason(self, name: str) -> str:
        """Say what speaks against an effect that explains much."""
        return (
            f"{name} helps among the measured poses, but not beyond. At ends of joint ranges left out it leaves "
            f"{self.share:.2f} ± {self.sigma:.2f} of the mean square error (worst, {self.worst.name}: "
            f"{self.worst_share:.2f} ± {self.worst_sigma:.2f}). A further end would improve with a probability of "
            f"{self.likely:.0%}"
        )


def untested_ends_reason(names: Sequence[str]) -> str:
    """Say what speaks against effects that the ends cannot judge."""
    return (
        f"{listed(names, 'and')} help among the measured poses, but not beyond. Ends of "
        f"joint ranges left out change by less than {1 - limits.MAX_REMAINING_SHARE:.0%} together"
    )


def extrapolate(linear: LinearModel, scored: Score) -> Extrapolation | None:
    """Return how well a candidate predicts views at the ends of joint ranges, each end from all other views.

    The views at each end are left out in turn, and predicted by a fit with the candidate and by one without it. Shares
    are the sum of squares with it over that without: below 1 it helps. None where the views are too few to leave an end
    out.
    """
    ends = linear.observation.joint_ends(linear.measurement.views.joints)
    if not ends:
        return None
    trial = linear.trial(np.hstack([linear.design, scored.form.response]))
    with_effect, without = _end_priors(linear, scored, trial)
    # Of each end, and for each of the two fits, the squares (views of the end,) that are left.
    squares = [
        [trial.squares(x, end.views) for x in trial.solve_each([with_effect, without], end.views)] for end in ends
    ]
    shares = [mean_square_share(*of_end) for of_end in squares]
    worst = max(range(len(ends)), key=lambda k: (shares[k][0] - 1) / max(shares[k][1], 1e-300))
    share, sigma = mean_square_share(*np.array([[of_fit.sum() for of_fit in of_end] for of_end in squares]).T)
    # The ends are samples of log shares: a further one is better with the probability that its log is below zero.
    logs = np.log([max(share, 1e-300) for share, _ in shares])
    spread = np.std(logs, ddof=1) * np.sqrt(1 + 1 / len(logs)) if len(logs) > 1 else 0.0
    likely = normal_tail(float(np.mean(logs) / max(spread, 1e-12)))
    worst_share, worst_sigma = shares[worst]
    return Extrapolation(share, sigma, ends[worst], worst_share, worst_sigma, likely)


def _end_priors(linear: LinearModel, scored: Score, trial: LinearTrial) -> tuple[CoefficientPrior, CoefficientPrior]:
    """Return the priors of a fit with a candidate, and of one without, that predict an end of a joint's range.

    Plausible sizes s with the tails of Student's t: what the other views hardly see would otherwise be anything, and
    the end would judge that instead of the effect. The normal prior that stands for t with ν degrees of freedom at an
    estimate θ has the variance (ν·s² + θ²)/(ν + 1) (Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84:881).
    """
    a = linear.design.shape[1]
    sizes = np.append(linear.sizes, scored.sizes)
    mean = np.append(-linear.values, np.zeros(len(sizes) - len(linear.values)))
    wide = CoefficientPrior(1 / (limits.END_PRIOR_SIZES * sizes) ** 2, mean)
    estimate = np.where(np.isfinite(sizes), trial.solve_each([wide])[0][-len(mean) :] - mean, 0.0)
    freedom = limits.END_PRIOR_FREEDOM
    precision = (freedom + 1) / (freedom * sizes**2 + estimate**2)
    return CoefficientPrior(precision, mean), CoefficientPrior(precision[:a], mean[:a])


@dataclass(frozen=True)
class _HalfEvidence:
    """What some views say of the parameters (p,) of a form: log likelihood vᵀθ − ½ θᵀIθ."""

    information: Array  # (p, p)
    vector: Array  # (p,)

    def fitted(self, prior: Array) -> tuple[Array, Array]:
        """Return mean (p,) and precision (p, p) with a prior (p,) around zero."""
        precision = self.information + np.diag(prior**-2)
        mean = np.asarray(np.linalg.solve(precision, self.vector), float)
        return mean, precision

    def log_evidence(self, precision: Array, mean: Array | None = None) -> float:
        """Return the log of the likelihood over that of no effect, averaged over a normal prior."""
        return float(log_evidence(self.information, self.vector, precision, mean))


def objection_in_halves(scored: Score) -> str | None:
    """Return the reason, as text, to reject a candidate by halves of the views; None where there is none.

    It has to help in one half as the other half finds it, on average over several ways to halve, and both halves have
    to find the same size of its best form. None also where pose errors have no prior, and for labelled points.
    """
    base = scored.base_model
    if base is None or base.observation.numbers_per_view is not None:
        return None
    gains, p_values, shares = [], [], []
    ways = halves_of(base.observation.capture.T_base_flange, base.observation.reach)
    for first_views, second_views in ways:
        # What either half shows is what the views of the other do not explain.
        first, second = base.explained_without(second_views), base.explained_without(first_views)
        gains.append(_predictive_factor(scored, base, first, second) + _predictive_factor(scored, base, second, first))
        halves = _half_evidence(base, first, scored.form), _half_evidence(base, second, scored.form)
        p_values.append(_size_consistency(*halves, scored.form.sizes))
        shares.append(_smaller_share(*halves, scored.form.sizes))
    if np.mean(gains) <= 0:
        return f"{scored.name}, found in one half of the views, does not help in the other"
    # Bonferroni over the ways to halve. A clear effect whose form is not quite right differs a little, beyond chance:
    # it is there all the same.
    p_value = min(1.0, len(ways) * min(p_values))
    if p_value < limits.HALVES_P_VALUE and min(shares) < limits.MIN_STEADINESS:
        return f"{scored.name} has another size or sign in each half of the views (p = {p_value:.1g})"
    return None


def _half_evidence(base: LinearModel, explained: Array, form: Form) -> _HalfEvidence:
    """Return what a half of the views says of a form.

    Args:
        explained: (n, k) orthonormal, what is not this half's in the whitened observations.
    """
    white = base.whiten(form.columns)
    white = white - explained @ (explained.T @ white)
    return _HalfEvidence(white.T @ white, white.T @ base.white_z)


def _predictive_factor(scored: Score, base: LinearModel, chosen_in: Array, tested_in: Array) -> float:
    """Return the log Bayes factor in one half of the form that the other half prefers, at the sizes found there.

    Before any view these sizes are of the scale that all views together prefer. Both halves as in `_half_evidence`.
    """
    forms = scored.candidate.forms
    evidence = [_half_evidence(base, chosen_in, form) for form in forms]
    priors = [scored.scale * form.sizes for form in forms]
    best = max(range(len(forms)), key=lambda i: evidence[i].log_evidence(np.diag(priors[i] ** -2)))
    mean, precision = evidence[best].fitted(priors[best])
    return _half_evidence(base, tested_in, forms[best]).log_evidence(precision, mean)


def _smaller_share(first: _HalfEvidence, second: _HalfEvidence, sizes: Array) -> float:
    """Return the smaller share that a half finds of what both find together: bᵀ I θ / bᵀ I b of both's values b."""
    information = first.information + second.information
    both = _HalfEvidence(information, first.vector + second.vector).fitted(sizes)[0]
    along = information @ both / max(float(both @ information @ both), 1e-300)
    return min(float(along @ half.fitted(sizes)[0]) for half in (first, second))


def _size_consistency(first: _HalfEvidence, second: _HalfEvidence, sizes: Array) -> float:
    """Return the p-value of a χ² test of the difference, over the combinations that both halves see."""
    fits = [half.fitted(limits.FREE_SIZES * sizes) for half in (first, second)]
    difference = (fits[0][0] - fits[1][0]) / sizes
    covariance = sum(np.linalg.inv(precision * np.outer(sizes, sizes)) for _, precision in fits)
    values, vectors = np.linalg.eigh(covariance)
    seen = values < 0.5 * limits.FREE_SIZES**2
    if not seen.any():
        return 1.0
    return chi2_tail(float(np.sum((vectors.T @ difference)[seen] ** 2 / values[seen])), int(seen.sum()))
