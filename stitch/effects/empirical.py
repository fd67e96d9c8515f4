"""The empirical tier: shapes without a cause. They only say on what the missing effect depends.

Fourier terms of a joint, polynomials of time or a covariate, a low-order field map. They compete
with the physical effects: where one of them explains the views far better than anything known, something
unknown is at work.
"""

from collections.abc import Callable
from itertools import combinations_with_replacement
from math import prod

import numpy as np

from stitch.effects.contract import Effect, Spec, number, twist
from stitch.numerics.frames import Array
from stitch.session.measurement import ScanView, Views

# A distortion of the scanner's field by no law.
FIELD = "distortion_over_field"
_HARMONICS = (1, 2, 3, 4)
# Where a scanner sees, a = x/z and b = y/z reach so far, and the range r from its standoff r₀, d = r/r₀ − 1.
_REACH = {"a": 0.3, "b": 0.3, "d": 0.1}
# Monomials of these three, of the first and the second degree.
_MONOMIALS = [factors for degree in (1, 2) for factors in combinations_with_replacement(_REACH, degree)]


def empirical_effects(views: Views) -> list[Effect]:
    """Return every empirical effect that these views can carry."""
    effects = []
    for joint in range(views.joints.shape[1]):
        # A joint that hardly turns shows no period.
        if np.ptp(views.joints[:, joint]) > np.radians(15.0):
            effects += [_harmonic(joint, order) for order in _HARMONICS]
    covariates = ({"time_s": views.time} if views.has("time") else {}) | views.covariates
    for name, values in covariates.items():
        if np.ptp(values) > 0 and len(np.unique(values)) > 2:
            x = 2 * (values - values.min()) / np.ptp(values) - 1
            # Polynomials (V,) of the covariate over ±1.
            polynomials = {1: x, 2: 1.5 * x**2 - 0.5}
            effects += [_bias(name, order, shape) for order, shape in polynomials.items()]
            effects += [_mount(name, order, shape) for order, shape in polynomials.items()]
    return [*effects, _field()]


def _effect(
    group: str, name: str, place: str, function: Callable[..., Array], needs: tuple[str, ...] = (), **specs: Spec
) -> Effect:
    return Effect(name, place, specs, function=function, needs=needs, prefers=(), tier="empirical", group=group)


def _harmonic(joint: int, order: int) -> Effect:
    def fourier(joints: Array, views: Views, A: float, B: float) -> Array:
        true = joints.copy()
        true[:, joint] += A * np.sin(order * views.joints[:, joint]) + B * np.cos(order * views.joints[:, joint])
        return true

    fourier.__doc__ = f"joint {joint + 1}: A sin {order}q + B cos {order}q"
    name = f"fourier_{order}_of_j{joint + 1}"
    size = number("rad", 4e-4, 0.01)
    return _effect(f"j{joint + 1}_deg", name, "robot", fourier, A=size, B=size)


def _bias(name: str, order: int, shape: Array) -> Effect:
    def bias(points: Array, view: ScanView, k: float) -> Array:
        return points + view.along(points) * (k * shape[view.index])

    bias.__doc__ = f"along the ray by k·P{order}({name})"
    return _effect(name, f"bias_{order}_of_{name}", "sensor", bias, k=number("mm", 0.1, 5.0))


def _mount(name: str, order: int, shape: Array) -> Effect:
    def follow(views: Views, xi: Array) -> Array:
        return np.outer(shape, xi)

    follow.__doc__ = f"M·exp(ξ·P{order}({name}))"
    return _effect(name, f"mount_{order}_of_{name}", "mount", follow, xi=twist("", 4e-4, 0.15))


def _field() -> Effect:
    """Return points that move in all three directions by a function of where they are seen; 0.1 mm at the edge is
    usual."""
    terms = {f"c{axis}_{''.join(factors)}": (axis, factors) for axis in range(3) for factors in _MONOMIALS}

    def distort(points: Array, view: ScanView, **c: float) -> Array:
        """x = x* + c·(polynomials of the second degree in x/z, y/z and r/r₀ − 1)"""
        x, y, z = view.away(points).T
        ray = np.sqrt(x * x + y * y + z * z)
        at = {"a": x / z, "b": y / z, "d": ray / view.views.standoff - 1}
        moved = points.copy()
        for name in (name for name in terms if c[name]):
            axis, factors = terms[name]
            moved[:, axis] += c[name] * prod(at[factor] for factor in factors)
        return moved

    sizes = {name: 0.1 / prod(_REACH[factor] for factor in factors) for name, (_, factors) in terms.items()}
    specs = {name: number("mm", size, 50 * size) for name, size in sizes.items()}
    return _effect("the scanner's field", FIELD, "sensor", distort, ("optics",), **specs)
