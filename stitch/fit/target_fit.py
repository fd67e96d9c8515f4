"""Hand-eye, places of the targets and effects from labelled points: Gauss–Newton with REML of the poses' scatter.

Sessions of one arm share its effects and its scatter; each has a hand-eye and targets of its own. Under a model that is
given nothing is fitted but the places of targets that it does not know.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from stitch.fit.fit import WEAK, Step, fitted_parameters, iterate
from stitch.model.forward import corrected_capture
from stitch.model.model import (
    Model,
    Target,
    Term,
    kept_root,
    sizes_of,
    stack_parameters,
    values_of,
    with_fitted_effects,
    with_parameter_values,
)
from stitch.numerics.folds import grouped_folds, view_clusters
from stitch.numerics.frames import Array, Indices, Mask, exp
from stitch.numerics.least_squares import BlockLeastSquares, grouped_inflation
from stitch.numerics.parameter_selection import WhitenedData
from stitch.numerics.reml import MixedModel, fit_variances, whitener
from stitch.observations.targets.rows import (
    Landmarks,
    TargetRows,
    fit_landmarks,
    landmarks_covariance,
    target_rows,
)
from stitch.observations.targets.target_model import TargetModelFit, rms_of
from stitch.recorder import Recorder
from stitch.session.measurement import Measurement

_MAXIMUM_STEPS = 12
# A step that moves no unknown by so many sigmas is the last.
_CONVERGED = 0.02
# So many rows for each unknown, and variances can be estimated with all effects free.
_MIN_NUMBERS_PER_UNKNOWN = 3


def fit_targets(sessions: Sequence["TargetSession"], recorder: Recorder) -> list[TargetModelFit]:
    """Return per session its hand-eye, landmarks and the common effects, fitted together, with covariances.

    The covariance of the last step is multiplied by the inflation that views left out in groups ask for. To it are
    added the sigmas of another run's arm, if the model has one.

    Args:
        sessions: of one arm, about models that are near; their poses scatter alike.
        recorder: is shown every step of the first session.
    """

    def linearise(before: "TargetStep | None") -> LinearisedTargets:
        """Return the rows about the models of the first sessions, or after a step."""
        if before is None:
            return LinearisedTargets(list(sessions), None)
        return LinearisedTargets(before.solution.sessions, before.solution.variances)

    history: list[float] = []
    for step in iterate(linearise, at_most=_MAXIMUM_STEPS, converged=_CONVERGED):
        poses = step.linearised.sessions[0].rows.capture.poses(step.model.T_mount)
        recorder.iteration("fit", len(history), poses, step.rms, float("nan"))
        history.append(step.rms)
    equations = step.solution.equations
    left_out = np.array([equations.solve(group) for group in step.linearised.jackknife_groups])
    inflation = grouped_inflation(left_out, step.solution.covariance)
    # Another run's arm errs alike in every view, which no inflation covers.
    kept = kept_root(step.model.terms, sessions[0].model.effects_covariance)
    shift = equations.shift_by_errors(step.linearised.columns @ kept)
    covariance = step.solution.covariance * inflation + shift @ shift.T
    final_sessions = _with_covariances(step, covariance, kept)
    places = zip(step.linearised.unknowns_of, step.linearised.blocks_of, strict=True)
    return [
        TargetModelFit(
            model=final.model,
            inflation=inflation,
            landmarks=final.landmarks,
            landmarks_covariance=covariance[unknowns, unknowns][6:, 6:],
            variances=step.solution.variances,
            rows=final.rows,
            heldout=_heldout_distances(before.rows, equations, blocks),
            history=(*history, _rms_of_sessions([final])),
        )
        for before, final, (unknowns, blocks) in zip(step.linearised.sessions, final_sessions, places, strict=True)
    ]


def _with_covariances(step: "TargetStep", covariance: Array, kept: Array) -> "list[TargetSession]":
    """Return the sessions after a step, their models with the covariances of hand-eye and effects.

    Args:
        covariance: of all unknowns: those of each session, the hand-eye's six first, then the F effects' parameters
            that are fitted.
        kept: (P, L) root of the covariance of the parameters of another run's arm.
    """
    of_effects = slice(step.linearised.base.shape[2], None)
    sessions = []
    for session, unknowns in zip(step.solution.sessions, step.linearised.unknowns_of, strict=True):
        hand_eye = covariance[unknowns, unknowns][:6, :6]
        with_hand_eye = np.hstack([hand_eye, covariance[unknowns, of_effects][:6]])
        model = Model(session.model.T_mount, step.model.terms, hand_eye)
        of_fitted = covariance[of_effects, of_effects]
        model = with_fitted_effects(model, step.choice, of_fitted, kept, with_hand_eye)
        sessions.append(replace(session, model=model))
    return sessions


@dataclass(frozen=True)
class TargetSession:
    """The labelled points of one session about its model; P parameters of effects, the same in all sessions."""

    measurement: Measurement  # with the sightings that count
    model: Model
    landmarks: Landmarks

    @cached_property
    def rows(self) -> TargetRows:
        """What the points leave under the model, and how its hand-eye and landmarks move that."""
        capture = corrected_capture(self.measurement, self.model)
        return target_rows(capture, self.model.T_mount, self.landmarks)

    @cached_property
    def columns(self) -> Array:
        """(B, m, P) of the effects."""
        return self.rows.columns_in_use(self.measurement, self.model)

    @property
    def unknown_count(self) -> int:
        """Number of unknowns of the session alone: six of the hand-eye, then those of the landmarks."""
        return 6 + int(self.rows.landmarks.shape[2])

    def moved(self, x: Array, terms: tuple[Term, ...]) -> "TargetSession":
        """Return the session with its own unknowns moved by x (`unknown_count`,), and with other effects `terms`."""
        model = Model(self.model.T_mount @ exp(x[:6]), terms)
        return TargetSession(self.measurement, model, self.landmarks.updated(x[6:]))


@dataclass(frozen=True)
class TargetSolution:
    """The solution of one linear step."""

    sessions: list[TargetSession]  # after the step
    equations: BlockLeastSquares  # normal equations of the step
    # (U, U) of all unknowns: those of each session in turn, then the effects' parameters that are fitted.
    covariance: Array
    variances: Array  # (3,) of rotation scatter, translation scatter and the sensor's noise


@dataclass(frozen=True)
class LinearisedTargets:
    """Rows of targets of all sessions about their models: B blocks of m rows, one per view or nominal target."""

    sessions: list[TargetSession]
    start: Array | None  # (3,) variances of the step before; None in the first

    @cached_property
    def base(self) -> Array:
        """(B, m, a) columns of every session's hand-eye and landmarks."""
        return _block_columns([np.concatenate([s.rows.hand_eye, s.rows.landmarks], axis=2) for s in self.sessions])

    @cached_property
    def columns(self) -> Array:
        """(B, m, P) columns of the effects' parameters."""
        return _stack_blocks([session.columns for session in self.sessions])

    @property
    def unknowns_of(self) -> list[slice]:
        """Per session where its own unknowns stand among those of all sessions."""
        return _consecutive([session.unknown_count for session in self.sessions])

    @property
    def blocks_of(self) -> list[slice]:
        """Per session where its blocks stand among those of all sessions."""
        return _consecutive([len(session.columns) for session in self.sessions])

    @property
    def jackknife_groups(self) -> list[Indices]:
        """Clusters of views of each session, as numbers of blocks: groups that the jackknife leaves out in turn."""
        return [
            blocks.start + views
            for session, blocks in zip(self.sessions, self.blocks_of, strict=True)
            for views in view_clusters(session.rows.capture.T_base_flange, session.rows.reach)
        ]

    def choose(self, before: Mask | None) -> Mask:
        """Return a mask (P,) of the parameters to fit: see `fitted_parameters`.

        Args:
            before: (P,) those fitted in the step before; None in the first.
        """
        terms = self.sessions[0].model.terms
        before = np.zeros(self.columns.shape[2], bool) if before is None else before
        return fitted_parameters(terms, before, self._whitened)

    def solve(self, choice: Mask) -> "TargetStep":
        """Return the Gauss–Newton step of all unknowns, with the variances of scatter and noise estimated anew.

        Args:
            choice: (P,) mask of the parameters that are fitted; others become zero, but for those that are held.
        """
        terms = self.sessions[0].model.terms
        before, sizes = values_of(terms), sizes_of(terms)
        held = np.array([p.held for p in stack_parameters(terms)], bool)
        # A parameter that goes to zero changes the residuals by its column: z is corrected for that.
        stays = held | choice
        mixed = self._mixed_model(choice)
        mixed = replace(mixed, z=mixed.z + self.columns[..., ~stays] @ before[~stays])
        variances = fit_variances(mixed, start=self._starting_variances).variances
        equations = self._normal_equations(mixed, sizes[choice], before[choice], variances)
        x = equations.solve()
        covariance = equations.estimates_covariance()
        values = np.where(stays, before, 0.0)
        values[choice] += x[self.base.shape[2] :]
        terms = with_parameter_values(terms, values)
        moved = [session.moved(x[at], terms) for session, at in zip(self.sessions, self.unknowns_of, strict=True)]
        return Step(
            linearised=self,
            choice=choice,
            solution=TargetSolution(moved, equations, covariance, variances),
            model=moved[0].model,
            moved=float(np.max(np.abs(x) / np.sqrt(np.maximum(np.diag(covariance), 1e-300)))),
            rms=_rms_of_sessions(self.sessions),
        )

    def _mixed_model(self, free: Mask) -> MixedModel:
        """Return the mixed model of all sessions' rows; its free mean is hand-eyes, landmarks and some parameters.

        Args:
            free: (P,) mask of those parameters of the effects.
        """
        A = np.concatenate([self.base, self.columns[..., free]], axis=2)
        of_sessions = [
            session.rows.mixed_model(A[blocks, : session.rows.residual.shape[1]])
            for session, blocks in zip(self.sessions, self.blocks_of, strict=True)
        ]
        return _stack_mixed_models(of_sessions, A)

    @cached_property
    def _starting_variances(self) -> Array:
        """(3,) variances at which a fit of them begins: those of the step before, else fitted with all effects free.

        With few numbers, free effects would leave no scatter: then hand-eye and landmarks alone are free.
        """
        if self.start is not None:
            return self.start
        all_free = np.ones(self.columns.shape[2], bool)
        without_effects = self._mixed_model(~all_free)
        unknowns = self.base.shape[2] + self.columns.shape[2]
        enough = without_effects.size > _MIN_NUMBERS_PER_UNKNOWN * unknowns
        return fit_variances(self._mixed_model(all_free) if enough else without_effects, both_starts=True).variances

    def _whitened(self, free: Mask) -> WhitenedData:
        """Return columns of hand-eyes and landmarks, columns of effects, and observations, whitened.

        The scatter is estimated with the `free` parameters fitted: effects that are left out would count as scatter.
        All columns are whitened by the one covariance, so that parameters not fitted yet can be judged too. The
        observations are those of a model without effects: what the present values explain is added again.

        Args:
            free: (P,) mask of parameters of the effects.
        """
        mixed = self._mixed_model(free)
        inverse_root = whitener(mixed, fit_variances(mixed, start=self._starting_variances).variances)
        z = (mixed.z + self.columns @ values_of(self.sessions[0].model.terms))[..., None]
        base, further, white_z = (
            (inverse_root @ columns).reshape(mixed.z.size, columns.shape[2]) for columns in (self.base, self.columns, z)
        )
        return WhitenedData(base, further, white_z[:, 0])

    def _normal_equations(self, mixed: MixedModel, sizes: Array, values: Array, variances: Array) -> BlockLeastSquares:
        """Return the normal equations of a step from the present values; the prior of the effects is about zero.

        Args:
            mixed: rows of all sessions; its free mean is hand-eyes, landmarks and the F parameters fitted.
            sizes: (F,) plausible sizes of these parameters.
            values: (F,) where these are now.
            variances: (3,) of rotation scatter, translation scatter and the sensor's noise.
        """
        prior_sigmas = []
        for session in self.sessions:
            distance = float(np.median(np.linalg.norm(np.concatenate(session.rows.capture.point_sets), axis=1)))
            # A weak prior of 1 rad and one working distance keeps unseen unknowns finite and moves no others.
            prior_sigmas += [1.0] * 3 + [distance] * (session.unknown_count - 3)
        of_sessions = len(prior_sigmas)
        precision = np.concatenate([prior_sigmas, WEAK * sizes]) ** -2.0
        prior_vector = np.concatenate([np.zeros(of_sessions), -values * precision[of_sessions:]])
        return BlockLeastSquares(mixed.z, mixed.A, mixed.covariance(variances), precision, prior_vector)


