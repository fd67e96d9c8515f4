"""Hand-eye, places of the targets and effects from labelled points: Gauss–Newton with REML of the poses' scatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import covariance_of_fit, kept_root
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.term import known_sigmas, values_of, with_parameter_values
from stitch.observations.targets.effect_rows import effect_columns
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import TargetRows, target_rows
from stitch.observations.targets.target_fit import TargetModelFit
from stitch.runs.recorder import Recorder
from stitch.stages.fit import iterate
from stitch.stages.sighted import LinearisedTargetSession, rms_of_rows
from stitch.stages.target_step import LinearisedTargets, TargetFitStep
from stitch.statistics.block_least_squares import BlockLeastSquares
from stitch.statistics.folds import grouped_folds, view_clusters


@dataclass(frozen=True)
class TargetStart:
    """One session before the fit: what was measured, and from where its own unknowns begin."""

    measurement: Measurement  # with the sightings that count
    model: Model  # effects in use with the values to begin with, the same in all sessions
    landmarks: Landmarks


@dataclass(frozen=True)
class _TargetProblem:
    """The labelled points of all sessions of an arm."""

    sessions: Sequence[TargetStart]
    maximum_iterations: int = 12
    converged: float = 0.02

    def linearise(self, model: Model, previous: TargetFitStep | None) -> LinearisedTargets:
        if previous is None:
            return LinearisedTargets(
                [_linearise_session(own.measurement, own.model, own.landmarks) for own in self.sessions], None
            )
        every = zip(self.sessions, previous.models, previous.landmarks, strict=True)
        return LinearisedTargets(
            [_linearise_session(own.measurement, at, landmarks) for own, at, landmarks in every], previous.variances
        )


def _linearise_session(measurement: Measurement, model: Model, landmarks: Landmarks) -> LinearisedTargetSession:
    rows = target_rows(corrected_capture(measurement, model), model.T_mount, landmarks)
    return LinearisedTargetSession(model, landmarks, rows, effect_columns(rows, measurement, model))


def fit_targets(sessions: Sequence[TargetStart], recorder: Recorder | None = None) -> list[TargetModelFit]:
    """Hand-eyes, landmarks and common effects together, from a start that is near; one result a session.

    Args:
        sessions: of one arm; their poses scatter alike.
        recorder: shows the first of them.
    """

    def watch(index: int, step: TargetFitStep) -> None:
        if recorder is not None:
            poses = step.linearised.sessions[0].rows.capture.poses(step.model.T_mount)
            recorder.iteration("fit", index, poses, step.rms, float("nan"))

    last, history = iterate(_TargetProblem(sessions), sessions[0].model, watch)
    lin, terms = last.linearised, last.model.terms
    a = lin.base.shape[2]
    groups = [at + g for own, at in zip(lin.sessions, lin.begins, strict=True) for g in _places(own.rows)]
    inflation = last.blocks.inflation(groups, last.covariance)
    covariance = last.covariance * inflation
    # Another run's arm is known to its own sigmas, and errs alike in every view.
    kept = kept_root(terms, sessions[0].model.effects_covariance)
    moved = last.blocks.shift_by_errors(lin.columns @ kept)
    covariance = covariance + moved @ moved.T
    sigmas = known_sigmas(terms, last.fitted, np.sqrt(np.diag(covariance)[a:]))
    found = with_parameter_values(terms, values_of(terms), sigmas)
    of_effects = covariance_of_fit(terms, last.fitted, covariance[a:, a:], kept)
    out = list[TargetModelFit]()
    for k, (begun, own) in enumerate(zip(sessions, lin.sessions, strict=True)):
        mine = covariance[lin.own[k], lin.own[k]]
        model = Model(last.models[k].T_mount, found, mine[:6, :6], effects_covariance=of_effects)
        final = target_rows(corrected_capture(begun.measurement, model), model.T_mount, last.landmarks[k])
        out.append(
            TargetModelFit(
                model=model,
                inflation=inflation,
                landmarks=last.landmarks[k],
                landmarks_covariance=mine[6:, 6:],
                variances=last.variances,
                rows=final,
                heldout=_heldout(own.rows, last.blocks, lin.begins[k]),
                history=(*history, rms_of_rows([final])),
            )
        )
    return out


def _places(rows: TargetRows) -> list[Indices]:
    return view_clusters(rows.capture.T_reference_mount, rows.reach)


def _heldout(rows: TargetRows, blocks: BlockLeastSquares, begins: int) -> Array:
    """(V, S) distances of targets whose views were left out with their neighbours in time or pose.

    Args:
        begins: of the session among the blocks of all.
    """
    square, count = np.zeros((2, *rows.distances(rows.residual).shape))
    B, m = rows.residual.shape
    X, z = blocks.X[begins : begins + B, :m], blocks.z[begins : begins + B, :m]
    for fold in grouped_folds(rows.capture.T_reference_mount, rows.reach):
        residual = X @ blocks.solve(begins + fold) - z
        square[fold] += rows.distances(residual)[fold] ** 2
        count[fold] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(square / count))
