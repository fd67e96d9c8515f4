"""How far the poses of the arm may scatter before something else than repeatability must be there."""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.thresholds import ALPHA_UNKNOWN, IMPLAUSIBLE
from stitch.measurement.session import Session
from stitch.observations.linear_model import LinearModel
from stitch.statistics.satterthwaite import satterthwaite
from stitch.statistics.tails import chi2_limit
from stitch.statistics.variance_components import at_variances
from stitch.units import METRES


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


def scatter_limit(session: Session) -> ScatterLimit:
    """What the session states under [robot] repeatability, else the largest that is usual for an arm fit for use."""
    stated, (rotation, translation) = session.repeatability, IMPLAUSIBLE
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
    linear = linear.scatter_only
    for i, (allowed, stated) in enumerate(
        ((limit.rotation, limit.rotation_stated), (limit.translation, limit.translation_stated))
    ):
        chance = 1.0
        if stated:
            known = _degrees_of_freedom(linear, i, allowed)
            chance = float(np.sqrt(chi2_limit(ALPHA_UNKNOWN / 2, known) / known))
        if np.sqrt(linear.null.variances[i]) > chance * allowed:
            return True
    return False


def _degrees_of_freedom(linear: LinearModel, component: int, sigma: float) -> float:
    """To which the variance of a component would be known if its standard deviation were that."""
    variances = linear.null.variances.copy()
    variances[component] = sigma**2
    known = satterthwaite(linear.mixed, at_variances(linear.mixed, variances))
    return 2 / max(float(known.spread[component, component]), 1e-9)
