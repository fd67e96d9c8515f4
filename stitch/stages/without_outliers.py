"""The fit with gross errors taken out, one round after another."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import corrected
from stitch.observations.targets.landmarks import Drawing, initial_landmarks
from stitch.observations.targets.outliers import Outlier, find_outliers, outside
from stitch.stages.target_fit import LabelledFit, fit


def robust_fit(
    measurement: Measurement, terms: Sequence[Term], T_mount: Array, drawing: Drawing | None
) -> tuple[LabelledFit, Measurement, list[Outlier]]:
    """The fit with gross errors taken out; the chain that is left, and what was taken.

    Raises:
        NoResultError: more than a third of what was seen would have to go.
    """
    found: LabelledFit | None = None

    def examine(measurement: Measurement) -> LabelledFit:
        nonlocal found
        begin, T = (terms, T_mount) if found is None else (found.terms, found.T_mount)
        found = fit(measurement, begin, T, initial_landmarks(corrected(measurement, begin, T), T, drawing))
        return found

    return without_outliers(measurement, examine)


def without_outliers(
    measurement: Measurement, examine: Callable[[Measurement], LabelledFit]
) -> tuple[LabelledFit, Measurement, list[Outlier]]:
    """Examine a chain, take out what is off, and again, until nothing is.

    Raises:
        NoResultError: more than a third of what was seen would have to go.
    """
    assert measurement.capture.sightings is not None
    measurement = replace(
        measurement, capture=replace(measurement.capture, sightings=measurement.capture.sightings.everything)
    )
    taken = list[Outlier]()
    while True:
        found = examine(measurement)
        worse = find_outliers(found.rows, found.variances)
        if not worse:
            return found, measurement, taken
        taken += worse
        measurement = taken_out(measurement, worse)


def taken_out(measurement: Measurement, worse: Sequence[Outlier]) -> Measurement:
    """The chain without some of its labelled points.

    Raises:
        NoResultError: more than a third of what was seen would be gone.
    """
    sightings = measurement.capture.sightings
    assert sightings is not None
    used = outside(sightings.used, worse, sightings.targets, sightings.target)
    if used.sum() < 2 * sightings.everything.used.sum() / 3:
        raise NoResultError(
            f"{measurement.capture.name}: more than a third of the labelled points contradict the rest; check the "
            "names of the targets, the order of the views, mount and pose convention"
        )
    return replace(measurement, capture=replace(measurement.capture, sightings=replace(sightings, used=used)))
