"""Hand-eye, places of the targets and effects from labelled points: Gauss–Newton with REML of the poses' scatter."""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import covariance_of_fit, kept_root
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.model.term import known_sigmas, split, values_of
from stitch.observations.targets.effect_rows import effect_columns
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import Rows, rows_of
from stitch.observations.targets.target_fit import TargetFit
from stitch.runs.recorder import Recorder
from stitch.stages.fit import iterate
from stitch.stages.target_step import Linearised, Step, rms_of_rows
from stitch.statistics.block_least_squares import Blocks
from stitch.statistics.folds import grouped_folds, places


@dataclass(frozen=True)
class _Targets:
    """The labelled points of one session."""

    measurement: Measurement
    landmarks: Landmarks  # to begin with
    maximum_iterations: int = 12
    converged: float = 0.02

    def linearise(self, model: Model, previous: Step | None) -> Linearised:
        landmarks = self.landmarks if previous is None else previous.landmarks
        rows = rows_of(corrected(self.measurement, model), model.T_mount, landmarks)
        start = None if previous is None else previous.variances
        return Linearised(model, landmarks, rows, effect_columns(rows, self.measurement, model), start)


def fit_targets(
    measurement: Measurement, model: Model, landmarks: Landmarks, recorder: Recorder | None = None
) -> TargetFit:
    """Hand-eye, landmarks and effects together, from a start that is near.

    Args:
        measurement: with the sightings that count.
        model: effects in use with the values to begin with.
    """

    def watch(index: int, step: Step) -> None:
        if recorder is not None:
            poses = step.linearised.rows.capture.poses(step.model.T_mount)
            recorder.iteration("fit", index, poses, step.rms, float("nan"))

    last, history = iterate(_Targets(measurement, landmarks), model, watch)
    rows, a = last.linearised.rows, last.linearised.base.shape[2]
    inflation = last.blocks.inflation(places(rows.capture.T_reference_mount, rows.reach), last.covariance)
    covariance = last.covariance * inflation
    # Another run's arm is known to its own sigmas, and errs alike in every view.
    terms = last.model.terms
    kept = kept_root(terms, model.effects_covariance)
    moved = last.blocks.moved_by(last.linearised.columns @ kept)
    covariance = covariance + moved @ moved.T
    sigmas = known_sigmas(terms, last.fitted, np.sqrt(np.diag(covariance)[a:]))
    values = values_of(terms)
    model = Model(
        last.model.T_mount,
        split(terms, values, sigmas),
        covariance[:6, :6],
        effects_covariance=covariance_of_fit(terms, last.fitted, covariance[a:, a:], kept),
    )
    final = rows_of(corrected(measurement, model), model.T_mount, last.landmarks)
    return TargetFit(
        model=model,
        inflation=inflation,
        landmarks=last.landmarks,
        landmarks_covariance=covariance[6:a, 6:a],
        variances=last.variances,
        rows=final,
        heldout=_heldout(rows, last.blocks),
        history=(*history, rms_of_rows(final)),
    )


def _heldout(rows: Rows, blocks: Blocks) -> Array:
    """(V, S) distances of targets whose views were left out with their neighbours in time or pose."""
    square, count = np.zeros((2, *rows.distances(rows.residual).shape))
    for fold in grouped_folds(rows.capture.T_reference_mount, rows.reach):
        residual = rows.residual + blocks.X @ blocks.solve(fold)
        square[fold] += rows.distances(residual)[fold] ** 2
        count[fold] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(square / count))
