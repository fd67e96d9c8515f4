"""Gross errors among labelled points: a wrong label, a broken reading, a pose that was not driven.

A view whose targets do not fit each other, wherever the arm stood, has a wrong one: that which the others and the
scatter of the poses foretell least. A view whose targets agree but lie far off has a wrong pose. Both are measured
by what is usual in these data (median), so that outliers do not hide behind the scatter they cause.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.observations.targets.rows import TargetRows, mixed_model_of_rows

# Six times the usual deviation: one in a thousand million of honest Gaussian errors. Pose errors of an arm whose
# model lacks something have longer tails: six times the median happens.
LIMIT_TARGET, LIMIT_VIEW = 6.0, 10.0
# A view that may stand anywhere: its pose scatters by this many times what the poses do.
_ANYWHERE = 1e3


@dataclass(frozen=True)
class Outlier:
    """One target of one view, or a whole view, that does not count."""

    view: int
    target: str | None  # None: all that the view shows
    distance: float  # 3D, length_unit: of a target from where the rest of its view has it, of a view from the model
    times: float  # the deviation over what is usual here


def find_outliers(rows: TargetRows, variances: Array) -> list[Outlier]:
    """The worst of every view that is off, one target at a time, under a fitted model.

    Args:
        variances: (3,) of rotation scatter, translation scatter, factor on the sensor's noise.
    """
    sightings = rows.capture.sightings
    assert sightings is not None
    V, S = sightings.used.shape
    mixed, left = mixed_model_of_rows(rows, rows.hand_eye), rows.residual[:V]
    P = np.asarray(np.linalg.inv(mixed.covariance(variances)[:V]), float)
    free = np.linalg.inv(mixed.covariance(variances * [_ANYWHERE**2, _ANYWHERE**2, 1.0])[:V])
    seen = sightings.used.any(axis=1)
    slots, apart = _slot_deviations(P, left, S)
    slots[~sightings.used] = np.nan
    misfit = np.where(seen, np.sqrt(np.maximum(np.einsum("vi,vij,vj->v", left, free, left), 0.0)), np.nan)
    distances = rows.distances(rows.residual)
    off = np.sqrt(np.nansum(distances**2, axis=1) / np.maximum(sightings.used.sum(axis=1), 1))
    off[~seen] = np.nan
    slots, misfit, far = (x / max(float(np.nanmedian(x)), 1e-300) for x in (slots, misfit, off))
    several = sightings.used.sum(axis=1) > 1
    out = []
    for v in np.flatnonzero(seen):
        slot = int(np.nanargmax(slots[v]))
        if several[v] and misfit[v] > LIMIT_TARGET and slots[v, slot] > LIMIT_TARGET:
            name = sightings.targets[sightings.target[v, slot]]
            out.append(Outlier(int(v), name, float(apart[v, slot]), float(slots[v, slot])))
        elif far[v] > LIMIT_VIEW:
            out.append(Outlier(int(v), None, float(off[v]), float(far[v])))
    return out


def _slot_deviations(P: Array, left: Array, slots: int) -> tuple[Array, Array]:
    """(V, S) of each target from what the rest of its view foretells, in sigmas and in length_unit.

    With P the inverse covariance of a view, that deviation is P_ss⁻¹ (P e)_s with covariance P_ss⁻¹.
    """
    V = len(P)
    pushed = np.einsum("vij,vj->vi", P, left)[:, : 3 * slots].reshape(V, slots, 3)
    own = P[:, : 3 * slots, : 3 * slots].reshape(V, slots, 3, slots, 3)
    own = np.moveaxis(own[:, np.arange(slots), :, np.arange(slots)], 0, 1)  # (V, S, 3, 3)
    apart = np.einsum("vsij,vsj->vsi", np.linalg.inv(own), pushed)
    return np.sqrt(np.maximum(np.einsum("vsi,vsi->vs", pushed, apart), 0.0)), np.linalg.norm(apart, axis=2)


def mask_outliers(used: Mask, found: Sequence[Outlier], targets: tuple[str, ...], target: Indices) -> Mask:
    """(V, S) bool: what is in use without the outliers."""
    used = used.copy()
    for o in found:
        used[o.view] &= False if o.target is None else target[o.view] != targets.index(o.target)
    return used
