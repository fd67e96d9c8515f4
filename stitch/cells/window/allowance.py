"""Stock on a casting: how far the scan stands off the CAD, even or slowly varying. Positive is outside: stock on it."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.polynomial import legendre

from stitch.cells.window.cad import CadSurface
from stitch.errors import InputError
from stitch.frames import Array

FREE, VARYING = "free", "varying"
# Below this share told from a motion, an error of form enters more than threefold; that is said.
FAINT = 0.1
# Products of Legendre polynomials over the part's box up to this degree: what varies slowly.
_DEGREE = 3
_ORDERS = tuple(order for order in product(range(_DEGREE + 1), repeat=3) if 0 < sum(order) <= _DEGREE)


@dataclass(frozen=True)
class AllowancePrior:
    """What is believed of the allowance before the fit; length_unit of the CAD."""

    known: float = 0.0
    free: bool = False
    varying: bool = False  # implies free

    @property
    def columns(self) -> int:
        """How many numbers are to be found."""
        return self.free + self.varying * len(_ORDERS)


@dataclass(frozen=True)
class Allowance:
    """Stock between CAD and scan, positive outside."""

    value: float  # mean over the fit's points
    sigma: float  # of that mean; 0 where it was stated
    lowest: float  # over the fit's points; of an even allowance the value
    highest: float
    sigma_field: float  # largest 1-sigma at any of those points
    prior: AllowancePrior
    separable_share: float  # share of it that no motion of the part imitates, 0 to 1; 1 where it was stated
    coefficients: Array  # (K,) of the columns
    cad: CadSurface

    def at(self, points: Array) -> Array:
        """(N,) allowance at points (N, 3), part frame."""
        return self.prior.known + allowance_columns(points, self.cad, self.prior) @ self.coefficients


def read_allowance(text: str | None) -> AllowancePrior:
    """What `--allowance` asks for: `free`, `varying` or a number.

    Raises:
        InputError: neither.
    """
    if text is None:
        return AllowancePrior()
    if text in (FREE, VARYING):
        return AllowancePrior(free=True, varying=text == VARYING)
    try:
        known = float(text)
    except ValueError:
        known = float("nan")
    if not np.isfinite(known):
        raise InputError(
            f"--allowance is {text!r}; write free (to find an even one), varying (one that changes slowly over the "
            "part), or the stock in the CAD's unit, as 0.3"
        )
    return AllowancePrior(known=known)


def allowance_columns(points: Array, cad: CadSurface, prior: AllowancePrior) -> Array:
    """(N, K) allowance at points (N, 3), part frame, per unit of each number that is to be found."""
    if not prior.free:
        return np.zeros((len(points), 0))
    ones = np.ones((len(points), 1))
    if not prior.varying:
        return ones
    half = np.maximum(np.ptp(np.asarray(cad.mesh.bounds), axis=0) / 2, 1e-9 * cad.size)
    scaled = np.clip((points - cad.centre) / half, -1.1, 1.1)
    # Of unit mean square over the box each.
    x, y, z = (legendre.legvander(axis, _DEGREE) * np.sqrt(2 * np.arange(_DEGREE + 1) + 1) for axis in scaled.T)
    return np.column_stack([ones, *(x[:, i] * y[:, j] * z[:, k] for i, j, k in _ORDERS)])


def allowance_sentence(allowance: Allowance, length_unit: str | None) -> str:
    """Its size with sigma, and what the sign means; None: nobody says in which unit."""
    unit = f" {length_unit}" if length_unit else ""
    if not allowance.prior.free:
        return f"Allowance {allowance.value:+.4g}{unit} as stated (plus: stock outside the CAD)."
    size = f"Allowance {allowance.value:+.4f} ± {allowance.sigma:.4f}{unit} (1 σ; plus: stock outside the CAD)"
    if allowance.prior.varying:
        size += (
            f", from {allowance.lowest:+.4f} to {allowance.highest:+.4f}{unit} over the scan, each ± "
            f"{allowance.sigma_field:.4f}{unit} at most"
        )
    if allowance.separable_share < FAINT:
        size += f"; only {allowance.separable_share:.1%} of it is told from a motion of the part, so that errors of form weigh in it"
    return size + "."
