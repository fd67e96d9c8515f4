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
    GeneralisedFit,
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
# White scatter of more numbers is known well enough to take its maximum.
_PLUG_IN = 300
# Combinations of hand-eye and effects weaker than this share of the strongest are unobservable.
_OBSERVABLE_SHARE = 1e-6
# Precision along what the motions do not show, over that of the weak prior: it stays where it is.
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
        """(3,) of rotation and translation, and the noise factor."""
        return np.array([self.rotation**2, self.translation**2, self.noise_factor])


@dataclass(frozen=True)
class ReducedPoses:
    """What overlaps and common targets say about the poses of the views, reduced to n visible directions."""

    reduction: Array  # (n, 6V) from twists of the views to visible directions
    expansion: Array  # (6V, n) back to the shortest twists, a radian as long as what it moves at the part
    z: Array  # (n,) observed twists, reduction @ twists
    hand_eye: Array  # (n, 6) response to the hand-eye's ξ
    rotation: Array  # (n, n) covariance of a unit rotation scatter of the flange
    translation: Array  # (n, n) the same for translation
    noise: Array  # (n, n) covariance of the sensor noise within overlaps


@dataclass(frozen=True)
class CaptureEvidence:
    """What one capture says about hand-eye and effects: its pairs and its free-network views."""

    capture: Capture
    gram: Gram
    twists: Array  # (V, 6)
    hand_eye_frames: Array  # (V, 4, 4) of the hand-eye
    effect_twists: Array  # (6V, P)
    common_twists: Array  # (6V, K) by errors of scanners that the answer counts; none of one scanner

    @cached_property
    def reduced_poses(self) -> ReducedPoses:
        """The visible directions of the views."""
        return reduce_poses(self.gram, self.twists, self.hand_eye_frames, self.capture)

    @property
    def effect_columns(self) -> Array | None:
        """(n, P) the effects' columns; None without effects."""
        return self.reduced_poses.reduction @ self.effect_twists if self.effect_twists.shape[1] else None

    @property
    def common_columns(self) -> Array:
        """(n, K) visible directions of the same."""
        return self.reduced_poses.reduction @ self.common_twists

    def without(self, views: Indices) -> "CaptureEvidence":
        """Return the evidence of a capture without some views, whose pairs go too."""
        g = self.gram
        keep = np.asarray(~np.isin(g.pairs, views).any(axis=1))
        stays = ~np.isin(np.arange(g.views), views)
        number = np.cumsum(stays) - 1
        gram = replace(g.only(keep), views=g.views - len(views), pairs=number[g.pairs[keep]])
        kept = take_rows(self, stays, "twists", "hand_eye_frames")
        kept = take_rows(kept, np.repeat(stays, 6), "effect_twists", "common_twists")
        return replace(kept, capture=self.capture.without(views), gram=gram)

    def squares(self, views: Indices, corrections: Sequence[Array]) -> Array:
        """Return Σ w e² of the pairs of some views with the robot's poses and each correction (6 + P,)."""
        touched = np.isin(self.gram.pairs, views).any(axis=1)
        J = np.column_stack([hand_eye_jacobian(self.hand_eye_frames, self.gram.centre), self.effect_twists])
        moved = [(J @ x).reshape(-1, 6) - self.twists for x in corrections]
        return np.array([pair_squares(self.gram, m)[touched].sum() for m in moved])


