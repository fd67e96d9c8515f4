"""Find labelled points that sit elsewhere among the others from some view on: a ball that was bumped, a nest put back
wrong.

Distances between the targets of one view are the same whatever the arm and the hand-eye are. Where those from one
target to the others step between two views, or change little by little, and those of the others among themselves do
not, that one has moved; the fit would put it half way, and call the misfit of its views errors of the arm.
"""

from dataclasses import dataclass

import numpy as np

from stitch.numerics.distributions import MAD_TO_SIGMA, nan_median
from stitch.numerics.frames import Array, Indices
from stitch.observations.targets.outliers import LIMIT_TARGET
from stitch.observations.targets.rows import COMPARED_TARGETS, distance_sigma, target_distances, target_positions
from stitch.session.capture import Sightings
from stitch.session.scan import even_indices

# Views on each side of a step: fewer are outliers of their own. Targets, so that one of them can be told.
_SIDE, _TARGETS = 2, 3
# Standard error of a median over that of a mean.
_MEDIAN = 1.25
# Targets that are looked at closely, and how far a single distance pulls where all are looked at, in sigmas.
_LIKELIEST, _CLIPPED = 8, 10.0
# What creeps leaves so much less about a straight line than about a step.
_DRIFT_SHARE = 0.7


@dataclass(frozen=True)
class MovedTarget:
    """From view `start` on a target sits elsewhere among the others, or wanders off over the whole session."""

    target: str
    start: int
    distance: float  # length_unit: by which its distances to the others change at the most
    drifts: bool


def find_moved_targets(sightings: Sightings) -> tuple[MovedTarget, ...]:
    """Return the targets that moved among the others, the clearest first; each is tested without those found before.

    It ends where no target's step is `LIMIT_TARGET` times the usual, or fewer than `_TARGETS` are left.
    """
    places = target_positions(sightings)
    sigma = distance_sigma(sightings)
    left = list(range(len(sightings.targets)))
    moved = list[MovedTarget]()
    while len(left) >= _TARGETS:
        steps = {
            k: _target_step(places[:, left], k, start, sigma)
            for k, start in _most_stepped_targets(places[:, left], sigma)
        }
        k = max(steps, key=lambda k: steps[k][0], default=-1)
        if k < 0 or steps[k][0] < LIMIT_TARGET:
            break
        _, start, distance, drifts = steps[k]
        moved.append(MovedTarget(sightings.targets[left.pop(k)], start, distance, drifts))
    return tuple(moved)


def _most_stepped_targets(places: Array, sigma: float) -> list[tuple[int, int]]:
    """Return the targets that seem to have moved, likeliest first, each with the view from which on it lies elsewhere.

    A target moves if its distances from the others differ, before and after some view, by more than their scatter.

    Args:
        places: (V, K, 3) of the targets in each view, NaN where it does not show one.
        sigma: of a distance, length_unit, as the sensor states it: the least that is taken for the scatter.
    """
    count = places.shape[1]
    typical = []
    for k in even_indices(count, COMPARED_TARGETS).tolist():
        off = _distances_from_median(places, k)
        seen = np.isfinite(off)
        typical.append(float(np.median(np.abs(off[seen]))) if seen.any() else 0.0)
    scatter = max(sigma, MAD_TO_SIGMA * float(np.median(typical)))
    stepped = []
    for k in range(count):
        times = _steps_of_means(_distances_from_median(places, k) / scatter)
        if times.max(initial=0.0) > 0:
            stepped.append((float(times.max()), k, int(np.argmax(times))))
    return [(k, start) for _, k, start in sorted(stepped, reverse=True)[:_LIKELIEST]]


def _distances_from_median(places: Array, k: int) -> Array:
    """(V, P) distances from target k to its partners, less the median of each."""
    distances = np.linalg.norm(places[:, _partners(places, k)] - places[:, k : k + 1], axis=2)
    return distances - nan_median(distances)


def _partners(places: Array, k: int) -> Indices:
    """Return numbers of the targets often seen together with target k; of many, some spread over the list.

    Args:
        places: (V, K, 3) of the targets, NaN where a view does not show one.
    """
    seen = np.isfinite(places[:, :, 0])
    together = seen[:, k].astype(float) @ seen
    together[k] = 0
    others = np.flatnonzero(together > together.max() / 2)
    return others[even_indices(len(others), COMPARED_TARGETS - 1)]


