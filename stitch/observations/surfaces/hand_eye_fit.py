"""The hand-eye and the effects in use from free-network views: generalised least squares, covariance, held-out error.

No number of points averages out the error of a pose: views are the samples, and they weigh by the scatter that they
show, so that what remains is as small as it can be. The per-view twists δ̂ (`view_poses.py`) are reduced to the
directions that the overlaps can see, z, with covariance σ_r² T_r + σ_t² T_t + c σ² H⁺: rotation and translation scatter
of the flange, and a factor on the noise within overlaps, whose errors are correlated; restricted maximum likelihood
tells the three (Patterson & Thompson 1971, Harville 1977).

What an arm does wrong it does again: no number of views averages that out. `pose_errors.py` says how poses may err, the
views say how much, and that is what the covariance of hand-eye and effects counts. Errors of the scanner that repeat in
every view come on top.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, null_space

from stitch.numerics import frames
from stitch.numerics.folds import grouped_folds
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import (
    column_space,
    generalised_fit,
    project_out,
    summed_squares,
)
from stitch.numerics.parameter_selection import WhitenedData
from stitch.numerics.reml import MixedModel, fit_variances
from stitch.numerics.variance_posterior import mean_variances
from stitch.observations.linear_model import WHITE_COMPONENTS
from stitch.observations.observability import seen_part, visible_twists
from stitch.observations.pose_errors import JOINT_SCATTER, PoseErrors, white_scatter_only
from stitch.observations.surfaces.normal_equations import Gram, pair_squares
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import Capture
from stitch.system.values import Value, take_rows

# Errors of the scanner that all views repeat, by their name among the sources of the hand-eye's variance.
SCANNER_FIELD, SCANNER_SCALE = "scanner field", "scanner scale"
# From so many numbers the variances of white scatter are known well enough: their maximum is used, not their mean.
_PLUG_IN = 300
# Combinations of hand-eye and effects weaker than this share of the strongest are unobservable.
_OBSERVABLE_SHARE = 1e-6
# Factor on the prior's precision along directions that the motions do not show: there the hand-eye does not move.
_HELD = 1e12


@dataclass(frozen=True, eq=False)
class Repeatability(Value):
    """Standard deviations of the flange poses and the factor on the noise within overlaps.

    Example:
        >>> 0 < run.repeatability.translation < 0.1  # length_unit
        True
    """

    rotation: float  # rad
    translation: float  # length_unit
    noise_factor: float

    @property
    def variances(self) -> Array:
        """(3,) variances of rotation (rad²) and translation (length_unit²), and the noise factor."""
        return np.array([self.rotation**2, self.translation**2, self.noise_factor])


@dataclass(frozen=True)
class ReducedPoses:
    """The poses of the views as n numbers z: their twists along the directions that overlaps and common targets see.

    Twists are left twists about the centre of the overlaps, from the model's poses to those that the overlaps alone
    give.
    """

    reduction: Array  # (n, 6V) from twists of the views to visible directions
    expansion: Array  # (6V, n) back to the shortest twists, a radian as long as what it moves at the part
    z: Array  # (n,) observed twists, reduction @ twists
    hand_eye: Array  # (n, 6) response to the hand-eye's ξ
    # (3, n, n) covariances of unit rotation scatter and unit translation scatter of the flange, and of the sensor noise
    # within overlaps: `WHITE_COMPONENTS`.
    components: Array


@dataclass(frozen=True)
class CaptureEvidence:
    """What one capture says about hand-eye and effects: sums over its pairs of views, and its free-network poses."""

    capture: Capture
    gram: Gram
    twists: Array  # (V, 6) left twists about the Gram's centre, from the model's poses to the free-network poses
    T_mount: Array  # (4, 4) hand-eye about which all is linear
    effect_twists: Array  # (6V, P) left twists of the views per unit of each effect's parameter
    common_twists: Array  # (6V, K) per sigma of errors of several scanners that the fit counts; K = 0 for one scanner

    @cached_property
    def reduced_poses(self) -> ReducedPoses:
        """The twists reduced to the directions that the overlaps see, linearised about the hand-eye."""
        return reduce_poses(self.capture, self.gram, self.twists, self.T_mount)

    @property
    def effect_columns(self) -> Array | None:
        """(n, P) change of the reduced poses per unit of each effect's parameter; None without effects."""
        return self.reduced_poses.reduction @ self.effect_twists if self.effect_twists.shape[1] else None

    @property
    def common_columns(self) -> Array:
        """(n, K) change of the reduced poses per sigma of each error of `common_twists`."""
        return self.reduced_poses.reduction @ self.common_twists

    def without(self, views: Indices) -> "CaptureEvidence":
        """Return the evidence without some views, given by their numbers, and without all pairs that they are in."""
        g = self.gram
        keep = np.asarray(~np.isin(g.pairs, views).any(axis=1))
        stays = ~np.isin(np.arange(g.views), views)
        number = np.cumsum(stays) - 1
        gram = replace(g.only(keep), views=g.views - len(views), pairs=number[g.pairs[keep]])
        kept = take_rows(self, stays, "twists")
        kept = take_rows(kept, np.repeat(stays, 6), "effect_twists", "common_twists")
        return replace(kept, capture=self.capture.without(views), gram=gram)

    def squares(self, views: Indices, corrections: Sequence[Array]) -> Array:
        """Return (K,) Σ w e² per correction of the robot's poses, over the pairs that `views` are in.

        e are the distances that the correction leaves between corresponding points, length_unit.

        Args:
            views: their numbers.
            corrections: K, each (6 + P,): twist of the hand-eye, then changes of the effects' parameters.
        """
        touched = np.isin(self.gram.pairs, views).any(axis=1)
        J = np.column_stack([hand_eye_jacobian(self.capture, self.T_mount, self.gram.centre), self.effect_twists])
        # The sums are at the free-network poses, which are `twists` away from the model's.
        from_free = [(J @ x).reshape(-1, 6) - self.twists for x in corrections]
        return np.array([pair_squares(self.gram, twists)[touched].sum() for twists in from_free])


