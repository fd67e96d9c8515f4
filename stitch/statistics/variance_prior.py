"""What is believed of variance components before anything was seen: scatter, noise, and what may well be absent."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import betainc, betaln, expit

from stitch.frames import Array, Mask

# The component that is sensor noise; all others are scatter and errors of the arm. A gamma(2, 0) prior on their σ
# keeps the maximum off the boundary at zero, where every sigma after it would be too small, by about one standard
# error (Chung et al. 2013, Psychometrika 78:685).
NOISE = 2
# Of further components λ/s² of a scale s is a priori beta-prime(a/2, 1/2), with the tails of a half-Cauchy (Armagan,
# Clyde & Dunson 2011, NIPS 24). What may well be absent piles up at zero; with a = 1 it is the half-Cauchy of Gelman
# 2006, Bayesian Analysis 1:515, for what is there on every arm in some size. The density counts per log σ.
MAY_BE_ABSENT, ALWAYS_PRESENT = 0.1, 1.0
# The factor on the sensor's noise is 1 for white noise and grows with its correlation: a few, seldom hundreds.
# A weak log-normal prior decides where the views hardly can between sensor noise and scatter of the arm.
USUAL_NOISE_FACTOR, FACTOR_SPREAD = 2.0, 1.5


@dataclass(frozen=True)
class FurtherPrior:
    """What is believed of components beside scatter and noise."""

    scales: Array  # (f,) that their σ usually has
    shapes: Array  # (f,) of the density near zero: MAY_BE_ABSENT or THERE
    common_factor: Mask  # (f,) those that are large or small together

    def select(self, keep: Mask) -> Self:
        """Of some components alone (f,)."""
        return replace(self, scales=self.scales[keep], shapes=self.shapes[keep], common_factor=self.common_factor[keep])

    def scaled(self, factor: float) -> Self:
        """Where all are usually so many times as large."""
        return replace(self, scales=factor * self.scales)


def log_prior(log_variances: Array, further: FurtherPrior | None) -> tuple[float, Array]:
    """−2 log prior of the log variances (c,), and its slope."""
    off = (log_variances[NOISE] - np.log(USUAL_NOISE_FACTOR)) / FACTOR_SPREAD
    value, slope = -float(log_variances[:NOISE].sum()) + off**2, -np.ones(len(log_variances))
    slope[NOISE] = 2 * off / FACTOR_SPREAD
    if further is not None:
        over, a = np.exp(log_variances[NOISE + 1 :]) / further.scales**2, further.shapes
        value += float(((1 + a) * np.log1p(over) - a * log_variances[NOISE + 1 :]).sum())
        slope[NOISE + 1 :] = (1 + a) * over / (1 + over) - a
    return value, slope


def log_density(component: int, log_variances: Array, further: FurtherPrior | None) -> Array:
    """(g,) of one component at log variances (g,) in equal steps, up to a constant; its first stands for all below."""
    if component == NOISE:
        return np.asarray(-0.5 * ((log_variances - np.log(USUAL_NOISE_FACTOR)) / FACTOR_SPREAD) ** 2)
    if component < NOISE or further is None:
        return 0.5 * log_variances
    scale, a = (float(own[component - NOISE - 1]) for own in (further.scales, further.shapes))
    over = log_variances - 2 * np.log(scale)
    out = 0.5 * a * over - 0.5 * (1 + a) * np.log1p(np.exp(over))
    # Half a step of its own, and all that is below it: a beta distribution of x/(1 + x).
    below = betaln(0.5 * a, 0.5) + np.log(betainc(0.5 * a, 0.5, expit(over[0])))
    out[0] = np.logaddexp(out[0] - np.log(2), below - np.log(log_variances[1] - log_variances[0]))
    return np.asarray(out)


def prior_information(variances: Array, further: FurtherPrior | None) -> Array:
    """(c,) what the prior alone knows of the log variances: half the curvature of `log_prior`."""
    out = np.zeros(len(variances))
    out[NOISE] = 1 / FACTOR_SPREAD**2
    if further is not None:
        over = variances[NOISE + 1 :] / further.scales**2
        out[NOISE + 1 :] = 0.5 * (1 + further.shapes) * over / (1 + over) ** 2
    return out


def usual_variances(z: Array, components: Array) -> Array:
    """(c,) where a search begins: what was seen, mostly scatter and noise.

    Args:
        z: (B, m) numbers that were seen.
        components: (c, B, m, m) of their covariance.
    """
    traces = np.einsum("cbii->c", components)
    spread = float((z**2).sum()) or 1e-24
    # What there is beside scatter and noise begins small: it is there only where the numbers ask for it.
    shares = np.where(np.arange(len(traces)) < NOISE, 0.25, 0.05)
    guess = np.asarray(shares * spread / np.maximum(traces, 1e-300))
    guess[NOISE] = 1.0
    return guess