def _steps_of_means(off: Array) -> Array:
    """Return by how many standard errors distances step before each view (V,), rms over them; 0 where few are seen.

    A step is the difference of the means before and from that view on.

    Args:
        off: (V, P) distances less their medians, in sigmas; NaN where one is not seen. Outliers are clipped.
    """
    seen = np.isfinite(off)
    clipped = np.where(seen, np.clip(off, -_CLIPPED, _CLIPPED), 0.0)
    before = np.cumsum(seen.astype(float), axis=0) - seen.astype(float)
    sums = np.cumsum(clipped, axis=0) - clipped
    after = seen.sum(axis=0) - before
    known = (before >= _SIDE) & (after >= _SIDE)
    n = np.where(known, before, 1.0)
    m = np.where(known, after, 1.0)
    squares = known * (sums / n - (clipped.sum(axis=0) - sums) / m) ** 2 / (1 / n + 1 / m)
    few = known.sum(axis=1) < _TARGETS - 1
    return np.where(few, 0.0, np.sqrt(squares.sum(axis=1) / max(off.shape[1], 1)))


def _target_step(places: Array, k: int, start: int, sigma: float) -> tuple[float, int, float, bool]:
    """Return by how many times the usual step the distances from target k change at view `start`, and what it did.

    What it did: the view, by how much its distances change at the most, length_unit, and whether it drifts.

    Steps are differences of medians before and from that view on, in standard errors. The usual step is that of the
    distances among the other targets. If a straight line over the session fits clearly better, the target drifts.

    Args:
        places: (V, K, 3) of the targets, NaN where a view does not show one.
        sigma: of a distance by the sensor's noise, length_unit.
    """
    partners = _partners(places, k)
    among = target_distances(places[:, partners])[:, *np.triu_indices(len(partners), 1)]
    distances = _seen_on_both_sides(np.linalg.norm(places[:, partners] - places[:, k : k + 1], axis=2), start)
    others = _seen_on_both_sides(among, start)
    if not others.shape[1]:
        return 0.0, start, 0.0, False
    # By the sensor's sigma, or by what is left on both sides: a lens changes distances too, but with every view.
    left = distances - _levels(distances, start)
    left_of_others = others - _levels(others, start)
    both = np.concatenate([left, left_of_others], axis=1)
    scatter = max(sigma, MAD_TO_SIGMA * float(np.nanmedian(np.abs(both))))
    steps, times = _median_steps(distances, start, scatter)
    _, usual = _median_steps(others, start, scatter)
    lines = _fitted_lines(distances)
    creeps = bool(np.nansum(np.abs(distances - lines)) < _DRIFT_SHARE * np.nansum(np.abs(left)))
    distance = np.max(np.nanmax(lines, axis=0) - np.nanmin(lines, axis=0)) if creeps else steps.max()
    return float(np.median(times) / max(np.median(usual), 1.0)), start, float(distance), creeps


def _seen_on_both_sides(distances: Array, start: int) -> Array:
    """(V, p) those of the distances that are seen on both sides."""
    seen = np.isfinite(distances)
    return distances[:, (seen[:start].sum(axis=0) >= _SIDE) & (seen[start:].sum(axis=0) >= _SIDE)]


def _levels(distances: Array, start: int) -> Array:
    """(V, p) medians before and from a view on."""
    sides = np.arange(len(distances))[:, None] < start
    return np.where(sides, nan_median(distances[:start]), nan_median(distances[start:]))


def _fitted_lines(distances: Array) -> Array:
    """Return (V, p) straight lines over the order of the views, through p distances (V, p) that may be NaN."""
    seen = np.isfinite(distances)
    order = np.where(seen, np.arange(len(distances))[:, None], np.nan)
    time = np.where(seen, order - np.nanmean(order, axis=0), 0.0)
    mean = np.nanmean(distances, axis=0)
    slope = np.sum(time * np.where(seen, distances - mean, 0.0), axis=0) / np.maximum(np.sum(time**2, axis=0), 1e-300)
    return np.where(seen, mean + slope * time, np.nan)


def _median_steps(distances: Array, start: int, scatter: float) -> tuple[Array, Array]:
    """Return the steps (p,) of the medians of p distances at view `start`, in length_unit and in standard errors.

    Args:
        distances: (V, p) length_unit, NaN where not seen.
        scatter: robust sigma of one distance, length_unit.
    """
    levels = _levels(distances, start)
    before = np.isfinite(distances[:start]).sum(axis=0)
    after = np.isfinite(distances[start:]).sum(axis=0)
    steps = np.abs(levels[-1] - levels[0])
    return steps, steps / (_MEDIAN * scatter * np.sqrt(1 / before + 1 / after))
