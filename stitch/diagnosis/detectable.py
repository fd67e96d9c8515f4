"""The smallest size of an effect that these views would show: both tests in use pass with 80 % probability.

An effect of true parameters θ shifts the squared length of its whitened columns' projection by θᵀIθ: the test
statistic is non-central χ² of as many degrees of freedom as the form has parameters. For one parameter and the
F test alone this is |θ| = (z_{1−α/2K} + z_{power})/√I.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq
from scipy.stats import f as f_distribution
from scipy.stats import ncx2

from stitch.diagnosis.thresholds import ALPHA_NAME, GAIN, POWER
from stitch.frames import Array


def least_noncentrality(white: Array, weight: float, tests: int, rest: int) -> float:
    """θᵀIθ that a form needs to be detected.

    Args:
        white: (n, p) whitened columns at their plausible sizes.
        weight: share of the candidate's prior that the form has.
        tests: number of candidates.
        rest: degrees of freedom that are left for the scatter.
    """
    information = np.linalg.eigvalsh(white.T @ white)
    rank = int((information > 1e-2).sum())
    if rank == 0:
        return float("inf")
    by_p = rank * float(f_distribution.isf(ALPHA_NAME * weight / max(tests, 1), rank, max(rest, 1)))
    by_evidence = 2 * (GAIN - np.log(weight)) + float(np.log1p(information.clip(0)).sum())
    needed = max(by_p, by_evidence)
    return float(brentq(lambda size: ncx2.sf(needed, rank, size) - POWER, 1e-9, 4 * needed + 50))


def smallest_sizes(
    forms: Sequence[tuple[tuple[str, ...], Array, Array, float]], tests: int, rest: int
) -> dict[str, float]:
    """Per parameter the size that is detectable when it alone is not zero, by the form that shows it best.

    Args:
        forms: names of the parameters (p,), their whitened columns (n, p) per unit, plausible sizes (p,), weight.
    """
    found: dict[str, dict[tuple[str, ...], list[float]]] = {}
    for names, white, sizes, weight in forms:
        least = least_noncentrality(white * sizes, weight, tests, rest)
        for name, length in zip(names, np.linalg.norm(white, axis=0), strict=True):
            size = float(np.sqrt(least) / length) if length > 0 else float("inf")
            found.setdefault(name, {}).setdefault(names, []).append(size)
    # Forms of the same parameters differ in when something happened: any of them could be true.
    return {name: min(float(np.median(own)) for own in by_form.values()) for name, by_form in found.items()}