@dataclass(frozen=True)
class RigModel:
    """The model z = X β + e of all sessions of a rig: N visible directions, β of hand-eye (6) and effects (P)."""

    parts: Sequence[CaptureEvidence]

    @cached_property
    def z(self) -> Array:
        """(N,) reduced poses of all sessions, one after the other."""
        return np.concatenate([e.reduced_poses.z for e in self.parts])

    @cached_property
    def columns(self) -> Array:
        """(N, 6 + P) columns X of hand-eye and effects."""
        reduced = [(e.reduced_poses, e.effect_twists) for e in self.parts]
        return np.concatenate([np.column_stack([r.hand_eye, r.reduction @ twists]) for r, twists in reduced])

    def fit_gls(self, scatter: Sequence[Repeatability], prior: Array) -> tuple[Array, Array]:
        """Return gain and covariance (`generalised_fit`) of β (6 + P,) in z = X β + e, cov e block-diagonal by session.

        Args:
            scatter: per session the scatter of the flange and the noise factor, which give its block of cov e.
            prior: (6 + P, 6 + P) precision of a normal prior of β.
        """
        noise = [
            pose_covariance(e.reduced_poses, s) + e.common_columns @ e.common_columns.T
            for e, s in zip(self.parts, scatter, strict=True)
        ]
        return generalised_fit(block_diag(*noise), self.columns, prior)

    def mixed(self, errors: PoseErrors) -> MixedModel:
        """Return z = X β + e with cov e = Σ λ_i C_i as one block of all sessions, since an arm errs alike in all.

        C are those of rotation scatter, translation scatter and noise, then one per pose error.

        Args:
            errors: components (6V, 6V) of the twists of all views of the rig, session after session.
        """
        reduced = [e.reduced_poses for e in self.parts]
        white = [block_diag(*of_sessions) for of_sessions in zip(*(r.components for r in reduced), strict=True)]
        R = block_diag(*(r.reduction for r in reduced))
        components = np.array([*white, *(R @ C @ R.T for C in errors.components)])
        shared = block_diag(*(e.common_columns @ e.common_columns.T for e in self.parts))[None]
        further = errors.prior if errors.names else None
        mixed = MixedModel(self.z[None], mean_basis(self.columns)[None], components[:, None], further=further)
        return replace(mixed, fixed=shared) if shared.any() else mixed

    def reduce(self, twists: Sequence[Array]) -> Array:
        """Return the visible directions (N, K) of twists, given as (6V, K) per session."""
        return np.concatenate([e.reduced_poses.reduction @ t for e, t in zip(self.parts, twists, strict=True)])


