"""Hand-eye, places of the targets and effects from labelled points: Gauss–Newton with REML of the poses' scatter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.fit import WEAK, fitted_parameters, iterate
from stitch.model.forward import corrected_capture
from stitch.model.model import (
    Model,
    Term,
    covariance_of_fit,
    kept_root,
    known_sigmas,
    sizes_of,
    stack_parameters,
    values_of,
    with_parameter_values,
)
from stitch.numerics.folds import grouped_folds, view_clusters
from stitch.numerics.frames import Array, Indices, Mask, exp
from stitch.numerics.least_squares import BlockLeastSquares
from stitch.numerics.parameter_selection import WhitenedData
from stitch.numerics.reml import MixedModel, fit_variances, whitener
from stitch.observations.targets.outliers import Outlier, find_mislabelled, find_outliers, mask_outliers
from stitch.observations.targets.rows import (
    Landmarks,
    TargetRows,
    fit_landmarks,
    landmarks_covariance,
    target_rows,
)
from stitch.observations.targets.target_model import TargetModelFit, rms_of
from stitch.recorder import Recorder
from stitch.session.capture import Sightings
from stitch.session.measurement import Measurement

# Where labelled points lie under a model that is given: nothing is fitted but places that it does not know.


def locate_targets(measurement: Measurement, model: Model, inflation: float) -> TargetModelFit | None:
    """Targets in the middle of where the views put them under a model that clouds fitted; None without any.

    Their covariance counts the scatter of the poses, the sensor's noise and the hand-eye.
    """
    if measurement.capture.sightings is None:
        return None
    own = corrected_capture(measurement, model)
    landmarks, blocks, variances = fit_landmarks(own, model.T_mount)
    rows = target_rows(own, model.T_mount, landmarks)
    distances = rows.distances(rows.residual)
    return TargetModelFit(
        model=model,
        inflation=inflation,
        landmarks=landmarks,
        landmarks_covariance=landmarks_covariance(blocks, rows, model.covariance),
        variances=variances,
        rows=rows,
        heldout=np.full(distances.shape, np.nan),
        history=(rms_of(distances),),
    )


def evaluate_targets(measurement: Measurement, model: Model) -> TargetModelFit:
    """Rows and scatter under a model of another run; a target that it does not know sits where the views have it."""
    own = corrected_capture(measurement, model)
    free, blocks, _ = fit_landmarks(own, model.T_mount)
    assert own.sightings is not None
    landmarks = _with_known_places(free, own.sightings, model)
    rows = target_rows(own, model.T_mount, landmarks)
    nothing = rows.hand_eye[..., :0]
    covariance = landmarks_covariance(blocks, rows, model.covariance)
    distances = rows.distances(rows.residual)
    return TargetModelFit(
        model=model,
        inflation=1.0,
        landmarks=landmarks,
        landmarks_covariance=_with_known_sigmas(covariance, own.sightings, model),
        variances=fit_variances(rows.mixed_model(nothing), both_starts=True).variances,
        rows=rows,
        heldout=distances,
        history=(rms_of(distances),),
    )


def _with_known_sigmas(covariance: Array, sightings: Sightings, model: Model) -> Array:
    """The covariance (U, U) of the landmarks with the model's own sigmas for the targets that it knows."""
    out = covariance.copy()
    for k, name in enumerate(sightings.targets):
        if name in model.targets:
            at = slice(3 * k, 3 * k + 3)
            out[at] = out[:, at] = 0.0
            out[at, at] = np.diag(model.targets[name].sigma ** 2)
    return out


def _with_known_places(landmarks: Landmarks, sightings: Sightings, model: Model) -> Landmarks:
    """The landmarks with those of the model in their place."""
    positions, orientation = landmarks.positions.copy(), landmarks.orientation
    for k, name in enumerate(sightings.targets):
        if name in model.targets:
            positions[k] = model.targets[name].position
            if orientation is not None and model.targets[name].orientation is not None:
                orientation = model.targets[name].orientation
    return Landmarks(positions, orientation)


# The fit with outliers among labelled points taken out, one round after another, beside clouds or without.

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


# The labelled points of one session about a model, as a step of the fit takes them.


@dataclass(frozen=True)
class LinearisedTargetSession:
    """The labelled points of one session about its model; P parameters of effects, the same in all sessions."""

    model: Model
    landmarks: Landmarks
    rows: TargetRows
    columns: Array  # (B, m, P)

    @property
    def base(self) -> Array:
        """(B, m, a) columns of hand-eye and landmarks."""
        return np.concatenate([self.rows.hand_eye, self.rows.landmarks], axis=2)

    @property
    def unknowns(self) -> int:
        """Of the session alone."""
        return 6 + int(self.rows.landmarks.shape[2])

    def moved(self, x: Array, terms: tuple[Term, ...]) -> tuple[Model, Landmarks]:
        """Model and landmarks after a step x (a,) of its own unknowns, with the effects as they are then."""
        return Model(self.model.T_mount @ exp(x[:6]), terms), self.landmarks.updated(x[6:])


