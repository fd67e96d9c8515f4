"""What a parameter may follow where nothing moves: the channels, how fast temperatures change, and the hour.

Arms and mounts lag behind the air by hours. A temperature and its lag together span every delayed response, whatever
the weather does to the swing of the day; the hour spans what nobody has a thermometer for.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from stitch.frames import Array

DAY_SECONDS = 86400.0
# Every channel costs sessions until its share is known.
_MOST_CHANNELS = 4
# Time over which a temperature is averaged for its lag, s; after so many of them an older session counts nothing.
_LAG, _GONE = 3 * 3600.0, 16.0
LOOK_BACK = _LAG * _GONE
# How far, in sigmas, a parameter may follow a degree, or the hour; of other channels nothing is believed.
_BELIEVED = 10.0
_HOURS = 2


def chosen_channels(covariates: Iterable[str]) -> list[str]:
    """Covariates that parameters may follow: temperatures first, four at most."""
    return sorted(covariates, key=lambda name: ("temperature" not in name, name))[:_MOST_CHANNELS]


def regressor_prior_sigmas(channels: Sequence[str]) -> Array:
    """(c,) how far, in sigmas, a parameter may follow each regressor by one unit; inf: anything."""
    own = [_BELIEVED if _is_temperature(name) else np.inf for name in channels]
    return np.array(own + [_BELIEVED] * (sum(map(_is_temperature, channels)) + _HOURS))


def regressors(times: Array, channels: Array, names: Sequence[str]) -> Array:
    """(n, c) the channels, temperatures less their lag, sine and cosine of the hour.

    Args:
        times: (n,) in order, s since 1970.
        channels: (n, len(names)) less their references; NaN where a session does not tell, which counts as the last
            that did.
    """
    known = np.array([_filled_gaps(column) for column in channels.T]).reshape(len(names), len(times)).T
    warm = [c for c, name in enumerate(names) if _is_temperature(name)]
    rates = known[:, warm] - _lagged_means(times, known[:, warm])
    angle = 2 * np.pi * times / DAY_SECONDS
    return np.column_stack([known, rates, np.sin(angle), np.cos(angle)])


def _is_temperature(channel: str) -> bool:
    return channel.endswith("temperature_c")


def _filled_gaps(column: Array) -> Array:
    """A channel without gaps."""
    seen = np.isfinite(column)
    last = np.maximum.accumulate(np.where(seen, np.arange(len(column)), -1))
    return np.where(last >= 0, column[np.maximum(last, 0)], 0.0)


def _lagged_means(times: Array, values: Array) -> Array:
    """(n, c) mean of the sessions so far, weighed by exp(−age/lag)."""
    total, weight, out = np.zeros(values.shape[1]), 0.0, np.zeros_like(values)
    fade = np.exp(-np.diff(times, prepend=times[:1]) / _LAG)
    for k, value in enumerate(values):
        total, weight = total * fade[k] + value, weight * fade[k] + 1.0
        out[k] = total / weight
    return out