TargetStep = Step[LinearisedTargets, TargetSolution]


def locate_targets(
    measurement: Measurement, model: Model, inflation: float, known: Mapping[str, Target] | None = None
) -> TargetModelFit:
    """Return the labelled points of a session, which has some, under a model that stays as it is.

    Their places are fitted by least squares, nothing else is. The covariance counts the scatter of the poses, the
    sensor's noise and the hand-eye; no held-out distances are computed (NaN).

    Args:
        inflation: of the hand-eye's covariance, only passed on.
        known: targets that keep their places and sigmas; None: all are fitted.
    """
    capture = corrected_capture(measurement, model)
    landmarks, blocks, variances = fit_landmarks(capture, model.T_mount)
    assert capture.sightings is not None
    names = capture.sightings.targets
    given = {names.index(name): target for name, target in (known or {}).items() if name in names}
    positions, orientation = landmarks.positions.copy(), landmarks.orientation
    for k, target in given.items():
        positions[k] = target.position
        if orientation is not None and target.orientation is not None:
            orientation = target.orientation
    landmarks = Landmarks(positions, orientation)
    rows = target_rows(capture, model.T_mount, landmarks)
    covariance = landmarks_covariance(blocks, rows, model.covariance).copy()
    for k, target in given.items():
        at = slice(3 * k, 3 * k + 3)
        covariance[at] = covariance[:, at] = 0.0
        covariance[at, at] = np.diag(target.sigma**2)
    distances = rows.distances(rows.residual)
    return TargetModelFit(
        model=model,
        inflation=inflation,
        landmarks=landmarks,
        landmarks_covariance=covariance,
        variances=variances,
        rows=rows,
        heldout=np.full(distances.shape, np.nan),
        history=(rms_of(distances),),
    )


