"""Labelled points that sit elsewhere among the others from some view on: a ball that was bumped, a nest put back wrong.

Distances between the targets of one view are the same whatever the arm and the hand-eye are. Where those from one
target to the others step between two views, and those of the others among themselves do not, that one has moved; the
fit would put it half way, and call the misfit of its views errors of the arm.
"""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.outliers import LIMIT_TARGET
from stitch.units import length_text

# Views on each side of a step: fewer are outliers of their own. Targets, so that one of them can be told.
_SIDE, _TARGETS = 2, 3
# More targets hold each other, so that one that moved pulls little; to compare all their pairs takes minutes.
_MANY = 24
# Standard error of a median over that of a mean, and a standard deviation over the median of its deviations.
_MEDIAN, _MAD = 1.25, 1.4826
# Places of a step that are tried at a time, ever closer.
_TRIED = 50


@dataclass(frozen=True)
class MovedTarget:
    """From view `start` on a target sits elsewhere among the others."""

    target: str
    start: int
    distance: float  # length_unit: by which its distances to the others change at the most

    def said(self, view: str, length: str) -> str:
        """What happened and what to do, with the name of the view and that distance in words."""
        return (
            f"{self.target} sits elsewhere among the targets from view {view} on: its distances to the others change "
            f"by up to {length}. Give it another name from there on in points.csv, or leave it out."
        )


def said_of_targets(session: Session, sightings: Sightings | None) -> tuple[str, ...]:
    """Which targets moved, in words; nothing where a session has none."""
    if sightings is None:
        return ()
    names = session.names
    found = moved_targets(sightings.everything)
    return tuple(m.said(names[m.start], length_text(m.distance, session.length_unit)) for m in found)


def moved_targets(sightings: Sightings) -> tuple[MovedTarget, ...]:
    """Targets that moved once, the clearest first; each is asked without those before it; none among more than 24."""
    if len(sightings.targets) > _MANY:
        return ()
    apart, sigma = _distances(sightings), float(np.median(sightings.sigma[sightings.used]))
    left, found = list(range(len(sightings.targets))), list[MovedTarget]()
    while len(left) >= _TARGETS:
        steps = [_step(apart[:, left][:, :, left], k, sigma) for k in range(len(left))]
        times, start, distance = max(steps)
        if times < LIMIT_TARGET:
            break
        gone = left.pop(steps.index((times, start, distance)))
        found.append(MovedTarget(sightings.targets[gone], start, distance))
    return tuple(found)


def _distances(sightings: Sightings) -> Array:
    """(V, K, K) between targets, NaN where a view does not show both."""
    V, K = len(sightings.target), len(sightings.targets)
    places = np.full((V, K, 3), np.nan)
    view, slot = np.nonzero(sightings.used)
    places[view, sightings.target[view, slot]] = sightings.points[view, slot]
    return np.asarray(np.linalg.norm(places[:, :, None] - places[:, None], axis=3))


def _step(apart: Array, k: int, sigma: float) -> tuple[float, int, float]:
    """How many times what is usual the distances (V, K, K) from target k step, from which view on, and the largest."""
    others = np.arange(apart.shape[1]) != k
    own, among = apart[:, k, others], apart[:, others][:, :, others][:, *np.triu_indices(others.sum(), 1)]
    low, high = _SIDE, len(apart) - _SIDE
    while True:
        starts = np.unique(np.linspace(low, high, _TRIED).astype(int))
        gains = [_gain(own, among, int(start)) for start in starts]
        at = int(np.argmax(gains))
        if not gains[at] > 0:
            return 0.0, 0, 0.0
        if high - low < _TRIED:
            break
        low, high = int(starts[max(at - 1, 0)]), int(starts[min(at + 1, len(starts) - 1)])
    start = int(starts[at])
    mine, rest = _known(own, start), _known(among, start)
    # By the sensor's sigma, or by what is left on both sides: a lens changes distances too, but with every view.
    left = np.concatenate([np.abs(_level(d, start)[1]).ravel() for d in (mine, rest)])
    scatter = max(np.sqrt(2) * sigma, _MAD * float(np.nanmedian(left)))
    (steps, times), (_, usual) = (_stepped(d, start, scatter) for d in (mine, rest))
    return float(np.median(times) / max(np.median(usual), 1.0)), start, float(steps.max())


def _gain(own: Array, among: Array, start: int) -> float:
    """By how much a step before a view brings distances (V, K − 1) nearer to their medians, in sum; 0 where too few are
    seen on both sides, or none among the others (V, ·)."""
    mine = _known(own, start)
    if mine.shape[1] < _TARGETS - 1 or not _known(among, start).shape[1]:
        return 0.0
    off = [float(np.nansum(np.abs(d - np.nanmedian(d, axis=0)))) for d in (mine, mine[:start], mine[start:])]
    return off[0] - off[1] - off[2]


def _known(distances: Array, start: int) -> Array:
    """(V, p) those of the distances that are seen on both sides."""
    seen = np.isfinite(distances)
    return distances[:, (seen[:start].sum(axis=0) >= _SIDE) & (seen[start:].sum(axis=0) >= _SIDE)]


def _level(distances: Array, start: int) -> tuple[Array, Array]:
    """(2, p) medians before and from a view on, and (V, p) what is left."""
    medians = np.array([np.nanmedian(half, axis=0) for half in (distances[:start], distances[start:])])
    return medians, distances - np.where(np.arange(len(distances))[:, None] < start, *medians)


def _stepped(distances: Array, start: int, scatter: float) -> tuple[Array, Array]:
    """(p,) steps of the medians, in length_unit and in standard errors."""
    before, after = (np.isfinite(half).sum(axis=0) for half in (distances[:start], distances[start:]))
    steps = np.abs(np.diff(_level(distances, start)[0], axis=0)[0])
    return steps, steps / (_MEDIAN * scatter * np.sqrt(1 / before + 1 / after))
