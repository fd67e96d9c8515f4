"""How well the mean of a bin is known: views are the samples, because all points of a view share its pose error."""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Mask
from stitch.statistics.tails import f_tail


@dataclass(frozen=True)
class BinStatistics:
    """Of B bins; lengths in length_unit, counts of rows and of views that make a sample."""

    mean: Array  # (B,) signed
    mean_sigma: Array  # (B,) standard error of the mean where nothing is to be found; NaN where it is unknown
    rms: Array  # (B,)
    rms_sigma: Array
    count: Array
    views: Array
    p_value: Array  # (B,) that chance makes this one mean so large; NaN where that is unknown


def view_statistics(n: Array, s: Array, q: Array, enough: float = 1.0, directions: int = 1) -> BinStatistics:
    """Means of bins with what the scatter between views says of them.

    A view off by its pose error ε is off in all its rows, so a mean over views with shares w of the rows has the
    variance σ² Σ w². All rows together have the mean zero: what a bin is off the others are off the other way, which
    leaves the factor 1 − (share of the bin). Where all rows of a view lie in one bin and views have equal counts,
    mean over sigma is Student's t of the views in the bin against the other views.

    Args:
        n, s, q: (B, V) counts, sums and sums of squares of rows by bin and view.
        enough: rows of a view in a bin that make a sample.
        directions: dimensions among which the direction of the mean was chosen for being the clearest. The
            p-value is that of the clearest (Scheffé 1953, Biometrika 40, 87).
    """
    use, total, seen = n >= enough, n.sum(axis=1), np.maximum(n.sum(axis=0), 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        dilution = ((n / total[:, None]) ** 2).sum(axis=1)
        mean, rms = s.sum(axis=1) / total, np.sqrt(q.sum(axis=1) / total)
        variance, freedom = _view_scatter(s / n, s.sum(axis=0) / seen, use)
        of_rms, _ = _view_scatter(np.sqrt(q / n), np.sqrt(q.sum(axis=0) / seen), use)
        sigma = np.sqrt(variance * dilution * (1 - total / total.sum()))
        z = np.abs(mean) / sigma
    tails = np.array([_mean_p_value(float(x), float(v), directions) for x, v in zip(z, freedom, strict=True)])
    return BinStatistics(mean, sigma, rms, np.sqrt(of_rms * dilution), total, use.sum(axis=1), tails)


def _view_scatter(values: Array, whole: Array, use: Mask) -> tuple[Array, Array]:
    """Variance between views (B,) and its degrees of freedom (B,).

    A bin of one or two views does not know it. Pooled with the views of the bin about their mean are the views that
    do not lie in it, with the values of all their rows, about theirs.

    Args:
        values: (B, V) of the views in the bins.
        whole: (V,) of all rows of the views.
        use: (B, V) where a view makes a sample.
    """
    others = use.any(axis=0) & ~use
    square, freedom = np.zeros(len(use)), np.zeros(len(use))
    for chosen, of in ((use, values), (others, np.broadcast_to(whole, use.shape))):
        count = chosen.sum(axis=1)
        middle = np.where(chosen, of, 0.0).sum(axis=1) / np.maximum(count, 1)
        square += np.where(chosen, (of - middle[:, None]) ** 2, 0.0).sum(axis=1)
        freedom += np.maximum(count - 1, 0)
    known = (freedom > 0) & use.any(axis=1)
    return np.where(known, square / np.maximum(freedom, 1), np.nan), freedom


def _mean_p_value(z: float, freedom: float, directions: int) -> float:
    """P of a mean so many sigmas from zero by chance, in the worst direction; Student's t for one direction."""
    left = freedom - directions + 1
    if not np.isfinite(z):
        return float("nan")
    return f_tail(z**2 * left / (directions * freedom), directions, left) if left > 0 else 1.0