@dataclass(frozen=True)
class RigModel:
    """The views of all sessions of a rig: N visible directions, 6 + P unknowns."""

    parts: Sequence[CaptureEvidence]

    @cached_property
    def z(self) -> Array:
        """(N,) what was seen."""
        return np.concatenate([e.reduced_poses.z for e in self.parts])

    @cached_property
    def columns(self) -> Array:
        """(N, 6 + P) of hand-eye and effects."""
        reduced = [(e.reduced_poses, e.effect_twists) for e in self.parts]
        return np.concatenate([np.column_stack([r.hand_eye, r.reduction @ twists]) for r, twists in reduced])

    def fit_gls(self, scatter: Sequence[Repeatability], prior: Array) -> GeneralisedFit:
        """Return generalised least squares under every session's scatter, with a prior (6 + P, 6 + P)."""
        noise = [
            pose_covariance(e.reduced_poses, s) + e.common_columns @ e.common_columns.T
            for e, s in zip(self.parts, scatter, strict=True)
        ]
        return generalised_fit(block_diag(*noise), self.columns, prior)

    def mixed(self, errors: PoseErrors) -> MixedModel:
        """Return all sessions as one block: what the arm does wrong it does wrong in all of them."""
        reduced = [e.reduced_poses for e in self.parts]
        white = (
            block_diag(*(r.rotation for r in reduced)),
            block_diag(*(r.translation for r in reduced)),
            block_diag(*(r.noise for r in reduced)),
        )
        R = block_diag(*(r.reduction for r in reduced))
        components = np.array([*white, *(R @ C @ R.T for C in errors.components)])
        shared = block_diag(*(e.common_columns @ e.common_columns.T for e in self.parts))[None]
        further = errors.prior if errors.names else None
        mixed = MixedModel(self.z[None], mean_basis(self.columns)[None], components[:, None], further=further)
        return replace(mixed, fixed=shared) if shared.any() else mixed

    def reduce(self, twists: Sequence[Array]) -> Array:
        """Return the visible directions (N, K) of twists (6V, K) of every session."""
        return np.concatenate([e.reduced_poses.reduction @ t for e, t in zip(self.parts, twists, strict=True)])


@dataclass(frozen=True)
class FittedEffects:
    """P parameters of effects that are fitted together with the hand-eye."""

    twists: tuple[Array, ...]  # per capture (6V, P): left twists about the centre of its Gram matrices
    values: Array  # (P,) at which they were computed
    prior: Array  # (P,) standard deviation of a weak prior about zero


@dataclass(frozen=True)
class HandEyeSolution:
    """The linear problem of hand-eye and effects, and its answer x (6 + P,)."""

    rig: RigModel
    scatter: tuple[Repeatability, ...]
    prior: Array  # (6 + P, 6 + P) precision
    prior_vector: Array  # (6 + P,)
    gls: GeneralisedFit
    x: Array
    values: Array  # (P,) of the effects at which it was made
    hidden: Array  # (6, m) twists of the hand-eye that the motions do not show, one sigma of the weak prior each
    T_mount: Array  # (4, 4) where it leads


@dataclass(frozen=True)
class HandEyeFit:
    """Hand-eye and its statistics; twists are right perturbations T·exp(ξ), rotation first."""

    T_mount: Array  # (4, 4) T_mount_scanner
    covariance: Array  # (6, 6)
    inflation: float  # of the covariance over that of independent pose errors, geometric mean over directions, ≥ 1
    repeatability: tuple[Repeatability, ...]  # per capture
    heldout_ratio: float  # rms of left-out views over rms of the fit, same correspondences
    # Shares of what may be wrong in the variance of its rotation and of its position; each adds up to 1.
    rotation_shares: dict[str, float] = field(default_factory=dict)
    position_shares: dict[str, float] = field(default_factory=dict)
    # Degrees of freedom on which the covariance rests: numbers that are seen beyond hand-eye and effects; None: it is
    # another run's.
    degrees: int | None = None
    values: Array = field(default_factory=lambda: np.zeros(0))  # (P,) of the effects
    values_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (P, P)
    visible_covariance: Array = field(default_factory=lambda: np.zeros((6, 0)))  # (6, 6 + P), without what is hidden

    @property
    def values_sigma(self) -> Array:
        """(P,) standard deviations of the effects' values."""
        return np.sqrt(np.maximum(np.diag(self.values_covariance), 1e-300))


