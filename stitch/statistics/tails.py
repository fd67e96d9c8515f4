"""Tails of distributions, and where they begin: `scipy.stats` has them too, and takes a second to load.

All are upper tails: P(X > x), and the x beyond which the share p lies.
"""

from scipy import special


def chi2_tail(x: float, degrees: float) -> float:
    """P(χ²_degrees > x)."""
    return float(special.chdtrc(degrees, x))


def chi2_limit(p: float, degrees: float) -> float:
    """The χ² that a share p exceeds."""
    return float(special.chdtri(degrees, p))


def normal_tail(x: float) -> float:
    """P(N(0, 1) > x)."""
    return float(special.ndtr(-x))


def binomial_tail(x: int, count: int, share: float) -> float:
    """P(X > x) of so many trials with a chance each."""
    return float(special.bdtrc(x, count, share))


def f_tail(x: float, numerator: float, denominator: float) -> float:
    """P(F > x) with degrees of freedom of numerator and denominator."""
    return float(special.fdtrc(numerator, denominator, x))


def f_limit(p: float, numerator: float, denominator: float) -> float:
    """The F that a share p exceeds, exact for tiny p too: by the beta distribution of d₂/(d₂ + d₁ F)."""
    share = special.betaincinv(denominator / 2, numerator / 2, p)
    return float(denominator * (1 - share) / (numerator * share))


def noncentral_f_tail(x: float, numerator: float, denominator: float, shift: float) -> float:
    """P(F > x) of the noncentral F distribution with noncentrality `shift`."""
    return float(1 - special.ncfdtr(numerator, denominator, shift, x))
