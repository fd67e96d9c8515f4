"""When something began to move, and how: by the shape that takes most out of what is left of a parameter.

Generalised likelihood ratio over the session of onset and the shape (Basseville & Nikiforov 1993, Detection of Abrupt
Changes, 2.4): a step (the mount was knocked), a line in time (something wears), or a response to a channel that began
(a joint that has become soft follows the temperature).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from stitch.numerics.frames import Array

# Sessions that are looked back; before them the onset is not sought.
LONGEST = 600
# Sessions for each number that an undisturbed parameter is told by.
_FEW = 3
# Sessions after an onset from which a line, or a response to a channel, can be told from a step.
_TREND = 6
# Share of a column that must be left beside the columns of the undisturbed parameter.
_MIN_COLUMN_SHARE = 1e-6


@dataclass(frozen=True)
class Onset:
    """The likeliest beginning of a change."""

    session: int  # of those given, the first that has moved
    shape: str  # step | drift | name of a channel
    size: float  # of the step; per day; per unit of the channel
    sigma: float
    p_value: float  # of the best of all that were tried, Bonferroni


def find_onset(values: Array, sigmas: Array, days: Array, covariates: Array, channels: Sequence[str]) -> Onset | None:
    """The onset in n sessions; None where there are too few to say.

    Args:
        values: (n,) with their sigmas (n,), as stated.
        days: (n,) times.
        covariates: (n, c) what the undisturbed parameter follows; the first belong to `channels`.
    """
    shown = np.flatnonzero(np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0))[-LONGEST:]
    n = len(shown)
    # What a few sessions follow cannot be told.
    follows = covariates[shown] if n >= _FEW * (1 + covariates.shape[1]) else np.zeros((n, 0))
    base, _ = np.linalg.qr(_varying_columns(np.column_stack([np.ones(n), follows])) / sigmas[shown, None])
    if n < base.shape[1] + 2:
        return None
    y: Array = _without_base(base, (values[shown] / sigmas[shown])[:, None])[:, 0]
    best = (0.0, "", 0, 0.0)
    tried = 0
    square = float(y @ y)
    for shape, columns in _change_shapes(days[shown], covariates[shown], channels).items():
        white = columns / sigmas[shown, None]
        left = _without_base(base, white)
        length = np.sum(left**2, axis=0)
        is_visible = length > _MIN_COLUMN_SHARE * np.maximum(np.sum(white**2, axis=0), 1e-300)
        gains = np.where(is_visible, (y @ left) ** 2 / np.where(is_visible, length, 1.0), 0.0)
        tried += int(is_visible.sum())
        at = int(np.argmax(gains))
        if gains[at] > best[0]:
            best = (float(gains[at]), shape, at, float(y @ left[:, at] / length[at]))
    gain, shape, at, size = best
    freedom = n - base.shape[1] - 1
    if not shape or freedom < 1:
        return None
    t = np.sqrt(gain / max((square - gain) / freedom, 1e-12 * square))
    p_value = min(1.0, tried * 2 * float(stdtr(freedom, -t)))
    return Onset(int(shown[at]), shape, size, abs(size) / float(t), p_value)


def _change_shapes(days: Array, covariates: Array, channels: Sequence[str]) -> dict[str, Array]:
    """(n, n) columns by shape: in column k what begins at session k, per day and per unit of the channel."""
    after = np.tri(len(days)).astype(float)
    columns = {"step": after}
    long = after.copy()
    long[:, -_TREND:] = 0.0
    columns["drift"] = long * (days[:, None] - days[None, :])
    for c, name in enumerate(channels):
        columns[name] = long * (covariates[:, c, None] - covariates[None, :, c])
    return columns


def _varying_columns(columns: Array) -> Array:
    """Without columns that hardly change: they would be taken for the constant."""
    spread = np.ptp(columns, axis=0)
    return columns[:, (spread > 1e-9 * np.abs(columns).max(axis=0)) | (np.arange(columns.shape[1]) == 0)]


def _without_base(base: Array, columns: Array) -> Array:
    return columns - base @ (base.T @ columns)
