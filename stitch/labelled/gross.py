"""Gross errors among labelled points: a wrong label, a broken reading, a pose that was not driven.

A target is judged by what the other targets of its view and the scatter of the poses foretell, a view by all of
it; both in units of what is usual in these data, so that outliers do not hide behind the scatter they cause.
"""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.labelled.rows import Rows, evidence_of_rows

# Six times the usual deviation: one in a thousand million of honest Gaussian errors, and still outside the
# bounded errors of a robot whose model lacks something.
GROSS = 6.0


@dataclass(frozen=True)
class Outlier:
    """One target of one view, or a whole view, that does not count."""

    view: int
    target: str | None  # None: all that the view shows
    distance: float  # 3D, length_unit: of a target from where the rest of its view has it, of a view from the model
    times: float  # the deviation over what is usual here


def gross(rows: Rows, variances: Array) -> list[Outlier]:
    """The worst of every view that is off, one target at a time, under a fitted model.

    Args:
        variances: (3,) of rotation scatter, translation scatter, factor on the sensor's noise.
    """
    sightings = rows.capture.sightings
    assert sightings is not None
    V, S = sightings.used.shape
    P = np.asarray(np.linalg.inv(evidence_of_rows(rows, rows.hand_eye).covariance(variances)[:V]), float)
    left = rows.left[:V]
    slots, apart = _slot_deviations(P, left, S)
    slots[~sightings.used] = np.nan
    views = np.sqrt(np.einsum("vi,vij,vj->v", left, P, left) / np.maximum(rows.used.sum(axis=1), 1))
    views[~sightings.used.any(axis=1)] = np.nan
    slots, views = slots / np.nanmedian(slots), views / np.nanmedian(views)
    distances = rows.distances(rows.left)
    alone = sightings.used.sum(axis=1) < 2
    out = []
    for v in np.flatnonzero(sightings.used.any(axis=1)):
        worst = float(np.nanmax(slots[v], initial=0.0))
        if worst > GROSS and not alone[v]:
            slot = int(np.nanargmax(slots[v]))
            name = sightings.targets[sightings.target[v, slot]]
            out.append(Outlier(int(v), name, float(apart[v, slot]), worst))
        elif views[v] > GROSS:
            out.append(Outlier(int(v), None, float(np.nanmax(distances[v])), float(views[v])))
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


def outside(used: Mask, found: list[Outlier], targets: tuple[str, ...], target: Indices) -> Mask:
    """(V, S) bool: what is in use without the outliers."""
    used = used.copy()
    for o in found:
        used[o.view] &= False if o.target is None else target[o.view] != targets.index(o.target)
    return used