@dataclass(frozen=True)
class FittedEffects:
    """P parameters of effects that are fitted together with the hand-eye."""

    twists: tuple[Array, ...]  # per capture (6V, P): left twists about the centre of its Gram matrices
    values: Array  # (P,) at which they were computed
    prior: Array  # (P,) standard deviation of a weak prior about zero


@dataclass(frozen=True)
class HandEyeSolution:
    """The linear problem of hand-eye and effects, and its solution x (6 + P,): a twist ξ, then changes of the
    parameters.
    """

    rig: RigModel
    scatter: tuple[Repeatability, ...]  # per session
    prior: Array  # (6 + P, 6 + P) precision
    prior_vector: Array  # (6 + P,) precision times mean
    gain: Array  # (6 + P, N) from z to x
    covariance: Array  # (6 + P, 6 + P) of x under white scatter and prior
    x: Array
    values: Array  # (P,) of the parameters before the step
    hidden: Array  # (6, m) twists of the hand-eye that the motions do not show, one sigma of the weak prior each
    T_mount: Array  # (4, 4) after the step


@dataclass(frozen=True)
class HandEyeFit:
    """Hand-eye and its statistics; covariances are those of right perturbations T·exp(ξ), rad before length_unit."""

    T_mount: Array  # (4, 4) T_mount_scanner
    covariance: Array  # (6, 6)
    inflation: float  # of the covariance over that of independent pose errors, geometric mean over directions, ≥ 1
    repeatability: tuple[Repeatability, ...]  # per capture
    heldout_ratio: float  # rms of left-out views over rms of the fit, same correspondences
    # Shares of what may be wrong in the variance of its rotation and of its position; each adds up to 1.
    rotation_shares: dict[str, float] = field(default_factory=dict)
    position_shares: dict[str, float] = field(default_factory=dict)
    # Degrees of freedom: visible directions less hand-eye and effects; None where the hand-eye is another run's.
    degrees: int | None = None
    values: Array = field(default_factory=lambda: np.zeros(0))  # (P,) of the effects' parameters
    values_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (P, P)
    # (6, 6 + P) of ξ with itself and the parameters, without the prior's part in directions that no motion shows.
    visible_covariance: Array = field(default_factory=lambda: np.zeros((6, 0)))


