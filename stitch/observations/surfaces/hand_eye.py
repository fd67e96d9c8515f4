"""The hand-eye and the effects in use from per-view evidence: generalised least squares, covariance, held-out error.

The poses of the views scatter by the robot's repeatability, which no number of points averages
out: views are the samples. Errors of the scanner that repeat in every view come on top: no number of views
averages them out either. Estimates with views left out give the held-out error and show whether the
covariance is too small for these data (jackknife; Efron & Stein 1981): a robot whose pose errors are
not independent from view to view has a larger one, never a smaller.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.capture_evidence import DRAWS, CaptureEvidence, drop, information, measured_and_drawn
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.pose_channel import Repeatability, estimate


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
    inflation: float  # factor on the covariance that few views and the left-out ones ask for, ≥ 1
    repeatability: tuple[Repeatability, ...]  # per capture
    heldout_ratio: float  # rms of left-out views over rms of the fit, same correspondences
    values: Array = field(default_factory=lambda: np.zeros(0))  # (P,) of the effects
    values_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (P, P)


def fit_hand_eye(
    captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, columns: Columns | None = None,
    repeating: Sequence[Array] | None = None,
) -> HandEye:  # fmt: skip
    """Generalised least squares over the pose channels of all captures.

    Args:
        freed: per capture the views moved by the overlaps alone, from the poses under `T_mount`.
        T_mount: (4, 4) hand-eye at which that began.
        columns: effects to fit with it.
        repeating: per capture (6V, K) twists that the views show for one standard deviation of each of K errors
            that all views and captures have in common; they widen the covariance and change nothing else.
    """
    columns = columns or Columns(tuple(np.zeros((6 * len(c.scans), 0)) for c in captures), np.zeros(0), np.zeros(0))
    evidence = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, c.hand_eye_frames(T_mount), extra)
        for c, f, extra in zip(captures, freed, columns.twists, strict=True)
    ]
    scatter = [estimate(e.channel(), e.further()) for e in evidence]
    prior = _prior(captures, freed, T_mount, columns)
    # Column 0 is what was measured; the others are draws of what this scatter alone would give.
    twists = [measured_and_drawn(e, s) for e, s in zip(evidence, scatter, strict=True)]
    blocks = [information(e, s, t) for e, s, t in zip(evidence, scatter, twists, strict=True)]
    blocks.append(_pull(columns))
    x, covariance = _combine(blocks, prior)
    left_out, outside = [], np.zeros(2)
    for k, (e, s, t) in enumerate(zip(evidence, scatter, twists, strict=True)):
        for v in range(e.gram.views):
            left_out.append(_without(blocks, k, e, s, t, np.array([v]), prior))
        for fold in e.folds():
            fewer = _without(blocks, k, e, s, t, fold, prior)
            outside += e.squares(fold, (fewer[:, 0], x[:, 0]))
    if repeating is not None:
        common = [information(e, s, r)[1] for e, s, r in zip(evidence, scatter, repeating, strict=True)]
        repeated = covariance @ np.sum(common, axis=0)
    else:
        repeated = np.zeros((len(prior), 0))
    inflation = _jackknife_inflation(np.array(left_out), covariance) * _student(len(left_out))
    ratio = float(np.sqrt(outside[0] / outside[1])) if outside[1] > 0 else float("nan")
    covariance = covariance * inflation + repeated @ repeated.T
    return HandEye(
        T_mount @ frames.exp(x[:6, 0]), covariance[:6, :6], inflation, tuple(scatter), ratio,
        columns.values + x[6:, 0], covariance[6:, 6:],
    )  # fmt: skip


def scatter_of(capture: Capture, freed: FreePoses, T_mount: Array) -> Repeatability:
    """The repeatability of one capture's poses, whatever its hand-eye."""
    nothing = np.zeros((6 * len(capture.scans), 0))
    return estimate(
        CaptureEvidence(capture, freed.overlaps.gram, freed.twists, capture.hand_eye_frames(T_mount), nothing).channel()
    )


def _prior(captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, columns: Columns) -> Array:
    """Precision of one radian and one working distance: keeps the unseen finite, moves nothing else."""
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, freed, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, columns.prior**-2.0]))


def _pull(columns: Columns) -> tuple[Array, Array]:
    """The effects' prior is about zero, not about their present values."""
    size = 6 + len(columns.values)
    pull = np.zeros((size, 1 + DRAWS))
    pull[6:, 0] = -columns.values * columns.prior**-2.0
    return np.zeros((size, size)), pull


def _without(
    blocks: Sequence[tuple[Array, Array]], k: int, evidence: CaptureEvidence, scatter: Repeatability, twists: Array,
    views: Indices, prior: Array,
) -> Array:  # fmt: skip
    """(6 + P, 1 + draws) estimates without some views of capture k."""
    fewer = evidence.without(views)
    size = len(prior)
    nothing = (np.zeros((size, size)), np.zeros((size, twists.shape[1])))
    block = information(fewer, scatter, drop(twists, views)) if len(fewer.gram.pairs) else nothing
    return _combine([*blocks[:k], block, *blocks[k + 1 :]], prior)[0]


def _combine(blocks: Sequence[tuple[Array, Array]], prior: Array) -> tuple[Array, Array]:
    """Estimates and covariance; parameters count in rad and mm, so the matrix is equilibrated first."""
    matrix = prior + np.sum([block[0] for block in blocks], axis=0)
    scale = 1 / np.sqrt(np.diag(matrix))
    covariance: Array = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(covariance @ np.sum([block[1] for block in blocks], axis=0)), covariance


def _student(views: int) -> float:
    """Variance of Student's t: the scatter that all sigmas rest on is itself known from so many views only."""
    return (views - 1) / (views - 3) if views > 4 else 3.0


def _jackknife_inflation(left_out: Array, covariance: Array) -> float:
    """How much more the left-out views move the estimates than chance explains, at least 1.

    The mean ratio of the jackknife's covariance to the model's over all directions, over its lower
    quartile under the model: with a handful of views the jackknife itself reads too large, and taking
    it at its word would widen sigmas that are right; of two readings the cautious one is taken.

    Args:
        left_out: (L, 6 + P, 1 + draws) estimates with one view left out; column 0 from the measurement.
    """
    count = len(left_out)
    if count < 4:
        return 1.0
    centred = left_out - left_out.mean(axis=0)
    scale = np.sqrt(np.diag(covariance))
    precision = np.linalg.inv(covariance / scale[:, None] / scale) / scale[:, None] / scale
    squares = np.einsum("lid,ij,ljd->d", centred, precision, centred, optimize=True)
    ratio = (count - 1) / count * squares / len(covariance)
    return float(max(1.0, ratio[0] / np.quantile(ratio[1:], 0.25)))
