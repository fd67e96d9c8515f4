"""Effects of the scanner: where it reports a point that is at x*. A tracker or its probe has none of them."""

import numpy as np

from stitch.effects.contract import effect
from stitch.effects.specs import number
from stitch.frames import Array
from stitch.measurement.views import ScanView


@effect("sensor", needs=("optics",), s=number("1", typical=1e-3, limit=0.02))
def range_scale(points: Array, view: ScanView, s: float) -> Array:
    """x = (1+s) x*"""
    return points * (1 + s)


@effect("sensor", needs=("optics",), k=number("mm", typical=5.0, limit=100.0))
def range_nonlinearity(points: Array, view: ScanView, k: float) -> Array:
    """x = x* + u·k·(r/r₀−1)², r₀ the standoff"""
    u = view.along(points)
    r = (view.away(points) * u).sum(axis=1)
    return np.asarray(points + u * (k * (r / view.views.standoff - 1) ** 2)[:, None])


@effect("sensor", needs=("surfaces",), b=number("mm", typical=0.1, limit=1.0))
def incidence_bias(points: Array, view: ScanView, b: float) -> Array:
    """x = x* + u·b·(1/cos α − 1)"""
    return points + view.along(points) * (b * (1 / view.cosine - 1))[:, None]


@effect("sensor", needs=("intensity", "surfaces"), k=number("mm", typical=0.1, limit=1.0))
def intensity_bias(points: Array, view: ScanView, k: float) -> Array:
    """x = x* + u·k·(I−Ī)/σ_I"""
    assert view.intensity is not None
    return points + view.along(points) * (k * view.intensity)[:, None]


@effect("sensor", needs=("optics",), k=number("mm", typical=5.0, limit=100.0))
def field_curvature(points: Array, view: ScanView, k: float) -> Array:
    """x = x* + u·k·ρ²"""
    return points + view.along(points) * (k * view.rho2(points))[:, None]


@effect("sensor", needs=("optics",), k1=number("1", typical=0.05, limit=1.0))
def lens_distortion(points: Array, view: ScanView, k1: float) -> Array:
    """(a,b) → (a,b)(1+k₁ρ²), z kept"""
    out = points.copy()
    out[:, :2] *= (1 + k1 * view.rho2(points))[:, None]
    return out


@effect("sensor", needs=("scanner_temperature_c", "optics"), k=number("1/°C", typical=2e-4, limit=5e-3))
def scanner_thermal_scale(points: Array, view: ScanView, k: float) -> Array:
    """x = (1+k(T−T₀)) x*, T = scanner_temperature_c"""
    return points * (1 + k * view.since_first("scanner_temperature_c"))