def hand_eye_statistics(
    solution: HandEyeSolution,
    errors: PoseErrors | None = None,
    scanner_errors: Mapping[str, Sequence[Array]] | None = None,
) -> HandEyeFit:
    """Return the hand-eye and the P parameters of a solution with their covariance and other statistics.

    The covariance (6 + P, 6 + P) is the sum of what white scatter, repeating errors of the arm, errors of the scanner
    and unseen directions do to this estimate. The first six are the right twist ξ of T_mount·exp(ξ), rad before
    length_unit.

    Args:
        errors: pose errors beside white scatter; None: there are none. Scatter of the joints is not counted twice: the
            scatter of the flange, as estimated, contains it.
        scanner_errors: as in `solve_hand_eye`.
    """
    errors = errors or white_scatter_only(sum(e.gram.views for e in solution.rig.parts))
    repeating = errors.restricted(errors.causes - {JOINT_SCATTER})
    sources = _variance_sources(solution, repeating, scanner_errors or {})
    covariance = np.sum(list(sources.values()), axis=0)
    # The inflation is the geometric mean, over the 6 + P parameters, of the ratio of this covariance to the estimate's.
    log_ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(solution.covariance)[1]
    visible = covariance[:6].copy()
    # Directions that no motion shows were fixed in the fit: their variance is that of the weak prior.
    sources["unseen"][:6, :6] += solution.hidden @ solution.hidden.T
    covariance[:6, :6] += solution.hidden @ solution.hidden.T
    return HandEyeFit(
        T_mount=solution.T_mount,
        covariance=covariance[:6, :6],
        inflation=float(max(1.0, np.exp(log_ratio / len(covariance)))),
        repeatability=solution.scatter,
        heldout_ratio=_heldout_ratio(solution),
        degrees=len(solution.rig.z) - mean_basis(solution.rig.columns).shape[1],
        rotation_shares=_source_shares(sources, slice(0, 3)),
        position_shares=_source_shares(sources, slice(3, 6)),
        values=solution.values + solution.x[6:],
        values_covariance=covariance[6:, 6:],
        visible_covariance=visible,
    )


def _variance_sources(
    solution: HandEyeSolution, errors: PoseErrors, scanner_errors: Mapping[str, Sequence[Array]]
) -> dict[str, Array]:
    """Return by name of the source its part (6 + P, 6 + P) of the covariance of the estimate β = G z: G C Gᵀ.

    C is the covariance that the source gives z. That of scatter and of pose errors has a variance fitted here; that of
    the scanner's errors follows from their twists. "unseen" is what the prior of β leaves where z says nothing.

    Args:
        errors: pose errors beside white scatter, of all views of the rig.
        scanner_errors: by source, per capture left twists (6V, K) of the views for one sigma of each of K errors.
    """
    rig, gain = solution.rig, solution.gain
    mixed = rig.mixed(errors)
    # Of white scatter alone the solution has the variances already: the fit begins there.
    start = None if errors.names else solution.scatter[0].variances
    fit = fit_variances(mixed, start=start, both_starts=True)
    is_well_known = not errors.names and mixed.size > _PLUG_IN
    variances = fit.variances if is_well_known else mean_variances(mixed, fit)
    components = zip((*WHITE_COMPONENTS, *errors.names), variances, mixed.components[:, 0], strict=True)
    sources = {name: variance * gain @ C @ gain.T for name, variance, C in components}
    for name, twists in scanner_errors.items():
        columns = rig.reduce(twists)
        shift = gain @ columns
        # One scanner's scale shows in the views themselves: it is known better than by its sigma, or is off by more.
        if name == SCANNER_SCALE and not rig.parts[0].common_twists.size:
            scatter = np.einsum("c,cij->ij", variances, mixed.components[:, 0])
            shift = shift @ _posterior_root(rig, scatter, columns)
        sources[name] = shift @ shift.T
    sources["unseen"] = solution.covariance @ solution.prior @ solution.covariance
    return sources


def _posterior_root(rig: RigModel, scatter: Array, errors: Array) -> Array:
    """Return a root L (K, K) of E[θ θᵀ] = L Lᵀ, for K errors θ of the scanner after the views were seen.

    z = X β + F θ + e with θ ~ N(0, 1) a priori. L Lᵀ is the posterior variance of θ plus its squared mean: the hand-eye
    is not corrected by that mean. Long travel of the flange shows the scanner's scale, short travel does not.

    Args:
        scatter: (N, N) covariance of e.
        errors: F (N, K), visible directions per sigma of each error.
    """
    white = np.linalg.solve(np.linalg.cholesky(scatter), np.column_stack([rig.columns, errors, rig.z]))
    free = project_out(white[:, : rig.columns.shape[1]], white[:, rig.columns.shape[1] :])
    columns, seen = free[:, :-1], free[:, -1]
    variance = np.linalg.inv(np.eye(errors.shape[1]) + columns.T @ columns)
    likeliest = variance @ (columns.T @ seen)
    return np.linalg.cholesky(variance + np.outer(likeliest, likeliest)).astype(float)


