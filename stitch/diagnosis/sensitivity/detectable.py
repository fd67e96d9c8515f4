"""The smallest size of an effect that these views would show: both tests in use pass with 80 % probability.

An effect of true parameters θ shifts the squared length of its whitened columns' projection by λ = θᵀIθ. The
scatter is known to ν degrees of freedom only, and takes its share of what the effect does: the test statistic q
is non-central F, and the log evidence ½ ν log(1 + q/ν) in place of ½ q. For one parameter, known scatter and the
p-value alone this is |θ| = (z_{1−α/2K} + z_{power})/√I.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import brentq

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.form_trial import scales_of
from stitch.diagnosis.score import form_weights
from stitch.diagnosis.thresholds import ALPHA_NAME, LOG_BAYES_FACTOR, POWER
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.tails import f_limit, noncentral_f_tail

# Squares, in units of the scatter, beyond which an effect is of no plausible size: its prior holds back all of it.
_UNDETECTABLE = 1e6
# Of plausible size and nothing else.
SINGLE_SCALE = {1.0: 1.0}


def least_noncentrality(
    white: Array,
    weight: float,
    tests: int,
    degrees_of_freedom: float,
    scales: Mapping[float, float] = SINGLE_SCALE,
) -> float:
    """θᵀIθ that a form needs to be detected.

    Args:
        white: (n, p) whitened columns at their plausible sizes.
        weight: share of the candidate's prior that the form has.
        tests: number of candidates.
        degrees_of_freedom: degrees of freedom of the scatter along the columns.
        scales: of the plausible sizes, with their shares (`amplitude_scales.py`).
    """
    information = np.linalg.eigvalsh(white.T @ white)
    rank = int((information > 1e-2).sum())
    if rank == 0:
        return float("inf")
    by_p = rank * f_limit(ALPHA_NAME * weight / max(tests, 1), rank, max(degrees_of_freedom, 1.0))
    factor, told = LOG_BAYES_FACTOR - float(np.log(weight)), information.clip(0)
    by_factor = [_squares_for(factor - float(np.log(y)), s**2 * told, degrees_of_freedom) for s, y in scales.items()]
    needed = max(by_p, min(by_factor))
    if needed > _UNDETECTABLE:
        return float("inf")

    def missed(shift: float) -> float:
        return noncentral_f_tail(needed / rank, rank, degrees_of_freedom, shift) - POWER

    # From below: the series of the distribution fails for shifts far beyond what is needed.
    enough = needed + 10.0
    while missed(enough) < 0:
        enough *= 1.5
    return float(brentq(missed, 1e-9, enough))


def _squares_for(factor: float, information: Array, degrees_of_freedom: float) -> float:
    """Squared length of the projection at which a form gains that log Bayes factor beside what it could have been.

    Args:
        information: (p,) of its parameters per unit of their prior; where it is little, the prior keeps back a share.
    """
    kept = float(np.sum(information**2 / (1 + information)) / max(float(information.sum()), 1e-300))
    charged = (factor + 0.5 * float(np.log1p(information).sum())) / max(kept, 1e-3)
    return degrees_of_freedom * float(np.expm1(min(2 * charged / degrees_of_freedom, 500.0)))


@dataclass(frozen=True)
class FormInformation:
    """What the views show of one form of a candidate."""

    names: tuple[str, ...]  # of its free parameters (p,)
    white: Array  # (n, p) whitened columns per unit
    sizes: Array  # (p,) plausible ones
    weight: float  # share of the candidate's prior
    degrees_of_freedom: float  # of the scatter along the columns
    scales: Mapping[float, float] = field(
        default_factory=lambda: SINGLE_SCALE
    )  # of the plausible sizes, with their shares


def detectable_sizes(linear: LinearModel, candidate: Candidate, tests: int) -> dict[str, float]:
    """Smallest detectable size of every free parameter of a candidate among so many."""
    linear = linear.without([candidate.name])
    shown = []
    for form, weight in zip(candidate.forms, form_weights(candidate), strict=True):
        white = linear.residual(form.columns)
        known = linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white))
        names = tuple(p.name for p in form.free)
        shown.append(FormInformation(names, white, form.sizes, float(weight), known, scales_of(linear)))
    return detectable_sizes_by_form(shown, tests)


def detectable_sizes_by_form(forms: Sequence[FormInformation], tests: int) -> dict[str, float]:
    """Per parameter the size that is detectable when it alone is not zero, by the form that shows it best."""
    found: dict[str, dict[tuple[str, ...], list[float]]] = {}
    for form in forms:
        white, known = form.white * form.sizes, form.degrees_of_freedom
        least = least_noncentrality(white, form.weight, tests, known, form.scales)
        for name, length in zip(form.names, np.linalg.norm(form.white, axis=0), strict=True):
            size = float(np.sqrt(least) / length) if length > 0 else float("inf")
            found.setdefault(name, {}).setdefault(form.names, []).append(size)
    # Forms of the same parameters differ in when something happened: any of them could be true.
    return {name: min(float(np.median(own)) for own in by_form.values()) for name, by_form in found.items()}
