"""On what the unexplained part of the poses depends: every covariate, with the shape as binned means."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.selection.ranking import Ranked, rank_all
from stitch.frames import Array
from stitch.measurement.views import Views
from stitch.observations.linear_model import LinearModel

_BINS = 5


@dataclass(frozen=True)
class Dependence:
    """One covariate; bins, mean and sigma show the shape along the direction that follows it most."""

    covariate: str
    score: float  # share of the views' unexplained scatter that follows it, 0 … 1
    p_value: float  # family-wise over all covariates and shapes
    bins: Array  # (B,) middle of each bin
    mean: Array  # (B,) displacement at the part, length_unit
    sigma: Array  # (B,)
    shape: str  # the empirical form that fits best, in words


def dependences(linear: LinearModel, empirical: Sequence[Ranked]) -> list[Dependence]:
    """The best empirical form of every covariate, clearest first.

    Over scatter alone: what follows a covariate may also be an error of the poses that repeats; this says where it is.
    """
    if linear.pose_errors is not None:
        linear = linear.scatter_only
        empirical = rank_all(linear, [r.score.candidate for r in empirical])[1]
    views = linear.measurement.views
    best: dict[str, Ranked] = {}
    for r in empirical:
        group = r.score.candidate.effect.group
        if group not in best or r.score.log_bayes_factor > best[group].score.log_bayes_factor:
            best[group] = r
    found = [
        _dependence(linear, r, course)
        for name, r in best.items()
        if (course := covariate_values(views, name)) is not None
    ]
    return sorted(found, key=lambda d: (d.p_value, -d.score))


def covariate_values(views: Views, name: str) -> Array | None:
    """(V,) values of a covariate, a joint angle in degrees, the time, or the order of the views for an event."""
    if name == "time_s":
        return views.time
    if name == "an event":
        return np.arange(views.count, dtype=float)
    if joint := re.fullmatch(r"j(\d+)_deg", name):
        return np.asarray(np.degrees(views.joints[:, int(joint[1]) - 1]))
    return views.covariates.get(name)


def _dependence(linear: LinearModel, ranked: Ranked, course: Array) -> Dependence:
    scored = ranked.score
    white = linear.residual(scored.form.columns)
    basis, s, _ = np.linalg.svd(white, full_matrices=False)
    basis = basis[:, s > 1e-9 * max(float(s[0]), 1e-300)]
    share = float(np.sum((basis.T @ linear.white_residual) ** 2) / max(float(np.sum(linear.white_residual**2)), 1e-300))
    displacement = linear.view_displacements()
    # The direction in which the displacements follow the fitted shape most.
    fitted = linear.observation.part_displacements(scored.form.columns @ scored.values)
    direction = np.linalg.svd(fitted, full_matrices=False)[2][0]
    y = displacement @ direction
    if np.dot(y, fitted @ direction) < 0:
        y = -y
    centres, mean, sigma = bin_means(course, y)
    effect = scored.candidate.effect
    return Dependence(
        covariate=effect.group if effect.group != "an event" else "view order",
        score=share,
        p_value=ranked.adjusted,
        bins=centres,
        mean=mean,
        sigma=sigma,
        shape=effect.formula,
    )


def bin_means(x: Array, y: Array, bins: int = _BINS) -> tuple[Array, Array, Array]:
    """Middle, mean and standard error of y in bins of x with equal counts; views are the samples."""
    order = np.argsort(x, kind="stable")
    parts = [p for p in np.array_split(order, min(bins, max(len(x) // 2, 1))) if len(p)]
    spread = float(np.std(y, ddof=1)) if len(y) > 1 else 0.0
    middle = np.array([x[p].mean() for p in parts])
    mean = np.array([y[p].mean() for p in parts])
    sigma = np.array([(np.std(y[p], ddof=1) if len(p) > 2 else spread) / np.sqrt(len(p)) for p in parts])
    return middle, mean, sigma
