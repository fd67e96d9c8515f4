"""Labelled points beside clouds: gross errors out, and where the targets lie under the model that both fitted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.measurement.measurement import Measurement
from stitch.model.forward import corrected
from stitch.observations.targets.landmark_fit import fitted_landmarks, landmarks_covariance
from stitch.observations.targets.outliers import Outlier, find_outliers
from stitch.observations.targets.rows import rows_of
from stitch.stages.correct import Correction
from stitch.stages.target_fit import LabelledFit, rms_of
from stitch.stages.without_outliers import taken_out


@dataclass(frozen=True)
class Beside:
    """One session of a rig whose clouds and labelled points were fitted together."""

    measurement: Measurement  # with the sightings that count, and what the clouds weigh beside them
    found: LabelledFit | None  # None without labelled points
    outliers: tuple[Outlier, ...]


def fitted_beside(
    measurements: Sequence[Measurement], fit: Callable[[Sequence[Measurement]], Correction]
) -> tuple[Correction, list[Beside]]:
    """Fit, take out the labelled points that contradict the rest, and again, until none does.

    Raises:
        NoResultError: more than a third of the labelled points of a session would have to go.
    """
    measurements = [_with_everything(measurement) for measurement in measurements]
    taken = [list[Outlier]() for _ in measurements]
    while True:
        correction = fit(measurements)
        found = [placed_targets(measurement, correction) for measurement in measurements]
        worse = [find_outliers(f.rows, f.variances) if f else [] for f in found]
        if not any(worse):
            measurements = [
                weighed(measurement, own.noise_factor)
                for measurement, own in zip(measurements, correction.captures, strict=True)
            ]
            return correction, [Beside(c, f, tuple(o)) for c, f, o in zip(measurements, found, taken, strict=True)]
        measurements = [
            taken_out(measurement, w) if w else measurement for measurement, w in zip(measurements, worse, strict=True)
        ]
        taken = [[*before, *w] for before, w in zip(taken, worse, strict=True)]


def placed_targets(measurement: Measurement, correction: Correction) -> LabelledFit | None:
    """Targets in the middle of where the views put them under a fitted model; None without labelled points.

    Their covariance counts the scatter of the poses, the sensor's noise and the hand-eye.
    """
    if measurement.capture.sightings is None:
        return None
    hand_eye = correction.hand_eye
    own = corrected(measurement, correction.terms, hand_eye.T_mount)
    landmarks, blocks, variances = fitted_landmarks(own, hand_eye.T_mount)
    rows = rows_of(own, hand_eye.T_mount, landmarks)
    covariance = landmarks_covariance(blocks, rows, hand_eye.covariance)
    distances = rows.distances(rows.residual)
    return LabelledFit(
        hand_eye.T_mount, hand_eye.covariance, hand_eye.inflation, landmarks, covariance, correction.terms,
        correction.sigmas, variances, rows, np.full(distances.shape, np.nan), (rms_of(distances),),
    )  # fmt: skip


def _with_everything(measurement: Measurement) -> Measurement:
    s = measurement.capture.sightings
    return (
        measurement if s is None else replace(measurement, capture=replace(measurement.capture, sightings=s.everything))
    )


def weighed(measurement: Measurement, noise_factor: float) -> Measurement:
    """The chain with clouds that weigh as they were found to (`Capture.noise_factor`)."""
    return replace(measurement, capture=replace(measurement.capture, noise_factor=noise_factor))