def _source_shares(sources: dict[str, Array], axes: slice) -> dict[str, float]:
    """Return by source its share in the variance of some axes of the hand-eye, summed over these axes.

    Args:
        sources: by name, parts (6 + P, 6 + P) of the covariance.
        axes: which of the numbers of ξ.
    """
    squares = {name: float(np.trace(matrix[axes, axes])) for name, matrix in sources.items()}
    return {name: square / max(sum(squares.values()), 1e-300) for name, square in squares.items()}


def _heldout_ratio(solution: HandEyeSolution) -> float:
    """Return the rms residual of views left out of the fit over the rms of the same pairs when they are in it.

    Views are left out in groups, one group at a time; NaN where there is none. Scatter is not estimated again.
    """
    parts = list(zip(solution.rig.parts, solution.scatter, strict=True))
    # Σ w e² of the pairs with left-out views, under the fits without them and under the fit of all.
    squares = np.zeros(2)
    for k, (e, scatter) in enumerate(parts):
        for fold in grouped_folds(e.capture.T_base_flange, max(e.gram.lever, 1e-9)):
            kept = e.without(fold)
            rest = parts[:k] + parts[k + 1 :]
            if len(kept.gram.pairs):
                rest.append((kept, scatter))
            if rest:
                rig = RigModel([part for part, _ in rest])
                gain, covariance = rig.fit_gls([of_part for _, of_part in rest], solution.prior)
                x = gain @ rig.z + covariance @ solution.prior_vector
                squares += e.squares(fold, (x, solution.x))
    return float(np.sqrt(squares[0] / squares[1])) if squares[1] > 0 else float("nan")


def solve_hand_eye(
    captures: Sequence[Capture],
    unconstrained: Sequence[UnconstrainedPoses],
    T_mount: Array,
    effects: FittedEffects | None = None,
    scanner_errors: Mapping[str, Sequence[Array]] | None = None,
) -> HandEyeSolution:
    """Return hand-eye, and P parameters of effects, by generalised least squares over the views of all captures.

    Views weigh by the scatter of the flange that each capture shows (REML). A weak prior keeps unseen directions small.
    `hand_eye_statistics` tells the covariance.

    Args:
        unconstrained: per capture the views moved by the overlaps alone, and the twists from the model's poses there.
        T_mount: (4, 4) hand-eye of these model's poses; the problem is linear about it.
        effects: fitted together with the hand-eye; None: no effects.
        scanner_errors: by source, per capture left twists (6V, K) that the views show for one sigma of each of K
            errors that all views and captures have in common. They change the estimate of several scanners only.
    """
    # Through surfaces that two scanners see, the errors of one would move the hand-eye of the other. Such views weigh
    # less if the errors are in the covariance of the observations.
    several_scanners = any(capture.scanner is not None for capture in captures)
    by_source = list((scanner_errors or {}).values()) if several_scanners else []
    common = [np.hstack(of_capture) for of_capture in zip(*by_source, strict=True)]
    no_columns = tuple(np.zeros((6 * len(f.poses), 0)) for f in unconstrained)
    if effects is None:
        effects = FittedEffects(no_columns, np.zeros(0), np.zeros(0))
    parts = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, T_mount, of_effects, of_errors)
        for c, f, of_effects, of_errors in zip(
            captures, unconstrained, effects.twists, common or no_columns, strict=True
        )
    ]
    rig = RigModel(parts)
    scatter = tuple(estimate_repeatability(e.reduced_poses, e.effect_columns, e.common_columns) for e in parts)
    prior = weak_prior(captures, unconstrained, T_mount, effects.prior)
    hidden = _hidden_twists(captures, T_mount, prior)
    # A huge precision fixes the directions that the motions do not show.
    prior[:6, :6] += _HELD * prior[:6, :6] @ hidden @ hidden.T @ prior[:6, :6]
    # The prior of the effects is about the value 0, the unknowns are changes from `effects.values`.
    prior_vector = np.concatenate([np.zeros(6), -effects.values * effects.prior**-2.0])
    gain, covariance = rig.fit_gls(scatter, prior)
    x = gain @ rig.z + covariance @ prior_vector
    return HandEyeSolution(
        rig=rig,
        scatter=scatter,
        prior=prior,
        prior_vector=prior_vector,
        gain=gain,
        covariance=covariance,
        x=x,
        values=effects.values,
        hidden=hidden,
        T_mount=T_mount @ frames.exp(x[:6]),
    )


