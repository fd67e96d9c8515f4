"""Views whose targets bear each other's names: the distances between them tell it, wherever the arm stood.

One wrong name shows as an outlier. Where all names of a view are mixed up, what is left of it agrees with nothing, and
beside clouds it holds the scan in a wrong place, so that the scan is blamed.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.distances import COMPARED_TARGETS, distance_sigma, target_distances, target_positions
from stitch.observations.targets.outliers import LIMIT_TARGET, Outlier, mask_outliers
from stitch.statistics.robust import MAD_TO_SIGMA, nan_median

# Targets of a view whose distances tell names apart, and views that say how far two targets lie apart.
_MIN_TARGETS, _MIN_VIEWS = 3, 3
# Other names must leave so much less than those that are stated, and be found within so many trials.
_CLEARER, _TRIALS = 0.2, 100_000


@dataclass(frozen=True)
class MislabelledView:
    """A view in which other names make all distances those of the other views."""

    view: int
    names: tuple[tuple[str, str], ...]  # as stated, and as the distances have it; empty where several fit alike
    distance: float  # length_unit: by which distances are off under the names as stated, at the most
    times: float  # the same over the scatter of distances

    @property
    def outlier(self) -> Outlier:
        """All that the view shows of targets."""
        return Outlier(self.view, None, self.distance, self.times)

    def message(self, view: str) -> str:
        """What happened and what to do, with the name of the view."""
        told = [f"{stated} is {right}" for stated, right in self.names]
        named = "; ".join(told[:COMPARED_TARGETS]) + (
            f" … and {len(told) - COMPARED_TARGETS} more" if len(told) > COMPARED_TARGETS else ""
        )
        which = f" ({named})" if named else ""
        return (
            f"The targets of view {view} bear each other's names{which}, as the distances between them say: its "
            "labelled points are not used. Correct the names in points.csv."
        )


def find_mislabelled(sightings: Sightings) -> tuple[MislabelledView, ...]:
    """Views whose names are mixed up; of many targets each view is asked about some, all over its list."""
    places = target_positions(sightings)
    worst, usually = _distance_deviations(places, [_compared_targets(place) for place in places])
    scatter = max(distance_sigma(sightings), MAD_TO_SIGMA * usually)
    doubted = np.flatnonzero(worst > LIMIT_TARGET * scatter)
    usual = _usual_distances(places) if len(doubted) else np.empty((0, 0))
    found = []
    for v in doubted:
        stated = np.flatnonzero(np.isfinite(places[v, :, 0]))
        within = min(LIMIT_TARGET * scatter, _CLEARER * worst[v])
        fits = list(_consistent_labels(target_distances(places[v : v + 1, stated])[0], usual, within))
        if fits:
            names = [sightings.targets[k] for k in stated]
            right = [sightings.targets[k] for k in fits[0]]
            mixed = tuple((a, b) for a, b in zip(names, right, strict=True) if a != b)
            found.append(MislabelledView(int(v), mixed if len(fits) == 1 else (), worst[v], worst[v] / scatter))
    return tuple(found)


def drop_mislabelled(sightings: Sightings | None) -> Sightings | None:
    """The sightings without those of views whose names are mixed up."""
    if sightings is None:
        return None
    mixed_up = [m.outlier for m in find_mislabelled(sightings)]
    return replace(sightings, used=mask_outliers(sightings.used, mixed_up, sightings.targets, sightings.target))


def _compared_targets(place: Array) -> Indices:
    """Of the targets (K, 3) that a view shows as many as are compared pair by pair."""
    shown = np.flatnonzero(np.isfinite(place[:, 0]))
    return np.asarray(shown[np.linspace(0, len(shown) - 1, min(len(shown), COMPARED_TARGETS)).astype(int)])


def _distance_deviations(places: Array, compared: Sequence[Indices]) -> tuple[Array, float]:
    """(V,) by how much a distance of each view is off what it usually is, at the most, and the median of all."""
    worst, off = np.zeros(len(compared)), [np.zeros(0)]
    alike = defaultdict[tuple[int, ...], list[int]](list)
    for v, shown in enumerate(compared):
        alike[tuple(shown)].append(v)
    for targets, views in alike.items():
        if len(targets) >= _MIN_TARGETS:
            apart = target_distances(places[:, list(targets)])[:, *np.triu_indices(len(targets), 1)]
            few = np.isfinite(apart).sum(axis=0) < _MIN_VIEWS
            own = np.where(few, np.nan, np.abs(apart[views] - nan_median(apart)))
            worst[views] = np.nanmax(own, axis=1, initial=0.0)
            off.append(own.ravel())
    every = np.concatenate(off)
    return worst, float(np.nanmedian(every)) if np.isfinite(every).any() else 0.0


def _usual_distances(places: Array) -> Array:
    """(K, K) distances between targets as most views have them, NaN where few do."""
    out = np.empty((places.shape[1],) * 2)
    for k, row in enumerate(out):
        apart = np.linalg.norm(places - places[:, k : k + 1], axis=2)
        row[:] = np.where(np.isfinite(apart).sum(axis=0) < _MIN_VIEWS, np.nan, nan_median(apart))
    return out


def _consistent_labels(own: Array, usual: Array, within: float) -> Iterator[list[int]]:
    """At most two ways to name n targets, (n, n) apart, so that all distances are the usual ones (K, K)."""
    named, trials, given = list[int](), 0, 0
    choices: list[Iterator[int]] = [iter(range(len(usual)))]
    while choices and trials < _TRIALS and given < 2:
        k = next(choices[-1], None)
        trials += 1
        if k is None:
            choices.pop()
            named = named[:-1]
        elif len(named) + 1 == len(own):
            given += 1
            yield [*named, k]
        else:
            named.append(k)
            choices.append(iter(_consistent_targets(own[len(named), : len(named)], usual, named, within)))


def _consistent_targets(own: Array, usual: Array, named: list[int], within: float) -> list[int]:
    """Names that are left for a target, (d,) apart from d that have theirs: what few views say of some may be open."""
    held = named[:COMPARED_TARGETS]
    off = np.abs(usual[:, held] - own[: len(held)])
    known = np.isfinite(off)
    fits = (~known | (off < within)).all(axis=1) & (known.sum(axis=1) >= min(len(held), _MIN_TARGETS))
    fits[named] = False
    return [int(k) for k in np.flatnonzero(fits)]
