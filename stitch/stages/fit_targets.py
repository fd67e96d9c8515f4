"""Hand-eye, places of the targets and effects from labelled points: Gauss–Newton with REML of the poses' scatter."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array, Mask, exp
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import covariance_of_fit, kept_root
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.model.term import known_sigmas, split, stacked
from stitch.observations.targets.effect_rows import effect_columns
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import Rows, mixed_model_of_rows, rows_of
from stitch.observations.targets.target_fit import TargetFit, rms_of
from stitch.runs.recorder import Recorder
from stitch.stages.fit import WEAK, fitted_parameters, iterate
from stitch.statistics.block_least_squares import Blocks
from stitch.statistics.folds import grouped_folds, places
from stitch.statistics.parameter_selection import Whitened
from stitch.statistics.variance_components import fit_variances, whitener


@dataclass(frozen=True)
class _Step:
    model: Model
    moved: float
    landmarks: Landmarks
    linearised: "_Linearised"
    fitted: Mask  # (P,) parameters of the effects
    blocks: Blocks
    covariance: Array  # of all unknowns
    variances: Array  # (3,)

    @property
    def rms(self) -> float:
        """3D, before the step."""
        return _rms(self.linearised.rows)


@dataclass(frozen=True)
class _Linearised:
    """Rows of targets about a model; P parameters of effects."""

    model: Model
    landmarks: Landmarks
    rows: Rows
    columns: Array  # (B, m, P)
    start: Array | None  # (3,) variances of the step before

    @cached_property
    def base(self) -> Array:
        """(B, m, a) columns of hand-eye and landmarks."""
        return np.concatenate([self.rows.hand_eye, self.rows.landmarks], axis=2)

    @cached_property
    def values(self) -> Array:
        """(P,) of the effects at which the rows were taken."""
        return np.array([p.value for p in stacked(self.model.terms)], float)

    @cached_property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return np.array([p.typical for p in stacked(self.model.terms)], float)

    def choose(self, before: Mask | None) -> Mask:
        before = np.zeros(len(self.values), bool) if before is None else before
        return fitted_parameters(self.model.terms, before, self._whitened)

    def solve(self, choice: Mask) -> _Step:
        X = np.concatenate([self.base, self.columns[..., choice]], axis=2)
        variances = self._variances(X)
        blocks = self._blocks(X, self.sizes[choice], self.values[choice], variances)
        x, covariance, a = blocks.solve(), blocks.estimates_covariance(), self.base.shape[2]
        held, values = np.array([p.held for p in stacked(self.model.terms)], bool), self.values.copy()
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[np.logical_not(held | choice)] = 0.0
        values[choice] += x[a:]
        model = Model(self.model.T_mount @ exp(x[:6]), split(self.model.terms, values))
        moved = float(np.max(np.abs(x) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))))
        landmarks = self.landmarks.moved(x[6:a])
        return _Step(model, moved, landmarks, self, choice, blocks=blocks, covariance=covariance, variances=variances)

    def _variances(self, A: Array) -> Array:
        """(3,) by REML with the columns A (B, m, a) as free mean."""
        mixed = mixed_model_of_rows(self.rows, A)
        return fit_variances(mixed, start=self.start, both_starts=self.start is None).variances

    def _whitened(self, free: Mask) -> Whitened:
        mixed = mixed_model_of_rows(self.rows, self.base)
        half = whitener(mixed, self._variances(np.concatenate([self.base, self.columns[..., free]], axis=2)))
        z = (mixed.z + self.columns @ self.values)[..., None]
        n = self.rows.residual.size
        base, further, seen = ((half @ c).reshape(n, c.shape[2]) for c in (self.base, self.columns, z))
        return Whitened(base, further, seen[:, 0])

    def _blocks(self, X: Array, sizes: Array, values: Array, variances: Array) -> Blocks:
        """The step's normal equations; the prior of the effects is about zero, not about their present values."""
        mixed = mixed_model_of_rows(self.rows, X)
        distance = float(np.median(np.linalg.norm(np.concatenate(self.rows.capture.point_sets), axis=1)))
        unknown = X.shape[2] - len(sizes)
        # One radian and one working distance: keeps the unseen finite, moves nothing else.
        far = np.concatenate([[1.0] * 3, [distance] * (unknown - 3)])
        precision = np.concatenate([far, WEAK * sizes]) ** -2.0
        pull = np.concatenate([np.zeros(unknown), -values * precision[unknown:]])
        return Blocks(mixed.z, X, mixed.covariance(variances), precision, pull)


@dataclass(frozen=True)
class _Targets:
    """The labelled points of one session."""

    measurement: Measurement
    landmarks: Landmarks  # to begin with
    maximum_iterations: int = 12
    converged: float = 0.02

    def linearise(self, model: Model, previous: _Step | None) -> _Linearised:
        landmarks = self.landmarks if previous is None else previous.landmarks
        rows = rows_of(corrected(self.measurement, model), model.T_mount, landmarks)
        start = None if previous is None else previous.variances
        return _Linearised(model, landmarks, rows, effect_columns(rows, self.measurement, model), start)


def fit_targets(
    measurement: Measurement, model: Model, landmarks: Landmarks, recorder: Recorder | None = None
) -> TargetFit:
    """Hand-eye, landmarks and effects together, from a start that is near.

    Args:
        measurement: with the sightings that count.
        model: effects in use with the values to begin with.
    """

    def watch(index: int, step: _Step) -> None:
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
    values = np.array([p.value for p in stacked(last.model.terms)], float)
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
        history=(*history, _rms(final)),
    )


def _rms(rows: Rows) -> float:
    return rms_of(rows.distances(rows.residual))


def _heldout(rows: Rows, blocks: Blocks) -> Array:
    """(V, S) distances of targets whose views were left out with their neighbours in time or pose."""
    square, count = np.zeros((2, *rows.distances(rows.residual).shape))
    for fold in grouped_folds(rows.capture.T_reference_mount, rows.reach):
        residual = rows.residual + blocks.X @ blocks.solve(fold)
        square[fold] += rows.distances(residual)[fold] ** 2
        count[fold] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(square / count))
