"""The uncertainty that planned views would give the hand-eye, and where it would come from."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.model.hand_eye_uncertainty import COVERAGE_FACTOR
from stitch.observations.error_model import WHITE_COMPONENTS
from stitch.observations.surfaces.hand_eye_solution import weak_prior
from stitch.observations.surfaces.scanner_field import ALARM_SHARE
from stitch.observations.surfaces.shown_errors import USUAL_SHARE
from stitch.planning.expected_model import ExpectedModel, SimulatedViews
from stitch.statistics.least_squares import generalised_fit
from stitch.statistics.variance_prior import NOISE


@dataclass(frozen=True)
class ExpectedHandEye:
    """What a fit of the hand-eye would state of itself."""

    covariance: Array  # (6, 6) of the right perturbation, scanner frame, rotation first
    shares: dict[str, float]  # of its variance, by source; they add up to 1
    middle: Array  # (3,) scanner frame, of what it sees or of a feature

    @property
    def U(self) -> float:
        """Expanded uncertainty (k = 2) of the place of `middle`, length_unit: one number for all six."""
        return displacement(self.covariance, self.middle)


def displacement(covariance: Array, middle: Array) -> float:
    """U (k = 2) of a point (3,) of the scanner's frame under the hand-eye's covariance (6, 6), all directions."""
    lever = np.hstack([-frames.skew(middle), np.eye(3)])
    return float(COVERAGE_FACTOR * np.sqrt(np.trace(lever @ covariance @ lever.T)))


def expected_hand_eye(linear: ExpectedModel, simulated: SimulatedViews, middle: Array | None = None) -> ExpectedHandEye:
    """As `fit_hand_eye` would have it: least squares under the scatter alone, the covariance under all errors.

    Args:
        middle: (3,) scanner frame, whose displacement U counts; None: the middle of what the views see.
    """
    capture, T_mount = simulated.measurement.capture, linear.model.T_mount
    sizes, components = linear.null.variances, linear.mixed.components[:, 0]
    errors = () if linear.pose_errors is None else linear.pose_errors.names
    names = (*WHITE_COMPONENTS, *errors)
    columns = linear.reduce(linear.design)
    prior = weak_prior([capture], [simulated.unconstrained], T_mount, linear.sizes[6:])
    scatter = np.einsum("c,cij->ij", sizes[: NOISE + 1], components[: NOISE + 1])
    weighed = generalised_fit(scatter, columns, prior)
    sources = {
        name: size * weighed.gain @ C @ weighed.gain.T for name, size, C in zip(names, sizes, components, strict=True)
    }
    if linear.mixed.fixed is not None:
        field = (USUAL_SHARE / ALARM_SHARE) ** 2 * linear.mixed.fixed[0]
        sources["scanner field"] = weighed.gain @ field @ weighed.gain.T
    sources["unseen"] = weighed.covariance @ prior @ weighed.covariance
    covariance = np.sum(list(sources.values()), axis=0)
    if middle is None:
        middle = np.mean([points.mean(axis=0) for points in capture.point_sets], axis=0)
    return ExpectedHandEye(covariance[:6, :6], _shares_of(sources, covariance), middle)


def _shares_of(sources: dict[str, Array], covariance: Array) -> dict[str, float]:
    """Mean share of every source in the variance of the hand-eye, over its directions; they add up to 1.

    The hand-eye is what the first six rows of all these covariances are of.
    """
    scale = np.sqrt(np.diag(covariance)[:6])
    unit = np.linalg.inv(covariance[:6, :6] / scale / scale[:, None])
    return {name: float(np.sum(unit * (own[:6, :6] / scale / scale[:, None]))) / 6 for name, own in sources.items()}
