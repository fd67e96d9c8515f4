"""Where in the range a joint errs that follows a law without a name, or when, or under which load: its course, with
bands."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.diagnosis.unknown.law_covariates import LawCovariate, covariates_of_law
from stitch.effects.contract import EFFECTS
from stitch.frames import Array
from stitch.model.term import term_of

_PLACES = 25  # over the range of a joint
# Courses that carry less of what the joint does by its law say nothing about where.
_WORTH = 0.1


@dataclass(frozen=True)
class JointCurve:
    """How far a joint is off along one number that it follows, the rest where these views had it; beside its mean over
    the views."""

    joint: int  # that errs, counted from 1
    covariate: str  # j3_deg; j3_move_deg, how far it came; time_s or view; j3_torque_nm, or j3_torque_nm_per_kg
    share: float  # of what the law does over the views, 0 … 1
    at: Array  # (G,) of the covariate, in the unit that its name ends with
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad
    view_values: Array  # (V,) the covariate in the views
    may_follow: tuple[str, ...] = ()  # what these views do not tell apart, the likeliest first

    @property
    def extremes(self) -> tuple[int, int]:
        """Places at which the error is smallest and largest."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


def joint_curves(laws: Sequence[JointLaw]) -> tuple[JointCurve, ...]:
    """Partial dependence (Friedman 2001, Ann. Stat. 29:1189) of each law on all that it follows, largest share first.

    The law is a random function; what the views say of it is its mean and covariance given their numbers, with the
    hand-eye free and at the fitted sizes of all errors (kriging; Rasmussen & Williams 2006, eq. 2.41).
    """
    found = []
    for law in laws:
        alike = law.errors.kernel_of(law.process)
        whole = float(_law_given_views(law, alike, alike)[0].var())
        found += [_curve_along(law, along, whole) for along in covariates_of_law(law)]
    return tuple(sorted((c for c in found if c.share > _WORTH), key=lambda c: -c.share))


def _curve_along(law: JointLaw, along: LawCovariate, whole: float) -> JointCurve:
    """`whole` is the variance over the views of all that the law does, rad²."""
    at, views = along.view_values, len(along.view_values)
    grid = np.linspace(at.min(), at.max(), _PLACES)
    places = np.append(grid, at)
    # Of the function averaged over where all else stood.
    rest = np.broadcast_to(along.remaining_kernel, (views, views))
    with_views = rest.mean(axis=0) * along.kernel(places, at)
    with_places = rest.mean() * along.kernel(places, places)
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_PLACES, views])
    mean, covariance = _law_given_views(law, centred @ with_views, centred @ with_places @ centred.T)
    return JointCurve(
        joint=law.joint,
        covariate=along.covariate,
        share=min(float(mean[_PLACES:].var() / max(whole, 1e-300)), 1.0),
        at=along.unit * grid,
        error=mean[:_PLACES],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_PLACES], 0)),
        view_values=along.unit * at,
        may_follow=law.may_follow,
    )


def _law_given_views(law: JointLaw, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Mean (G,) and covariance (G, G) of places of the law, rad, from what the views show.

    Args:
        with_views: (G, V) covariance of the places with the law at the views, per unit of its variance.
        prior: (G, G) of the places among each other.
    """
    linear, k = law.model, law.joint - 1
    variance, usual = linear.null.variances[-1], float(term_of(linear.measurement, EFFECTS["joint_offset"]).typical[k])
    columns = law.errors.columns[:, law.process].reshape(-1, 6, 1)
    seen = linear.residual(linear.reduce((columns * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * seen.T @ linear.white_residual
    return usual * mean, usual**2 * (variance * prior - variance**2 * seen.T @ seen)