def evaluate_targets(measurement: Measurement, model: Model) -> TargetModelFit:
    """Return the labelled points of a session under the model of another run, which stays as it is.

    Targets that the model knows have its places and sigmas; others are fitted by least squares. Since the views have
    not fitted the model, all distances are held-out ones.
    """
    fit = locate_targets(measurement, model, 1.0, model.targets)
    nothing = fit.rows.hand_eye[..., :0]
    variances = fit_variances(fit.rows.mixed_model(nothing), both_starts=True).variances
    return replace(fit, variances=variances, heldout=fit.distances)


def _rms_of_sessions(sessions: Sequence[TargetSession]) -> float:
    """Return the rms 3D distance (length_unit) of all sightings of the sessions from their targets' fitted places."""
    return rms_of(np.concatenate([s.rows.distances(s.rows.residual).ravel() for s in sessions]))


def _heldout_distances(rows: TargetRows, equations: BlockLeastSquares, blocks: slice) -> Array:
    """Return rms distances (V, S) of the targets, length_unit, in fits from which their views were left out.

    Views are left out in groups of neighbours in time or pose (`grouped_folds`); NaN where a target was not seen.

    Args:
        rows: of one session.
        equations: normal equations of the last step, of all sessions.
        blocks: where the blocks of this session stand among those of all.
    """
    square, count = np.zeros((2, *rows.distances(rows.residual).shape))
    m = rows.residual.shape[1]
    X, z = equations.X[blocks, :m], equations.z[blocks, :m]
    for fold in grouped_folds(rows.capture.T_base_flange, rows.reach):
        residual = X @ equations.solve(blocks.start + fold) - z
        square[fold] += rows.distances(residual)[fold] ** 2
        count[fold] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(square / count)


