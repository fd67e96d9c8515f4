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
    group: str,
    name: str,
    formula: str,
    per_unit: Callable[[Array, ScanView, Array], Array],
    needs: tuple[str, ...] = (),
    **specs: Spec,
) -> Effect:
    """Return an effect of the sensor whose P parameters act in proportion.

    Args:
        per_unit: how far (P, N) a unit of each moves points (N, 3) of a view along an axis (3,) (`Effect.per_unit`).
    """

    def distort(points: Array, view: ScanView, **values: float) -> Array:
        """Return points (N, 3) of a view, scanner frame, moved by all parameters."""
        amounts = [values[name] for name in specs]
        return points + np.stack([amounts @ per_unit(points, view, axis) for axis in np.eye(3)], axis=1)

    distort.__doc__ = formula
    return Effect(
        name, "sensor", specs, distort, needs=needs, prefers=(), tier="empirical", group=group, per_unit=per_unit
    )


def _bias(name: str, order: int, shape: Array) -> Effect:
    """Return the effect that moves all points of view v along their rays by k·shape[v], k in length_unit.

    Args:
        name: of the covariate.
        order: of the Legendre polynomial P.
        shape: (V,) P of the covariate scaled to ±1, at each view.
    """

    def along_ray(points: Array, view: ScanView, direction: Array) -> Array:
        """Return how far (1, N) a bias of 1 moves points (N, 3) of a view along a direction, scanner frame."""
        away = view.away(points)
        along = np.einsum("ij,ij->i", away, np.broadcast_to(direction, away.shape))
        return shape[view.index] * (along / np.sqrt(np.einsum("ij,ij->i", away, away)))[None]

    formula = f"along the ray by k·P{order}({name})"
    return _effect(name, f"bias_{order}_of_{name}", formula, along_ray, k=number("mm", 0.1, 5.0))


def _field() -> Effect:
    """Return the effect that moves points by polynomials of where they are in the scanner's field, in x, y and z.

    Each of three coordinates has a coefficient, in length_unit, for each monomial of degree 1 and 2 in a = x/z, b = y/z
    and d = r/r₀ − 1. Typical sizes of the coefficients move a point at the edge of the field by 0.1 mm.
    """
    names = ["".join(factors) for factors in _MONOMIALS]
    sizes = [0.1 / prod(_REACH[factor] for factor in factors) for factors in _MONOMIALS]

    def monomials(points: Array, view: ScanView, direction: Array) -> Array:
        """Return how far (27, N) a unit of each coefficient moves points (N, 3) of a view along a direction."""
        x, y, z = view.away(points).T
        ray = np.sqrt(x * x + y * y + z * z)
        at = {"a": x / z, "b": y / z, "d": ray / view.views.standoff - 1}
        products = np.array([prod(at[factor] for factor in factors) for factors in _MONOMIALS])
        return (np.atleast_2d(direction).T[:, None] * products).reshape(-1, len(points))

    formula = "x = x* + c·(polynomials of the second degree in x/z, y/z and r/r₀ − 1)"
    specs = {
        f"c{axis}_{name}": number("mm", size, 50 * size)
        for axis in range(3)
        for name, size in zip(names, sizes, strict=True)
    }
    return _effect("the scanner's field", FIELD, formula, monomials, ("optics",), **specs)
