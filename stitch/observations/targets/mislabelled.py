"""Views whose targets bear each other's names: the distances between them tell it, wherever the arm stood.

One wrong name shows as an outlier. Where all names of a view are mixed up, what is left of it agrees with nothing, and
beside clouds it holds the scan in a wrong place, so that the scan is blamed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.distances import MANY, distance_sigma, distances, places_of
from stitch.observations.targets.outliers import LIMIT_TARGET, Outlier, outside
from stitch.statistics.robust import MAD_TO_SIGMA

# Targets of a view whose distances tell names apart, and views that say how far two targets lie apart.
_TARGETS, _VIEWS = 3, 3
# Other names must leave so much less than those that are stated, and be found within so many trials.
_CLEARER, _TRIALS = 0.2, 100_000


@dataclass(frozen=True)
class Mislabelled:
    """A view in which other names make all distances those of the other views."""

    view: int
    names: tuple[tuple[str, str], ...]  # as stated, and as the distances have it; empty where several fit alike
    distance: float  # length_unit: by which distances are off under the names as stated, at the most
    times: float  # the same over the scatter of distances

    @property
    def outlier(self) -> Outlier:
        """All that the view shows of targets."""
        return Outlier(self.view, None, self.distance, self.times)

    def said(self, view: str) -> str:
        """What happened and what to do, with the name of the view."""
        named = "; ".join(f"{stated} is {right}" for stated, right in self.names)
        which = f" ({named})" if named else ""
        return (
            f"The targets of view {view} bear each other's names{which}, as the distances between them say: its "
            "labelled points are not used. Correct the names in points.csv."
        )


def mislabelled(sightings: Sightings) -> tuple[Mislabelled, ...]:
    """Views whose names are mixed up; none among more targets than are compared pair by pair."""
    if len(sightings.targets) > MANY:
        return ()
    apart = distances(places_of(sightings))
    few = np.isfinite(apart).sum(axis=0) < _VIEWS
    usual = np.where(few, np.nan, np.nanmedian(np.where(few, 0.0, apart), axis=0))
    off = np.abs(apart - usual)
    between = off[:, ~np.eye(len(usual), dtype=bool)]
    if not np.isfinite(between).any():
        return ()
    scatter = max(distance_sigma(sightings), MAD_TO_SIGMA * float(np.nanmedian(between)))
    found = []
    for v in range(len(apart)):
        stated = np.flatnonzero(np.isfinite(np.diagonal(apart[v])))
        own, worst = apart[v][np.ix_(stated, stated)], float(np.nanmax(off[v], initial=0.0))
        if len(stated) < _TARGETS or worst < LIMIT_TARGET * scatter:
            continue
        within = min(LIMIT_TARGET * scatter, _CLEARER * worst)
        fits = list(_other_names(own, usual, within))
        if fits:
            names = [sightings.targets[k] for k in stated]
            right = [sightings.targets[k] for k in fits[0]]
            mixed = tuple((a, b) for a, b in zip(names, right, strict=True) if a != b)
            found.append(Mislabelled(v, mixed if len(fits) == 1 else (), worst, worst / scatter))
    return tuple(found)


def named_right(sightings: Sightings | None) -> Sightings | None:
    """The sightings without those of views whose names are mixed up."""
    if sightings is None:
        return None
    mixed_up = [m.outlier for m in mislabelled(sightings)]
    return replace(sightings, used=outside(sightings.used, mixed_up, sightings.targets, sightings.target))


def _other_names(own: Array, usual: Array, within: float) -> Iterator[list[int]]:
    """At most two ways to name n targets, (n, n) apart, so that all distances are the usual ones (K, K)."""
    named, trials, given = list[int](), 0, 0
    choices: list[Iterator[int]] = [iter(range(len(usual)))]
    while choices and trials < _TRIALS and given < 2:
        k = next(choices[-1], None)
        trials += 1
        if k is None:
            choices.pop()
            named = named[:-1]
        elif k not in named and _agree(own[len(named), : len(named)], usual[k, named], within):
            if len(named) + 1 == len(own):
                given += 1
                yield [*named, k]
            else:
                named.append(k)
                choices.append(iter(range(len(usual))))


def _agree(own: Array, usual: Array, within: float) -> bool:
    return bool(np.all(np.abs(own - usual) < within))
