"""Laws of the scanner: where it reports a point x that is at x*."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data_synth.moment import Moment, Plan
from data_synth.scanner import Cloud

Array = NDArray[np.float64]
Parameters = dict[str, float]
# Mean and standard deviation of the intensity over a session.
_USUAL, _SPREAD = 0.5, 0.18


def draw(name: str, size: float) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    """One number with its sign as it usually is."""
    return lambda amplitude, plan, rng: {name: size * amplitude}


def range_scale(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """x = (1 + s) x*."""
    return replace(cloud, points=cloud.points * (1 + p["s"]))


def scanner_thermal_scale(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """x = (1 + k (T − T₀)) x*."""
    warmer = moment.covariates["scanner_temperature_c"] - moment.start["scanner_temperature_c"]
    return replace(cloud, points=cloud.points * (1 + p["k"] * warmer))


def range_nonlinearity(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """Along the ray by k (r/r₀ − 1)²."""
    r = np.linalg.norm(cloud.points, axis=1)
    return _along(cloud, p["k"] * (r / moment.standoff - 1) ** 2)


def incidence_bias(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """Along the ray by b (1/cos α − 1)."""
    return _along(cloud, p["b"] * (1 / cloud.incidence - 1))


def intensity_bias(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """Along the ray by k times the brightness, counted from what scanners of this kind see on average."""
    return _along(cloud, p["k"] * (cloud.intensity - _USUAL) / _SPREAD)


def field_curvature(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """Along the ray by k ρ²."""
    return _along(cloud, p["k"] * _rho2(cloud.points))


def lens_distortion(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """(a, b) → (a, b)(1 + k₁ρ²), z kept."""
    points = cloud.points.copy()
    points[:, :2] *= 1 + p["k1"] * _rho2(cloud.points)[:, None]
    return replace(cloud, points=points)


def covariate_bias(p: Parameters, moment: Moment, cloud: Cloud) -> Cloud:
    """Along the ray by k per percent of humidity: no textbook has it."""
    moister = moment.covariates["humidity_percent"] - moment.start["humidity_percent"]
    return _along(cloud, np.full(len(cloud.points), p["k"] * moister))


def _along(cloud: Cloud, shift: Array) -> Cloud:
    unit = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    return replace(cloud, points=cloud.points + unit * shift[:, None])


def _rho2(points: Array) -> Array:
    return np.asarray((points[:, :2] ** 2).sum(axis=1) / points[:, 2] ** 2)
