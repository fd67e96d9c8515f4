"""The empirical tier: shapes without a cause that no motion of whole views makes.

Errors along the rays that follow a covariate, a low-order field map. They compete with the physical effects, as do the
laws of motions of whole views (`diagnosis/systematic_laws.py`).
"""

from collections.abc import Callable
from itertools import combinations_with_replacement
from math import prod

import numpy as np

from stitch.effects.contract import Effect, Spec, number
from stitch.numerics.frames import Array
from stitch.session.measurement import ScanView, Views

# A distortion of the scanner's field by no law.
FIELD = "distortion_over_field"
# Where a scanner sees, a = x/z and b = y/z reach so far, and the range r from its standoff r₀, d = r/r₀ − 1.
_REACH = {"a": 0.3, "b": 0.3, "d": 0.1}
# Monomials of these three, of the first and the second degree.
_MONOMIALS = [factors for degree in (1, 2) for factors in combinations_with_replacement(_REACH, degree)]


def empirical_effects(views: Views) -> list[Effect]:
    """Return every empirical effect for these views: biases that follow a covariate or time, and the scanner's field.

    Of each covariate with more than two values the Legendre polynomials of order 1 and 2, over its range.
    """
    effects = []
    covariates = ({"time_s": views.time} if views.has("time") else {}) | views.covariates
    for name, values in covariates.items():
        if np.ptp(values) > 0 and len(np.unique(values)) > 2:
            x = 2 * (values - values.min()) / np.ptp(values) - 1
            # Polynomials (V,) of the covariate over ±1.
            polynomials = {1: x, 2: 1.5 * x**2 - 0.5}
            effects += [_bias(name, order, shape) for order, shape in polynomials.items()]
    return [*effects, _field()]


def _effect(
    group: str, name: str, place: str, function: Callable[..., Array], needs: tuple[str, ...] = (), **specs: Spec
) -> Effect:
    """Return an effect of the empirical tier; `group` is what it follows, for people."""
    return Effect(name, place, specs, function=function, needs=needs, prefers=(), tier="empirical", group=group)


def _bias(name: str, order: int, shape: Array) -> Effect:
    """Return the effect that moves all points of view v along their rays by k·shape[v], k in length_unit.

    Args:
        name: of the covariate.
        order: of the Legendre polynomial P.
        shape: (V,) P of the covariate scaled to ±1, at each view.
    """

    def bias(points: Array, view: ScanView, k: float) -> Array:
        """Return points (N, 3) of a view, scanner frame, with its bias along the rays."""
        return points + view.along(points) * (k * shape[view.index])

    bias.__doc__ = f"along the ray by k·P{order}({name})"
    return _effect(name, f"bias_{order}_of_{name}", "sensor", bias, k=number("mm", 0.1, 5.0))


def _field() -> Effect:
    """Return the effect that moves points by polynomials of where they are in the scanner's field, in x, y and z.

    Each of three coordinates has a coefficient, in length_unit, for each monomial of degree 1 and 2 in a = x/z, b = y/z
    and d = r/r₀ − 1. Typical sizes of the coefficients move a point at the edge of the field by 0.1 mm.
    """
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