def _hidden_twists(captures: Sequence[Capture], T_mount: Array, prior: Array) -> Array:
    """Return twists (6, m) of the hand-eye that the motions do not show, each as long as one sigma of the prior.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        prior: (6 + P, 6 + P) precision; that of the hand-eye is diagonal.
    """
    sigma = np.diag(prior)[:6] ** -0.5
    visible = visible_twists(captures, T_mount, seen_part(captures)) / sigma[:, None]
    return sigma[:, None] * null_space(visible.T, rcond=1e-9)


def weak_prior(
    captures: Sequence[Capture], unconstrained: Sequence[UnconstrainedPoses], T_mount: Array, effects: Array
) -> Array:
    """Return the precision (6 + P, 6 + P) of a prior so weak that it decides only what the views do not show.

    Its σ are 1 rad for the hand-eye's rotation, the median distance from scanner to part for its translation.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        effects: (P,) σ of the prior of the effects' parameters, in their units.
    """
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, unconstrained, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, effects**-2.0]))


def hand_eye_jacobian(capture: Capture, T_mount: Array, centre: Array) -> Array:
    """Return left twists (6V, 6) of the views about `centre` (3,) per right twist of the hand-eye, T_mount·exp(ξ)."""
    return frames.adjoint_about(centre, capture.hand_eye_frames(T_mount)).reshape(-1, 6)


def reduce_poses(capture: Capture, g: Gram, twists: Array, T_mount: Array) -> ReducedPoses:
    """Return the twists of all views reduced to the n directions that the overlaps see, z = R δ, with X and Σ of z.

    X is the response to the hand-eye, the covariances are those of a unit scatter of the flange and of the noise.

    Args:
        capture: poses of the flange, and which views were scanned at one stop and share its scatter.
        g: normal equations at the poses that the overlaps alone determine, about the part's centre.
        twists: δ (V, 6), left twists about that centre from the model's poses to those, rad and length_unit.
        T_mount: (4, 4) hand-eye of the model's poses.
    """
    seen = g.visible
    reduction = seen.vectors.T / seen.scale
    # Left twists of the views per right twist of the flange.
    per_flange_twist = frames.adjoint_about(g.centre, capture.T_reference_flange)
    # (V, n, 6) visible directions per unit rotation and translation of the flange in each view.
    blocks = reduction.reshape(len(reduction), -1, 6).transpose(1, 0, 2) @ per_flange_twist
    if capture.stop is not None:
        # Views scanned at one stop share its scatter: their blocks are added.
        by_view, blocks = blocks, np.zeros((capture.stop.max() + 1, *blocks.shape[1:]))
        np.add.at(blocks, capture.stop, by_view)
    of_rotation, of_translation = summed_squares(blocks[..., :3]), summed_squares(blocks[..., 3:])
    return ReducedPoses(
        reduction=reduction,
        expansion=seen.scale[:, None] * seen.vectors,
        z=reduction @ twists.reshape(-1),
        hand_eye=reduction @ hand_eye_jacobian(capture, T_mount, g.centre),
        components=np.array([of_rotation, of_translation, np.diag(g.variance / seen.values)]),
    )