def rms_of_rows(rows: Sequence[TargetRows]) -> float:
    """3D distance of the targets from where they are, length_unit."""
    return rms_of(np.concatenate([own.distances(own.residual).ravel() for own in rows]))


# One step of the fit to labelled points: Gauss–Newton over rows about a model, with REML of the poses' scatter.
#
# Sessions of one arm share its effects and its scatter; each has a hand-eye and targets of its own.

_MIN_VIEWS_FOR_REML = 3  # numbers for each that is free


@dataclass(frozen=True)
class TargetFitStep:
    """Where a step ended, and from where it came."""

    models: list[Model]  # of each session
    moved: float  # of all unknowns, sigmas
    landmarks: list[Landmarks]
    linearised: "LinearisedTargets"
    fitted: Mask  # (P,) parameters of the effects
    blocks: BlockLeastSquares
    covariance: Array  # of all unknowns: those of each session, then the effects
    variances: Array  # (3,)

    @property
    def model(self) -> Model:
        """Of the first session; the effects are those of all."""
        return self.models[0]

    @property
    def rms(self) -> float:
        """3D, before the step."""
        return rms_of_rows([own.rows for own in self.linearised.sessions])


@dataclass(frozen=True)
class LinearisedTargets:
    """Rows of targets of all sessions about their models."""

    sessions: list[LinearisedTargetSession]
    start: Array | None  # (3,) variances of the step before

    @property
    def terms(self) -> tuple[Term, ...]:
        """Effects in use."""
        return self.sessions[0].model.terms

    @cached_property
    def base(self) -> Array:
        """(B, m, a) columns of every session's hand-eye and landmarks."""
        return block_columns([own.base for own in self.sessions])

    @cached_property
    def columns(self) -> Array:
        """(B, m, P) of the effects."""
        return stack_blocks([own.columns for own in self.sessions])

    @cached_property
    def values(self) -> Array:
        """(P,) of the effects at which the rows were taken."""
        return values_of(self.terms)

    @cached_property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return sizes_of(self.terms)

    @property
    def own(self) -> list[slice]:
        """Each session's own unknowns among all."""
        ends = [int(n) for n in np.cumsum([0, *(own.unknowns for own in self.sessions)])]
        return [slice(begin, end) for begin, end in pairwise(ends)]

    @property
    def begins(self) -> list[int]:
        """Of each session's blocks among all."""
        return [int(n) for n in np.cumsum([0, *(len(own.columns) for own in self.sessions)])[:-1]]

    def choose(self, before: Mask | None) -> Mask:
        """(P,) the parameters that the views ask for, those of before first."""
        before = np.zeros(len(self.values), bool) if before is None else before
        return fitted_parameters(self.terms, before, self._whitened)

    def solve(self, choice: Mask) -> TargetFitStep:
        """The step, with the variances of scatter and noise estimated anew."""
        held = np.array([p.held for p in stack_parameters(self.terms)], bool)
        # What the views cannot see goes to zero, and the rest must make up for it; the time of an event stays.
        stays = held | choice
        mixed = self._mixed(np.concatenate([self.base, self.columns[..., choice]], axis=2))
        mixed = replace(mixed, z=mixed.z + self.columns[..., ~stays] @ self.values[~stays])
        variances = self._variances(mixed)
        blocks = self._blocks(mixed, self.sizes[choice], self.values[choice], variances)
        x, covariance, a = blocks.solve(), blocks.estimates_covariance(), self.base.shape[2]
        values = np.where(stays, self.values, 0.0)
        values[choice] += x[a:]
        moved = float(np.max(np.abs(x) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))))
        terms = with_parameter_values(self.terms, values)
        every = [session.moved(x[own], terms) for session, own in zip(self.sessions, self.own, strict=True)]
        return TargetFitStep(
            models=[model for model, _ in every],
            moved=moved,
            landmarks=[landmarks for _, landmarks in every],
            linearised=self,
            fitted=choice,
            blocks=blocks,
            covariance=covariance,
            variances=variances,
        )

    def _mixed(self, A: Array) -> MixedModel:
        """With the columns A (B, m, a) as free mean."""
        every = []
        for session, begin in zip(self.sessions, self.begins, strict=True):
            B, m = session.rows.residual.shape
            every.append(session.rows.mixed_model(A[begin : begin + B, :m]))
        return stack_mixed_models(every, A)

    def _variances(self, mixed: MixedModel) -> Array:
        """(3,) by REML."""
        return fit_variances(mixed, start=self._starting_variances).variances

    @cached_property
    def _starting_variances(self) -> Array:
        """(3,) variances from which any search begins: of the step before, or where all effects take what they can."""
        if self.start is not None:
            return self.start
        every = np.concatenate([self.base, self.columns], axis=2)
        # Of few numbers all effects leave no scatter to be seen.
        enough = self._mixed(self.base).size > _MIN_VIEWS_FOR_REML * every.shape[2]
        return fit_variances(self._mixed(every if enough else self.base), both_starts=True).variances

    def _whitened(self, free: Mask) -> WhitenedData:
        mixed = self._mixed(self.base)
        beside = self._mixed(np.concatenate([self.base, self.columns[..., free]], axis=2))
        half = whitener(mixed, self._variances(beside))
        z = (mixed.z + self.columns @ self.values)[..., None]
        n = mixed.z.size
        base, further, seen = ((half @ c).reshape(n, c.shape[2]) for c in (self.base, self.columns, z))
        return WhitenedData(base, further, seen[:, 0])

    def _blocks(self, mixed: MixedModel, sizes: Array, values: Array, variances: Array) -> BlockLeastSquares:
        """The step's normal equations; the prior of the effects is about zero, not about their present values."""
        far = []
        for own in self.sessions:
            distance = float(np.median(np.linalg.norm(np.concatenate(own.rows.capture.point_sets), axis=1)))
            # One radian and one working distance: keeps the unseen finite, moves nothing else.
            far += [1.0] * 3 + [distance] * (own.unknowns - 3)
        precision = np.concatenate([far, WEAK * sizes]) ** -2.0
        pull = np.concatenate([np.zeros(len(far)), -values * precision[len(far) :]])
        return BlockLeastSquares(mixed.z, mixed.A, mixed.covariance(variances), precision, pull)


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
    return LinearisedTargetSession(model, landmarks, rows, rows.columns_in_use(measurement, model))


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
    return view_clusters(rows.capture.T_base_flange, rows.reach)