def _consecutive(lengths: Sequence[int]) -> list[slice]:
    """Return slices of these lengths, one after the other."""
    ends = np.cumsum([0, *lengths]).tolist()
    return [slice(first, end) for first, end in pairwise(ends)]


def _block_columns(columns: Sequence[Array]) -> Array:
    """Return the block-diagonal columns (ΣB, m, Σa) of all sessions from each session's own columns (B, m, a)."""
    if len(columns) == 1:
        return columns[0]
    wide = []
    for c, at in zip(columns, _consecutive([c.shape[2] for c in columns]), strict=True):
        block = np.zeros((*c.shape[:2], sum(other.shape[2] for other in columns)))
        block[..., at] = c
        wide.append(block)
    return _stack_blocks(wide)


def _stack_blocks(blocks: Sequence[Array]) -> Array:
    """Return the blocks (B, m, …) of several sessions as one (ΣB, m, …), smaller blocks filled up with zeros."""
    if len(blocks) == 1:
        return blocks[0]
    m = max(b.shape[1] for b in blocks)
    return np.concatenate([np.pad(b, [(0, 0), (0, m - b.shape[1]), *[(0, 0)] * (b.ndim - 2)]) for b in blocks])


def _stack_mixed_models(mixed: Sequence[MixedModel], A: Array) -> MixedModel:
    """Return the mixed models of sessions that scatter alike as one, with columns A (ΣB, m, a) of the free mean of all.

    Blocks are padded to the m rows of the largest.
    """
    if len(mixed) == 1:
        return mixed[0]
    m = max(model.z.shape[1] for model in mixed)

    def padded(matrices: Array, added_variance: float = 0.0) -> Array:
        """Return covariances (…, k, k) as (…, m, m); rows that are added have this variance, and no covariance."""
        added = m - matrices.shape[-1]
        out = np.pad(matrices, [*[(0, 0)] * (matrices.ndim - 2), (0, added), (0, added)])
        diagonal = np.arange(m - added, m)
        out[..., diagonal, diagonal] = added_variance
        return out

    fixed = [np.zeros((*o.z.shape, o.z.shape[1])) if o.fixed is None else o.fixed for o in mixed]
    return MixedModel(
        z=_stack_blocks([model.z for model in mixed]),
        A=A,
        components=np.concatenate([padded(model.components) for model in mixed], axis=1),
        # Rows that a session lacks: zeros of unit variance, which take part in nothing.
        fixed=np.concatenate([padded(matrices, added_variance=1.0) for matrices in fixed]),
        independent=sum(model.size for model in mixed),
    )
