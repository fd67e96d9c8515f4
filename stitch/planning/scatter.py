"""How much poses and scanner are expected to scatter: as stated, as a run found, or as is usual."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.observations.linear_model import LinearModel
from stitch.statistics.variance_posterior import mean_variances
from stitch.statistics.variance_prior import NOISE, USUAL_NOISE_FACTOR
from stitch.units import METRES, angle_text, length_text

# Scatter of a good arm's flange, sigma per axis (rad, mm), and an area scanner's noise along the ray (mm): where nobody
# states them. EN ISO 9283 repeatabilities of 0.05 to 0.1 mm are sigmas of 14 to 28 µm.
USUAL_ROTATION, USUAL_TRANSLATION, USUAL_NOISE = 20e-6, 0.02, 0.02


@dataclass(frozen=True)
class Scatter:
    """Standard deviations that are expected; length_unit, rad."""

    rotation: float  # of the flange, per axis
    translation: float
    noise: float  # of the scanner, along the ray
    noise_factor: float  # variance of what overlaps say over that of white noise
    errors: dict[str, float]  # variances of pose errors that repeat, by component; of none that is not in here
    assumed: tuple[str, ...] = ()  # what nobody stated, in words

    def variances(self, names: Sequence[str]) -> Array:
        """(3 + c,) of rotation, translation, noise, and pose errors of these names."""
        white = (self.rotation**2, self.translation**2, self.noise_factor)
        return np.array([*white, *(max(self.errors.get(name, 0.0), 1e-30) for name in names)])


def stated_scatter(session: Session) -> Scatter:
    """As session.toml states it, or as is usual; beside it the arm does nothing wrong."""
    unit, stated, assumed = session.length_unit, session.repeatability, list[str]()
    mm = METRES["mm"] / METRES[unit]
    rotation, translation, noise = stated.sigma_rotation, stated.sigma_translation, session.scanner.noise
    if translation is None:
        translation = USUAL_TRANSLATION * mm
        assumed.append(f"the flange scatters by {length_text(translation, unit)} per axis (robot.repeatability)")
    if rotation is None:
        rotation = USUAL_ROTATION
        assumed.append(f"the flange turns by {angle_text(rotation)} per axis (robot.repeatability)")
    if noise is None:
        noise = USUAL_NOISE * mm
        assumed.append(f"the scanner's noise is {length_text(noise, unit)} (scanner.noise)")
    return Scatter(rotation, translation, noise, USUAL_NOISE_FACTOR, {}, tuple(assumed))


@dataclass(frozen=True)
class FittedScatter:
    """How large the errors of some views are found to be."""

    fitted: Scatter  # at the maximum of the likelihood, which diagnosis takes
    believed: Scatter  # posterior mean, which the covariance of a hand-eye takes


def mean_scatter(linear: LinearModel, noise: float, variances: Sequence[tuple[Array, Array]]) -> FittedScatter:
    """The mean of fitted and believed variances (c,) of some fits of a linear model.

    Args:
        noise: of the scans.
    """
    both = []
    for found in np.mean(variances, axis=0):
        rotation, translation = np.sqrt(found[:NOISE])
        errors = dict(zip(linear.component_names, map(float, found[NOISE + 1 :]), strict=True))
        both.append(Scatter(float(rotation), float(translation), noise, float(found[NOISE]), errors))
    return FittedScatter(*both)


def scatter_of_run(linear: LinearModel, noise: float) -> FittedScatter:
    """As the views of a run show it."""
    return mean_scatter(linear, noise, [(linear.null.variances, mean_variances(linear.mixed, linear.null))])
