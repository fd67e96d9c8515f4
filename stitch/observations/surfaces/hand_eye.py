"""The hand-eye and the effects in use from freed views: generalised least squares, covariance, held-out error.

No number of points averages out the error of a pose: views are the samples. What an arm does wrong it does again, so
that no number of views averages that out either: `pose_errors.py` says how poses may err, the views say how much,
and hand-eye and effects are averaged over all sizes that the views allow. Errors of the scanner that repeat in
every view come on top.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.pose_errors import PoseErrors, white
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.pose_channel import Repeatability, covariance_of, estimate
from stitch.observations.surfaces.rig_model import RigModel, rig_model
from stitch.statistics.least_squares import generalised
from stitch.statistics.variance_components import fit_variances
from stitch.statistics.variance_posterior import MeanPosterior, mean_posterior


@dataclass(frozen=True)
class Columns:
    """P parameters of effects that are fitted together with the hand-eye."""

    twists: tuple[Array, ...]  # per capture (6V, P): left twists about the centre of its Gram matrices
    values: Array  # (P,) at which they were computed
    prior: Array  # (P,) standard deviation of a weak prior about zero


@dataclass(frozen=True)
class HandEye:
    """Hand-eye and its statistics; twists are right perturbations T·exp(ξ), rotation first."""

    T_mount: Array  # (4, 4) T_mount_scanner
    covariance: Array  # (6, 6)
    inflation: float  # of the covariance over that of independent pose errors, geometric mean over directions, ≥ 1
    repeatability: tuple[Repeatability, ...]  # per capture
    heldout_ratio: float  # rms of left-out views over rms of the fit, same correspondences
    shares: dict[str, float] = field(default_factory=dict)  # of what may be wrong in the hand-eye's variance; sum 1
    values: Array = field(default_factory=lambda: np.zeros(0))  # (P,) of the effects
    values_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (P, P)

    @property
    def values_sigma(self) -> Array:
        """(P,) standard deviations of the effects' values."""
        return np.sqrt(np.maximum(np.diag(self.values_covariance), 1e-300))


def fit_hand_eye(
    captures: Sequence[Capture],
    freed: Sequence[FreePoses],
    T_mount: Array,
    columns: Columns | None = None,
    repeating: Sequence[Array] | None = None,
    errors: PoseErrors | None = None,
) -> HandEye:
    """Generalised least squares over the pose channels of all captures, averaged over all variances they allow.

    Args:
        freed: per capture the views moved by the overlaps alone, from the poses under `T_mount`.
        T_mount: (4, 4) hand-eye at which that began.
        columns: effects to fit with it.
        repeating: per capture (6V, K) twists that the views show for one standard deviation of each of K errors
            that all views and captures have in common; they widen the covariance and change nothing else.
        errors: how the poses may err beside white scatter; None: they do not.
    """
    columns = columns or Columns(tuple(np.zeros((6 * len(f.poses), 0)) for f in freed), np.zeros(0), np.zeros(0))
    parts = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, c.hand_eye_frames(T_mount), extra)
        for c, f, extra in zip(captures, freed, columns.twists, strict=True)
    ]
    rig = rig_model(parts, errors or white(sum(len(f.poses) for f in freed)))
    prior = _prior(captures, freed, T_mount, columns)
    pull = np.concatenate([np.zeros(6), -columns.values * columns.prior**-2.0])
    found = mean_posterior(rig.mixed, fit_variances(rig.mixed, both_starts=True), rig.columns, (prior, pull))
    repeated = np.zeros((len(pull), 0))
    if repeating is not None:
        repeated = rig.gain(found.variances, prior) @ rig.reduce(repeating)
    covariance = found.covariance + repeated @ repeated.T
    scatter = tuple(estimate(e.channel, e.further) for e in parts)
    return HandEye(
        T_mount=T_mount @ frames.exp(found.mean[:6]),
        covariance=covariance[:6, :6],
        inflation=_inflation(rig, scatter, prior, covariance),
        shares=_shares(rig, found, repeated, covariance),
        repeatability=scatter,
        heldout_ratio=_heldout_ratio(rig, found, prior, pull),
        values=columns.values + found.mean[6:],
        values_covariance=covariance[6:, 6:],
    )


def _inflation(rig: RigModel, scatter: Sequence[Repeatability], prior: Array, covariance: Array) -> float:
    alone = block_diag(*(covariance_of(e.channel, s) for e, s in zip(rig.parts, scatter, strict=True)))
    ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(generalised(alone, rig.columns, prior).covariance)[1]
    return float(max(1.0, np.exp(ratio / len(covariance))))


def _shares(rig: RigModel, found: MeanPosterior, repeated: Array, covariance: Array) -> dict[str, float]:
    """Mean share of every source in the variance of the hand-eye, over its directions."""
    unit = np.linalg.inv(covariance[:6, :6] / (scale := np.sqrt(np.diag(covariance)[:6])) / scale[:, None])

    def share(own: Array) -> float:
        return float(np.sum(unit * (own[:6, :6] / scale / scale[:, None]))) / 6

    names = ("white rotation", "white translation", "sensor noise", *rig.errors.names)
    shares = {name: share(own) for name, own in zip(names, found.contributions, strict=True)}
    shares["scanner field"] = share(repeated @ repeated.T)
    return {**shares, "their unknown sizes": 1 - sum(shares.values())}


def scatter_of(capture: Capture, freed: FreePoses, T_mount: Array) -> Repeatability:
    """The repeatability of one capture's poses, whatever its hand-eye."""
    nothing = np.zeros((6 * len(capture.scans), 0))
    own = CaptureEvidence(capture, freed.overlaps.gram, freed.twists, capture.hand_eye_frames(T_mount), nothing)
    return estimate(own.channel)


def _heldout_ratio(rig: RigModel, found: MeanPosterior, prior: Array, pull: Array) -> float:
    """Rms of views left out in groups over that of the same pairs under the estimates of all views."""
    outside = np.zeros(2)
    for k, e in enumerate(rig.parts):
        for fold in e.folds():
            fewer = rig.without(k, fold)
            x = fewer.solve(found.variances, prior, pull)
            outside += e.squares(fold, (x, found.mean))
    return float(np.sqrt(outside[0] / outside[1])) if outside[1] > 0 else float("nan")


def _prior(captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, columns: Columns) -> Array:
    """Precision of one radian and one working distance: keeps the unseen finite, moves nothing else."""
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, freed, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, columns.prior**-2.0]))
