"""The fit with outliers among labelled points taken out, one round after another, beside clouds or without."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from stitch.errors import NoResultError
from stitch.measurement.measurement import Measurement
from stitch.observations.targets.mislabelled import find_mislabelled
from stitch.observations.targets.outliers import Outlier, find_outliers, mask_outliers
from stitch.observations.targets.target_fit import TargetModelFit

# More outliers than this share of what was seen, and it is the rest that is wrong.
_MOST = 1 / 3

FitResult = TypeVar("FitResult")


@dataclass(frozen=True)
class FittedSession:
    """One session after the fit, as far as its labelled points are concerned."""

    measurement: Measurement  # with the sightings that count
    targets: TargetModelFit | None  # None without labelled points
    outliers: tuple[Outlier, ...]


def fit_without_outliers(
    measurements: Sequence[Measurement],
    fit: Callable[[Sequence[Measurement], FitResult | None], FitResult],
    targets_of: Callable[[Sequence[Measurement], FitResult], Sequence[TargetModelFit | None]],
) -> tuple[FitResult, list[FittedSession]]:
    """Fit, take out the labelled points that contradict the rest, and again, until none does.

    Args:
        fit: from the measurements, and what the round before found, to what is found.
        targets_of: the labelled points of every session under that.

    Raises:
        NoResultError: more than a third of the labelled points of a session would have to go.
    """
    measurements = [_with_all_points(m) for m in measurements]
    taken = [_mislabelled_views(m) for m in measurements]
    measurements = [_remove_points(m, t) if t else m for m, t in zip(measurements, taken, strict=True)]
    found: FitResult | None = None
    while True:
        found = fit(measurements, found)
        targets = targets_of(measurements, found)
        worse = [find_outliers(t.rows, t.variances) if t else [] for t in targets]
        if not any(worse):
            fitted = zip(measurements, targets, taken, strict=True)
            return found, [FittedSession(m, t, tuple(o)) for m, t, o in fitted]
        measurements = [_remove_points(m, w) if w else m for m, w in zip(measurements, worse, strict=True)]
        taken = [[*before, *w] for before, w in zip(taken, worse, strict=True)]


def _with_all_points(measurement: Measurement) -> Measurement:
    s = measurement.capture.sightings
    if s is None:
        return measurement
    return replace(measurement, capture=replace(measurement.capture, sightings=s.with_outliers))


def _mislabelled_views(measurement: Measurement) -> list[Outlier]:
    """Views whose targets bear each other's names: they would pull the fit to where these lie."""
    s = measurement.capture.sightings
    return [] if s is None else [m.outlier for m in find_mislabelled(s)]


def _remove_points(measurement: Measurement, worse: Sequence[Outlier]) -> Measurement:
    """The measurement without some of its labelled points."""
    sightings = measurement.capture.sightings
    assert sightings is not None
    used = mask_outliers(sightings.used, worse, sightings.targets, sightings.target)
    if used.sum() < (1 - _MOST) * sightings.with_outliers.used.sum():
        raise NoResultError(
            f"{measurement.capture.name}: more than a third of the labelled points contradict the rest; check the "
            "names of the targets, the order of the views, mount and pose convention"
        )
    return replace(measurement, capture=replace(measurement.capture, sightings=replace(sightings, used=used)))
