"""Gross errors among labelled points: a wrong label, a broken reading, a pose that was not driven.

A view whose targets do not fit each other, wherever the arm stood, has a wrong one: that which the others and the
scatter of the poses foretell least. A view whose targets agree but lie far off has a wrong pose. Both are measured
by what is usual in these data (median), so that outliers do not hide behind the scatter they cause.

A view whose targets bear each other's names is told by the distances between them, wherever the arm stood. One wrong
name shows as an outlier. Where all names of a view are mixed up, what is left of it agrees with nothing, and beside
clouds it holds the scan in a wrong place, so that the scan is blamed.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.numerics.distributions import MAD_TO_SIGMA, nan_median
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.targets.rows import (
    COMPARED_TARGETS,
    TargetRows,
    distance_sigma,
    target_distances,
    target_positions,
)
from stitch.session.capture import Sightings
from stitch.system.values import Value

# Six times the usual deviation: one in a thousand million of honest Gaussian errors. Pose errors of an arm whose
# model lacks something have longer tails: six times the median happens.
LIMIT_TARGET, LIMIT_VIEW = 6.0, 10.0
# A view that may stand anywhere: its pose scatters by this many times what the poses do.
_ANYWHERE = 1e3
# Targets of a view whose distances tell names apart, and views that say how far two targets lie apart.
_MIN_TARGETS, _MIN_VIEWS = 3, 3
# Other names must leave so much less than those that are stated, and be found within so many trials.
_CLEARER, _TRIALS = 0.2, 100_000


@dataclass(frozen=True, eq=False)
class Outlier(Value):
    """One target of one view, or a whole view, that does not count.

    Example:
        >>> run.outliers  # of clouds without labelled points
        ()
    """

    view: int
    target: str | None  # None: all that the view shows
    distance: float  # 3D, length_unit: of a target from where the rest of its view has it, of a view from the model
    times: float  # the deviation over what is usual here


def find_outliers(rows: TargetRows, variances: Array) -> list[Outlier]:
    """Return at most one outlier per view, under a fitted model: its worst target, or the view with all its targets.

    Three numbers decide, each over its median in these data: the deviation of a target from where the other targets of
    its view predict it; the misfit of all targets of a view at its best pose; the rms distance of a view from the
    model. A target is an outlier if the first two exceed `LIMIT_TARGET`; else the view is, if the third exceeds
    `LIMIT_VIEW`.

    Args:
        variances: (3,) of rotation scatter (rad²), translation scatter (length_unit²), factor on the sensor's noise.
    """
    sightings = rows.capture.sightings
    assert sightings is not None
    V, S = sightings.used.shape
    mixed = rows.mixed_model(rows.hand_eye)
    residual = rows.residual[:V]
    precision = np.linalg.inv(mixed.covariance(variances)[:V]).astype(float)
    precision_anywhere = np.linalg.inv(mixed.covariance(variances * [_ANYWHERE**2, _ANYWHERE**2, 1.0])[:V])
    seen = sightings.used.any(axis=1)
    deviation, distance = _slot_deviations(precision, residual, S)
    deviation[~sightings.used] = np.nan
    squares = np.einsum("vi,vij,vj->v", residual, precision_anywhere, residual)
    misfit = np.where(seen, np.sqrt(np.maximum(squares, 0.0)), np.nan)
    distances = rows.distances(rows.residual)
    view_rms = np.sqrt(np.nansum(distances**2, axis=1) / np.maximum(sightings.used.sum(axis=1), 1))
    view_rms[~seen] = np.nan
    # Each over its median in these data.
    deviation_times, misfit_times, rms_times = (
        x / max(float(np.nanmedian(x)), 1e-300) for x in (deviation, misfit, view_rms)
    )
    several = sightings.used.sum(axis=1) > 1
    outliers = []
    for v in np.flatnonzero(seen):
        slot = int(np.nanargmax(deviation_times[v]))
        if several[v] and misfit_times[v] > LIMIT_TARGET and deviation_times[v, slot] > LIMIT_TARGET:
            name = sightings.targets[sightings.target[v, slot]]
            outliers.append(Outlier(int(v), name, float(distance[v, slot]), float(deviation_times[v, slot])))
        elif rms_times[v] > LIMIT_VIEW:
            outliers.append(Outlier(int(v), None, float(view_rms[v]), float(rms_times[v])))
    return outliers


def _slot_deviations(P: Array, residual: Array, slots: int) -> tuple[Array, Array]:
    """Return how far each target lies from where the rest of its view predicts it, (V, S): in sigmas, in length_unit.

    With P the inverse covariance of a view's residuals e, the deviation of target s is P_ss⁻¹ (P e)_s, its covariance
    P_ss⁻¹.

    Args:
        P: (V, m, m).
        residual: e (V, m); the first 3S are the coordinates of S targets, target after target, length_unit.
        slots: S.
    """
    V = len(P)
    Pe = np.einsum("vij,vj->vi", P, residual)[:, : 3 * slots].reshape(V, slots, 3)
    blocks = P[:, : 3 * slots, : 3 * slots].reshape(V, slots, 3, slots, 3)
    blocks = np.moveaxis(blocks[:, np.arange(slots), :, np.arange(slots)], 0, 1)  # P_ss (V, S, 3, 3)
    deviation = np.einsum("vsij,vsj->vsi", np.linalg.inv(blocks), Pe)
    sigmas = np.sqrt(np.maximum(np.einsum("vsi,vsi->vs", Pe, deviation), 0.0))
    return sigmas, np.linalg.norm(deviation, axis=2)


def mask_outliers(used: Mask, outliers: Sequence[Outlier], targets: tuple[str, ...], target: Indices) -> Mask:
    """Return `used` (V, S) without the outliers.

    Args:
        used: (V, S) bool, sightings in use, of at most S targets a view.
        targets: names of all targets.
        target: (V, S) number of the target in each place.
    """
    used = used.copy()
    for o in outliers:
        used[o.view] &= False if o.target is None else target[o.view] != targets.index(o.target)
    return used


@dataclass(frozen=True)
class MislabelledView:
    """A view in which other names make all distances those of the other views."""

    view: int
    names: tuple[tuple[str, str], ...]  # as stated, and as the distances have it; empty where several fit alike
    distance: float  # length_unit: by which distances are off under the names as stated, at the most
    times: float  # the same over the scatter of distances

    @property
    def outlier(self) -> Outlier:
        """The view as an outlier: none of its targets counts."""
        return Outlier(self.view, None, self.distance, self.times)

    def message(self, view: str) -> str:
        """Return what happened and what to do, in sentences, for the view of this name."""
        named = "; ".join(f"{stated} is {right}" for stated, right in self.names[:COMPARED_TARGETS])
        if len(self.names) > COMPARED_TARGETS:
            named += f" … and {len(self.names) - COMPARED_TARGETS} more"
        which = f" ({named})" if named else ""
        return (
            f"The targets of view {view} bear each other's names{which}, as the distances between them say: its "
            "labelled points are not used. Correct the names in points.csv."
        )


def find_mislabelled(sightings: Sightings) -> tuple[MislabelledView, ...]:
    """Return the views whose target names are mixed up: other names make all its distances those of other views.

    A view is a suspect if a distance between two of its targets is off the median over the views by more than
    `LIMIT_TARGET` sigmas. Of many targets in a view, some are compared, spread over its list.
    """
    places = target_positions(sightings)
    largest, median_deviation = _distance_deviations(places)
    scatter = max(distance_sigma(sightings), MAD_TO_SIGMA * median_deviation)
    suspects = np.flatnonzero(largest > LIMIT_TARGET * scatter)
    if not len(suspects):
        return ()
    # Distances (K, K) between targets as most views have them, NaN where few do.
    usual = np.empty((places.shape[1],) * 2)
    for k, row in enumerate(usual):
        distances = np.linalg.norm(places - places[:, k : k + 1], axis=2)
        row[:] = np.where(np.isfinite(distances).sum(axis=0) < _MIN_VIEWS, np.nan, nan_median(distances))
    mislabelled = []
    for v in suspects:
        shown = np.flatnonzero(np.isfinite(places[v, :, 0]))
        within = min(LIMIT_TARGET * scatter, _CLEARER * largest[v])
        assignments = list(_consistent_labels(target_distances(places[v : v + 1, shown])[0], usual, within))
        if assignments:
            stated = [sightings.targets[k] for k in shown]
            right = [sightings.targets[k] for k in assignments[0]]
            renamed = tuple((a, b) for a, b in zip(stated, right, strict=True) if a != b)
            names = renamed if len(assignments) == 1 else ()
            mislabelled.append(MislabelledView(int(v), names, largest[v], largest[v] / scatter))
    return tuple(mislabelled)


def drop_mislabelled(sightings: Sightings | None) -> Sightings | None:
    """Return the sightings without those of views whose names are mixed up."""
    if sightings is None:
        return None
    mixed_up = [m.outlier for m in find_mislabelled(sightings)]
    return replace(sightings, used=mask_outliers(sightings.used, mixed_up, sightings.targets, sightings.target))


def _distance_deviations(places: Array) -> tuple[Array, float]:
    """Return per view (V,) the largest deviation of a distance between two of its targets, and the median deviation.

    A deviation is that of a distance from its median over all views, length_unit; 0 where there are too few. Of the
    targets of a view at most `COMPARED_TARGETS` are compared.

    Args:
        places: (V, K, 3) of K targets, sensor frame; NaN where a view does not show one.
    """
    largest, all_deviations = np.zeros(len(places)), [np.zeros(0)]
    views_by_targets = defaultdict[tuple[int, ...], list[int]](list)
    for v, place in enumerate(places):
        shown = np.flatnonzero(np.isfinite(place[:, 0]))
        some = np.linspace(0, len(shown) - 1, min(len(shown), COMPARED_TARGETS)).astype(int)
        views_by_targets[tuple(shown[some])].append(v)
    for targets, views in views_by_targets.items():
        if len(targets) >= _MIN_TARGETS:
            distances = target_distances(places[:, list(targets)])[:, *np.triu_indices(len(targets), 1)]
            few = np.isfinite(distances).sum(axis=0) < _MIN_VIEWS
            deviations = np.where(few, np.nan, np.abs(distances[views] - nan_median(distances)))
            largest[views] = np.nanmax(deviations, axis=1, initial=0.0)
            all_deviations.append(deviations.ravel())
    every = np.concatenate(all_deviations)
    return largest, float(np.nanmedian(every)) if np.isfinite(every).any() else 0.0


def _consistent_labels(distances: Array, usual: Array, within: float) -> Iterator[list[int]]:
    """Yield at most two assignments of names to n targets under which all their distances are the usual ones.

    Each is a list of n numbers of targets. A depth-first search that names one target after the other, and gives up
    after `_TRIALS` trials. A second assignment says that the first is not unique.

    Args:
        distances: (n, n) between the targets as one view has them, length_unit.
        usual: (K, K) between the targets by name, NaN where not known.
        within: largest difference that counts as equal, length_unit.
    """
    # Names given so far, and for the target after each of them the names that are still to be tried.
    named = list[int]()
    choices: list[Iterator[int]] = [iter(range(len(usual)))]
    trials = found = 0
    while choices and trials < _TRIALS and found < 2:
        k = next(choices[-1], None)
        trials += 1
        if k is None:
            choices.pop()
            named = named[:-1]
        elif len(named) + 1 == len(distances):
            found += 1
            yield [*named, k]
        else:
            named.append(k)
            choices.append(iter(_consistent_targets(distances[len(named), : len(named)], usual, named, within)))


def _consistent_targets(distances: Array, usual: Array, named: list[int], within: float) -> list[int]:
    """Return the numbers of the names that a further target can have, by its distances to d targets already named.

    Only the first `COMPARED_TARGETS` of these are compared, and `_MIN_TARGETS` of the distances must be known.

    Args:
        distances: (d,) to these, length_unit.
        usual: (K, K) distances by name; NaN, where few views know one, does not exclude a name.
        named: (d,) their names.
        within: largest difference that counts as equal, length_unit.
    """
    held = named[:COMPARED_TARGETS]
    off = np.abs(usual[:, held] - distances[: len(held)])
    known = np.isfinite(off)
    fits = (~known | (off < within)).all(axis=1) & (known.sum(axis=1) >= min(len(held), _MIN_TARGETS))
    fits[named] = False
    return [int(k) for k in np.flatnonzero(fits)]