def hand_eye_mixed_model(reduced: ReducedPoses, further: Array | None = None) -> MixedModel:
    """Return the mixed model of reduced poses, one block, with the hand-eye and further columns as its free mean.

    Args:
        further: (n, K) columns; None: the hand-eye alone.
    """
    mean = reduced.hand_eye if further is None else np.column_stack([reduced.hand_eye, further])
    return MixedModel(reduced.z[None], mean_basis(mean)[None], reduced.components[:, None])


def mean_basis(columns: Array) -> Array:
    """Return an orthonormal basis (n, r) of the mean's columns (n, K), less what the views cannot tell apart."""
    return column_space(columns, _OBSERVABLE_SHARE)


def estimate_repeatability(
    reduced: ReducedPoses, further: Array | None = None, common: Array | None = None
) -> Repeatability:
    """Return the scatter of the flange by restricted maximum likelihood (REML): σ_r (rad), σ_t (length_unit), c.

    z = X β + e with cov e = σ_r² C_r + σ_t² C_t + c C_n + B Bᵀ. c is the factor on the noise within overlaps, whose
    errors are correlated. β is free: X are the responses to the hand-eye and the `further` columns.

    Args:
        reduced: z (n,), its response to the hand-eye, and C_r, C_t, C_n (n, n) as `components`.
        further: (n, K) more columns of X, those of effects; None: the hand-eye alone.
        common: B (n, K), errors of unit variance that are known to be there; None: none.
    """
    mixed = hand_eye_mixed_model(reduced, further)
    if common is not None and common.size:
        mixed = replace(mixed, fixed=(common @ common.T)[None])
    return repeatability_from(fit_variances(mixed, both_starts=True).variances)


def repeatability_from(variances: Array) -> Repeatability:
    """Return variances (3,) of rotation, translation and noise factor as a `Repeatability`."""
    return Repeatability(float(np.sqrt(variances[0])), float(np.sqrt(variances[1])), float(variances[2]))


def pose_covariance(reduced: ReducedPoses, scatter: Repeatability) -> Array:
    """Return the covariance (n, n) of reduced poses z for a scatter of the flange and a noise factor."""
    return np.tensordot(scatter.variances, reduced.components, axes=1)


def whiten_captures(
    sessions: Sequence[tuple[Capture, UnconstrainedPoses, Array]], T_mount: Array, values: Array, free: Mask
) -> WhitenedData:
    """Return columns of the hand-eye, columns of P effects, and observations of all captures, whitened and stacked.

    Each capture is whitened by the covariance of its own pose scatter.

    Args:
        sessions: per capture the views moved by the overlaps alone, and their left twists (6V, P) per unit of each
            parameter of the effects.
        T_mount: (4, 4) maps scanner to mount.
        values: (P,) of the parameters when the views were moved; their effect is added to the observations again.
        free: (P,) True for parameters that are free while the scatter is estimated.
    """
    stacked = []
    for capture, views, twists in sessions:
        reduced = reduce_poses(capture, views.overlaps.gram, views.twists, T_mount)
        effects = reduced.reduction @ twists
        covariance = pose_covariance(reduced, estimate_repeatability(reduced, effects[:, free]))
        columns = np.column_stack([reduced.hand_eye, effects, reduced.z + effects @ values])
        stacked.append(np.linalg.solve(np.linalg.cholesky(covariance), columns))
    white = np.concatenate(stacked)
    return WhitenedData(white[:, :6], white[:, 6:-1], white[:, -1])


def capture_repeatability(capture: Capture, unconstrained: UnconstrainedPoses, T_mount: Array) -> Repeatability:
    """Return the scatter of one capture's poses by REML, the hand-eye being free; linearised at T_mount (4, 4)."""
    return estimate_repeatability(reduce_poses(capture, unconstrained.overlaps.gram, unconstrained.twists, T_mount))