def fit_hand_eye(
    captures: Sequence[Capture],
    unconstrained: Sequence[UnconstrainedPoses],
    T_mount: Array,
    columns: FittedEffects | None = None,
    scanner_errors: Mapping[str, Sequence[Array]] | None = None,
    errors: PoseErrors | None = None,
    solved: HandEyeSolution | None = None,
) -> HandEyeFit:
    """Return generalised least squares over the reduced poses of all captures, covariance under all their errors.

    Args:
        unconstrained: per capture the views moved by the overlaps alone, from the poses under `T_mount`.
        T_mount: (4, 4) hand-eye at which that began.
        columns: effects to fit with it.
        scanner_errors: by source, per capture (6V, K) twists that the views show for one sigma of each of K
            errors that all views and captures have in common; they widen the covariance and change nothing else.
        errors: how the poses may err beside white scatter; None: they do not. What joints do anew is not counted: on
            average the scatter of the flange that views show holds it already.
        solved: what `solve_hand_eye` returns of the same, if it is at hand.
    """
    # One scanner's errors move another's hand-eye, through the surfaces that both see, no more than they have to.
    apart = any(capture.scanner is not None for capture in captures)
    errors_of_scanners = list((scanner_errors or {}).values()) if apart else []
    common = [np.hstack(of_capture) for of_capture in zip(*errors_of_scanners, strict=True)]
    solution = solved or solve_hand_eye(captures, unconstrained, T_mount, columns, common)
    errors = errors or white_scatter_only(sum(len(f.poses) for f in unconstrained))
    repeating = errors.restricted(errors.causes - {JOINT_SCATTER})
    sources = _variance_sources(solution, repeating, scanner_errors or {})
    covariance = np.sum(list(sources.values()), axis=0)
    log_ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(solution.gls.covariance)[1]
    visible = covariance[:6].copy()
    # Held where they are, the hidden directions are no better known than before.
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
    """Return what each source does to the covariance (6 + P, 6 + P)."""
    rig, gls = solution.rig, solution.gls
    mixed = rig.mixed(errors)
    # White scatter alone was found with the answer.
    start = None if errors.names else solution.scatter[0].variances
    fit = fit_variances(mixed, start=start, both_starts=True)
    mean = fit.variances if not errors.names and mixed.size > _PLUG_IN else mean_variances(mixed, fit)
    components = zip((*WHITE_COMPONENTS, *errors.names), mean, mixed.components[:, 0], strict=True)
    sources = {name: variance * gls.gain @ C @ gls.gain.T for name, variance, C in components}
    for name, twists in scanner_errors.items():
        columns = rig.reduce(twists)
        repeated = gls.gain @ columns
        if name == SCANNER_SCALE and not rig.parts[0].common_twists.size:
            scatter = np.einsum("c,cij->ij", mean, mixed.components[:, 0])
            repeated = repeated @ _posterior_root(rig, scatter, columns)
        sources[name] = repeated @ repeated.T
    # The rest is what the prior leaves where nothing is seen.
    sources["unseen"] = gls.covariance @ solution.prior @ gls.covariance
    return sources


def _posterior_root(rig: RigModel, scatter: Array, errors: Array) -> Array:
    """Return the square root (K, K) of what the views leave of errors (N, K) of unit size: variance with squared mean.

    Long ways of the flange show how long the scanner's millimetre is, short ones do not.
    """
    white = np.linalg.solve(np.linalg.cholesky(scatter), np.column_stack([rig.columns, errors, rig.z]))
    free = project_out(white[:, : rig.columns.shape[1]], white[:, rig.columns.shape[1] :])
    columns, seen = free[:, :-1], free[:, -1]
    variance = np.linalg.inv(np.eye(errors.shape[1]) + columns.T @ columns)
    likeliest = variance @ (columns.T @ seen)
    return np.linalg.cholesky(variance + np.outer(likeliest, likeliest)).astype(float)


def _source_shares(sources: dict[str, Array], axes: slice) -> dict[str, float]:
    """Return the share of every source in the variance of some axes of the hand-eye together."""
    squares = {name: float(np.trace(matrix[axes, axes])) for name, matrix in sources.items()}
    return {name: square / max(sum(squares.values()), 1e-300) for name, square in squares.items()}


def _heldout_ratio(solution: HandEyeSolution) -> float:
    """Return the rms of views left out in groups over that of the same pairs under the estimates of all views."""
    parts = list(zip(solution.rig.parts, solution.scatter, strict=True))
    outside = np.zeros(2)
    for k, (e, scatter) in enumerate(parts):
        for fold in grouped_folds(e.capture.T_base_flange, max(e.gram.lever, 1e-9)):
            fewer = e.without(fold)
            rest = parts[:k] + parts[k + 1 :]
            rest += [(fewer, scatter)] if len(fewer.gram.pairs) else []
            if rest:
                rig = RigModel([part for part, _ in rest])
                gls = rig.fit_gls([of_part for _, of_part in rest], solution.prior)
                outside += e.squares(fold, (gls.solve(rig.z, solution.prior_vector), solution.x))
    return float(np.sqrt(outside[0] / outside[1])) if outside[1] > 0 else float("nan")


