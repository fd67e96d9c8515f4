"""The hand-eye and the effects in use from freed views: generalised least squares, covariance, held-out error.

The poses of the views scatter by the robot's repeatability, which no number of points averages
out: views are the samples. Errors of the scanner that repeat in every view come on top: no number of views
averages them out either. Estimates with views left out give the held-out error and show whether the
covariance is too small for these data (jackknife; Efron & Stein 1981): a robot whose pose errors are
not independent from view to view has a larger one, never a smaller.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.capture_evidence import DRAWS, CaptureEvidence
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.pose_channel import Repeatability, estimate
from stitch.statistics.jackknife import drawn_inflation


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
) -> HandEye:
    """Generalised least squares over the pose channels of all captures.

    Args:
        freed: per capture the views moved by the overlaps alone, from the poses under `T_mount`.
        T_mount: (4, 4) hand-eye at which that began.
        columns: effects to fit with it.
        repeating: per capture (6V, K) twists that the views show for one standard deviation of each of K errors
            that all views and captures have in common; they widen the covariance and change nothing else.
    """
    columns = columns or Columns(tuple(np.zeros((6 * len(c.scans), 0)) for c in captures), np.zeros(0), np.zeros(0))
    parts = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, c.hand_eye_frames(T_mount), extra)
        for c, f, extra in zip(captures, freed, columns.twists, strict=True)
    ]
    scatter = [estimate(e.channel, e.further) for e in parts]
    # Column 0 of the twists is what was measured; the others are draws of what this scatter alone would give.
    twists = [e.measured_and_drawn(s) for e, s in zip(parts, scatter, strict=True)]
    joint = _Joint(parts, scatter, twists, _prior(captures, freed, T_mount, columns), _pull(columns))
    x, covariance = joint.solve()
    repeated = np.zeros((len(x), 0))
    if repeating is not None:
        common = [e.information(s, r)[1] for e, s, r in zip(parts, scatter, repeating, strict=True)]
        repeated = covariance @ np.sum(common, axis=0)
    left_out = [joint.without(k, np.array([v])) for k, e in enumerate(parts) for v in range(e.gram.views)]
    inflation = drawn_inflation(np.array(left_out), covariance) * _student(len(left_out))
    covariance = covariance * inflation + repeated @ repeated.T
    return HandEye(
        T_mount=T_mount @ frames.exp(x[:6, 0]),
        covariance=covariance[:6, :6],
        inflation=inflation,
        repeatability=tuple(scatter),
        heldout_ratio=joint.heldout_ratio(x),
        values=columns.values + x[6:, 0],
        values_covariance=covariance[6:, 6:],
    )


def scatter_of(capture: Capture, freed: FreePoses, T_mount: Array) -> Repeatability:
    """The repeatability of one capture's poses, whatever its hand-eye."""
    nothing = np.zeros((6 * len(capture.scans), 0))
    own = CaptureEvidence(capture, freed.overlaps.gram, freed.twists, capture.hand_eye_frames(T_mount), nothing)
    return estimate(own.channel)


@dataclass(frozen=True)
class _Joint:
    """All captures of a rig as normal equations of 6 + P unknowns, for the measurement and its draws."""

    parts: Sequence[CaptureEvidence]
    scatter: Sequence[Repeatability]
    twists: Sequence[Array]  # per capture (6V, 1 + draws)
    prior: Array  # (6 + P, 6 + P)
    pull: Array  # (6 + P, 1 + draws)

    @cached_property
    def blocks(self) -> list[tuple[Array, Array]]:
        """Per capture information (6 + P, 6 + P) and vectors (6 + P, 1 + draws)."""
        return [e.information(s, t) for e, s, t in zip(self.parts, self.scatter, self.twists, strict=True)]

    def solve(self, k: int | None = None, instead: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
        """Estimates (6 + P, 1 + draws) and covariance, with another block for capture k.

        Parameters count in rad and mm, so the matrix is equilibrated first.
        """
        blocks = list(self.blocks)
        if k is not None and instead is not None:
            blocks[k] = instead
        matrix = self.prior + np.sum([block[0] for block in blocks], axis=0)
        vector = np.sum([*(block[1] for block in blocks), self.pull], axis=0)
        scale = 1 / np.sqrt(np.diag(matrix))
        covariance: Array = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
        return np.asarray(covariance @ vector), covariance

    def without(self, k: int, views: Indices) -> Array:
        """(6 + P, 1 + draws) estimates without some views of capture k."""
        fewer = self.parts[k].without(views)
        block = (np.zeros_like(self.prior), np.zeros_like(self.pull))
        if len(fewer.gram.pairs):
            block = fewer.information(self.scatter[k], CaptureEvidence.drop(self.twists[k], views))
        return self.solve(k, block)[0]

    def heldout_ratio(self, x: Array) -> float:
        """Rms of views left out in groups over that of the same pairs under the estimates x of all views."""
        outside = np.zeros(2)
        for k, e in enumerate(self.parts):
            for fold in e.folds():
                outside += e.squares(fold, (self.without(k, fold)[:, 0], x[:, 0]))
        return float(np.sqrt(outside[0] / outside[1])) if outside[1] > 0 else float("nan")


def _prior(captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, columns: Columns) -> Array:
    """Precision of one radian and one working distance: keeps the unseen finite, moves nothing else."""
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, freed, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, columns.prior**-2.0]))


def _pull(columns: Columns) -> Array:
    """The effects' prior is about zero, not about their present values."""
    pull = np.zeros((6 + len(columns.values), 1 + DRAWS))
    pull[6:, 0] = -columns.values * columns.prior**-2.0
    return pull


def _student(views: int) -> float:
    """Variance of Student's t: the scatter that all sigmas rest on is itself known from so many views only."""
    return (views - 1) / (views - 3) if views > 4 else 3.0
