"""What every scanner has: a smooth error over its field and over incidence, a fraction of its noise, in all views.

It repeats from view to view, so no number of views averages it out, and it pretends to be a small effect of the
scanner. Diagnosis counts it as known scatter: what an effect must exceed.
"""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import legendre

from stitch.effects.chain import Chain, Term
from stitch.effects.columns import all_columns
from stitch.effects.contract import Effect, number
from stitch.effects.views import ScanView
from stitch.frames import Array
from stitch.overlap.free_poses import FreePoses

# Rms over the field, as a share of the scanner's noise along the ray.
_SHARE = 0.5
_DEGREE = 3
# Corners are seen by few points.
_REACH = 0.98


def field_scatter(chain: Chain, terms: Sequence[Term], T_mount: Array, freed: FreePoses) -> Array:
    """(6V, K) twists that the views show for one standard deviation of each of K independent smooth errors."""
    effect = _field_effect(_half_field(chain))
    columns = all_columns(chain, terms, [Term(effect, np.zeros(len(effect.specs)))], T_mount, freed)[0][0]
    noise = float(np.nanmedian([scan.noise for scan in chain.capture.scans]))
    return np.asarray(columns * (_SHARE * noise if np.isfinite(noise) else 0.0))


def _half_field(chain: Chain) -> Array:
    """(2,) x/z and y/z up to which the scanner sees."""
    slopes = np.concatenate([np.abs(scan.points[:, :2] / scan.points[:, 2:]) for scan in chain.capture.scans])
    return np.asarray(np.maximum(np.quantile(slopes, _REACH, axis=0), 1e-6))


def _field_effect(half: Array) -> Effect:
    """Legendre products of the field up to the third degree, of unit rms together, and the slope with incidence."""
    orders = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1) if 0 < i + j <= _DEGREE]
    weights = np.array([1.0 / (i + j) for i, j in orders])
    weights /= np.linalg.norm(weights)

    def smooth(points: Array, view: ScanView, **sizes: float) -> Array:
        a, b = np.clip(points[:, :2] / points[:, 2:] / half, -1.2, 1.2).T
        powers_a, powers_b = legendre.legvander(a, _DEGREE), legendre.legvander(b, _DEGREE)
        shift = sizes["incidence"] * (1 / view.cosine - 1)
        for weight, (i, j) in zip(weights, orders, strict=True):
            unit = np.sqrt((2 * i + 1) * (2 * j + 1))
            shift = shift + sizes[f"p{i}{j}"] * weight * unit * powers_a[:, i] * powers_b[:, j]
        return np.asarray(points + view.along(points) * shift[:, None])

    specs = {name: number("mm", typical=0.01, limit=1.0) for name in [*(f"p{i}{j}" for i, j in orders), "incidence"]}
    return Effect("scanner_field", "sensor", specs, smooth, (), (), "empirical")