def solve_hand_eye(
    captures: Sequence[Capture],
    unconstrained: Sequence[UnconstrainedPoses],
    T_mount: Array,
    columns: FittedEffects | None = None,
    common: Sequence[Array] = (),
) -> HandEyeSolution:
    """Return the answer in which views weigh by the scatter that they show, and by errors that they have in `common`,
    (6V, K) a capture; other arguments as of `fit_hand_eye`."""
    none = tuple(np.zeros((6 * len(f.poses), 0)) for f in unconstrained)
    if columns is None:
        columns = FittedEffects(none, np.zeros(0), np.zeros(0))
    parts = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, c.hand_eye_frames(T_mount), twists, shared)
        for c, f, twists, shared in zip(captures, unconstrained, columns.twists, common or none, strict=True)
    ]
    rig = RigModel(parts)
    scatter = tuple(estimate_repeatability(e.reduced_poses, e.effect_columns, e.common_columns) for e in parts)
    prior = weak_prior(captures, unconstrained, T_mount, columns.prior)
    hidden = _hidden_twists(captures, T_mount, prior)
    # What the motions do not show stays where it is.
    prior[:6, :6] += _HELD * prior[:6, :6] @ hidden @ hidden.T @ prior[:6, :6]
    prior_vector = np.concatenate([np.zeros(6), -columns.values * columns.prior**-2.0])
    gls = rig.fit_gls(scatter, prior)
    x = gls.solve(rig.z, prior_vector)
    return HandEyeSolution(
        rig=rig,
        scatter=scatter,
        prior=prior,
        prior_vector=prior_vector,
        gls=gls,
        x=x,
        values=columns.values,
        hidden=hidden,
        T_mount=T_mount @ frames.exp(x[:6]),
    )


def _hidden_twists(captures: Sequence[Capture], T_mount: Array, prior: Array) -> Array:
    """Return twists (6, m) of the hand-eye that the motions do not show, one sigma of the prior each."""
    sigma = np.diag(prior)[:6] ** -0.5
    visible = visible_twists(captures, T_mount, seen_part(captures)) / sigma[:, None]
    return sigma[:, None] * null_space(visible.T, rcond=1e-9)


def step_hand_eye(
    captures: Sequence[Capture], unconstrained: Sequence[UnconstrainedPoses], T_mount: Array
) -> tuple[Array, tuple[Repeatability, ...]]:
    """Return T_mount (4, 4) as `fit_hand_eye` finds it, without statistics, and how the poses scatter per capture."""
    solution = solve_hand_eye(captures, unconstrained, T_mount)
    return solution.T_mount, solution.scatter


def weak_prior(
    captures: Sequence[Capture], unconstrained: Sequence[UnconstrainedPoses], T_mount: Array, effects: Array
) -> Array:
    """Return a precision (6 + P, 6 + P): one radian and one working distance keep the unseen finite, move nothing else.

    Args:
        effects: (P,) standard deviations of the prior of effects fitted with the hand-eye.
    """
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, unconstrained, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, effects**-2.0]))


def hand_eye_jacobian(hand_eye_frames: Array, centre: Array) -> Array:
    """Return left twists (6V, 6) of the views about `centre` for a right perturbation of the hand-eye."""
    return np.concatenate(list(frames.adjoint(frames.make(np.eye(3), -centre) @ hand_eye_frames)))