def _heldout(rows: TargetRows, blocks: BlockLeastSquares, begins: int) -> Array:
    """(V, S) distances of targets whose views were left out with their neighbours in time or pose.

    Args:
        begins: of the session among the blocks of all.
    """
    square, count = np.zeros((2, *rows.distances(rows.residual).shape))
    B, m = rows.residual.shape
    X, z = blocks.X[begins : begins + B, :m], blocks.z[begins : begins + B, :m]
    for fold in grouped_folds(rows.capture.T_base_flange, rows.reach):
        residual = X @ blocks.solve(begins + fold) - z
        square[fold] += rows.distances(residual)[fold] ** 2
        count[fold] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(square / count))


# Blocks of several sessions as those of one: numbers that the smaller blocks lack are absent.


def block_columns(columns: Sequence[Array]) -> Array:
    """(ΣB, m, Σa) columns (B, m, a) of unknowns that every session has for itself."""
    if len(columns) == 1:
        return columns[0]
    widths = np.cumsum([0, *(c.shape[2] for c in columns)])
    every = []
    for c, at in zip(columns, widths[:-1], strict=True):
        wide = np.zeros((*c.shape[:2], widths[-1]))
        wide[..., at : at + c.shape[2]] = c
        every.append(wide)
    return stack_blocks(every)


def stack_blocks(blocks: Sequence[Array]) -> Array:
    """(ΣB, m, …) blocks (B, m, …) of several sessions."""
    if len(blocks) == 1:
        return blocks[0]
    m = max(b.shape[1] for b in blocks)
    return np.concatenate([np.pad(b, [(0, 0), (0, m - b.shape[1]), *[(0, 0)] * (b.ndim - 2)]) for b in blocks])


def stack_mixed_models(mixed: Sequence[MixedModel], A: Array) -> MixedModel:
    """Mixed models of sessions that scatter alike, with columns A (ΣB, m, a) of the free mean of all."""
    if len(mixed) == 1:
        return mixed[0]
    m = max(own.z.shape[1] for own in mixed)

    def wide(matrices: Array, absent: float = 0.0) -> Array:
        lacking = m - matrices.shape[-1]
        out = np.pad(matrices, [*[(0, 0)] * (matrices.ndim - 2), (0, lacking), (0, lacking)])
        more = np.arange(m - lacking, m)
        out[..., more, more] = absent
        return out

    fixed = [np.zeros((*own.z.shape, own.z.shape[1])) if own.fixed is None else own.fixed for own in mixed]
    return MixedModel(
        z=stack_blocks([own.z for own in mixed]),
        A=A,
        components=np.concatenate([wide(own.components) for own in mixed], axis=1),
        fixed=np.concatenate([wide(own, absent=1.0) for own in fixed]),
        independent=sum(own.size for own in mixed),
    )