def reduce_poses(g: Gram, twists: Array, hand_eye_frames: Array, capture: Capture) -> ReducedPoses:
    """Return per-view twists reduced to the directions that the overlaps see.

    Args:
        g: normal equations about the part's centre, at the free-network poses.
        twists: (V, 6) about that centre, from the model's poses to those.
        hand_eye_frames: (V, 4, 4) whose adjoint carries a perturbation of the hand-eye into the reference frame.
        capture: says how a twist of the flange shows in each view, and which views share one.
    """
    seen = g.visible
    left = seen.vectors.T / seen.scale
    to_centre = frames.make(np.eye(3), -g.centre)
    response = left @ hand_eye_jacobian(hand_eye_frames, g.centre)
    carried = frames.adjoint(to_centre @ capture.T_reference_flange)
    # Covariances of the visible directions for independent unit turns and shifts of the flange at every stop.
    blocks = left.reshape(len(left), -1, 6).transpose(1, 0, 2) @ carried
    if capture.stop is not None:
        of_view, blocks = blocks, np.zeros((capture.stop.max() + 1, *blocks.shape[1:]))
        np.add.at(blocks, capture.stop, of_view)
    return ReducedPoses(
        reduction=left,
        expansion=seen.scale[:, None] * seen.vectors,
        z=left @ twists.reshape(-1),
        hand_eye=response,
        rotation=summed_squares(blocks[..., :3]),
        translation=summed_squares(blocks[..., 3:]),
        noise=np.diag(g.variance / seen.values),
    )


def hand_eye_mixed_model(reduced: ReducedPoses, further: Array | None = None) -> MixedModel:
    """Return the reduced poses as one block; the hand-eye, and `further` columns (n, K), are the free mean."""
    mean = reduced.hand_eye if further is None else np.column_stack([reduced.hand_eye, further])
    components = np.array([reduced.rotation, reduced.translation, reduced.noise])[:, None]
    return MixedModel(reduced.z[None], mean_basis(mean)[None], components)


def mean_basis(columns: Array) -> Array:
    """Return an orthonormal basis (n, r) of the mean's columns (n, K), less what the views cannot tell apart."""
    return column_space(columns, _OBSERVABLE_SHARE)


def estimate_repeatability(
    reduced: ReducedPoses, further: Array | None = None, common: Array | None = None
) -> Repeatability:
    """Return REML of (σ_r, σ_t, c); the hand-eye, and `further` columns (n, K), are the unknown mean.

    Args:
        common: (n, K) beside the scatter, of unit variance each.
    """
    mixed = hand_eye_mixed_model(reduced, further)
    if common is not None and common.size:
        mixed = replace(mixed, fixed=(common @ common.T)[None])
    return repeatability_from(fit_variances(mixed, both_starts=True).variances)


def repeatability_from(variances: Array) -> Repeatability:
    """Return standard deviations (rad, length_unit) and noise factor from the three variances (3,)."""
    return Repeatability(float(np.sqrt(variances[0])), float(np.sqrt(variances[1])), float(variances[2]))


def pose_covariance(reduced: ReducedPoses, scatter: Repeatability) -> Array:
    """Return the covariance (n, n) of the reduced poses' z."""
    return (
        scatter.rotation**2 * reduced.rotation
        + scatter.translation**2 * reduced.translation
        + scatter.noise_factor * reduced.noise
    )


def whiten_captures(
    sessions: Sequence[tuple[Capture, UnconstrainedPoses, Array]], T_mount: Array, values: Array, free: Mask
) -> WhitenedData:
    """Return all captures of a rig in units of their pose scatter, stacked.

    Args:
        sessions: per capture its free-network views and the twists (6V, P) of the effects.
        values: (P,) of the effects at which the views were moved; z is what was seen without them.
        free: (P,) effects that explain scatter.
    """
    stacked = []
    for capture, views, twists in sessions:
        hand_eye_frames = capture.hand_eye_frames(T_mount)
        reduced = reduce_poses(views.overlaps.gram, views.twists, hand_eye_frames, capture)
        further = reduced.reduction @ twists
        half = np.linalg.cholesky(pose_covariance(reduced, estimate_repeatability(reduced, further[:, free])))
        columns = np.column_stack([reduced.hand_eye, further, reduced.z + further @ values])
        stacked.append(np.linalg.solve(half, columns))
    white = np.concatenate(stacked)
    return WhitenedData(white[:, :6], white[:, 6:-1], white[:, -1])


def capture_repeatability(capture: Capture, unconstrained: UnconstrainedPoses, T_mount: Array) -> Repeatability:
    """Return the repeatability of one capture's poses, whatever its hand-eye, linearised at T_mount (4, 4)."""
    gram, twists = unconstrained.overlaps.gram, unconstrained.twists
    return estimate_repeatability(reduce_poses(gram, twists, capture.hand_eye_frames(T_mount), capture))
