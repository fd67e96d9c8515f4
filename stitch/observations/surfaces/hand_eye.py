"""The hand-eye and the effects in use from freed views: generalised least squares, covariance, held-out error.

No number of points averages out the error of a pose: views are the samples, and they weigh by the scatter that they
show, so that what remains is as small as it can be. What an arm does wrong it does again: no number of views averages
that out. `pose_errors.py` says how poses may err, the views say how much, and that is what the covariance of hand-eye
and effects counts. Errors of the scanner that repeat in every view come on top.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.error_model import WHITE_COMPONENTS
from stitch.observations.pose_errors import PoseErrors, white_scatter_only
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.hand_eye_solution import FittedEffects, HandEyeSolution, solve_hand_eye
from stitch.observations.surfaces.pose_channel import Repeatability, estimate_repeatability
from stitch.observations.surfaces.rig_model import stack_captures
from stitch.statistics.variance_components import fit_variances
from stitch.statistics.variance_posterior import mean_variances

# Errors of the scanner that all views repeat, by their name among the sources of the hand-eye's variance.
SCANNER_FIELD = "scanner field"
# White scatter of more numbers is known well enough to take its maximum.
_PLUG_IN = 300


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
    values: Array = field(default_factory=lambda: np.zeros(0))  # (P,) of the effects
    values_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (P, P)

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
) -> HandEyeFit:
    """Generalised least squares over the pose channels of all captures; covariance under all errors of the poses.

    Args:
        unconstrained: per capture the views moved by the overlaps alone, from the poses under `T_mount`.
        T_mount: (4, 4) hand-eye at which that began.
        columns: effects to fit with it.
        scanner_errors: by source, per capture (6V, K) twists that the views show for one standard deviation of each of K
            errors that all views and captures have in common; they widen the covariance and change nothing else.
        errors: how the poses may err beside white scatter; None: they do not. What joints do anew is not counted: on
            average the scatter of the flange that views show holds it already.
    """
    found = solve_hand_eye(captures, unconstrained, T_mount, columns)
    errors = errors or white_scatter_only(sum(len(f.poses) for f in unconstrained))
    sources = _variance_sources(found, errors.repeating_only(), scanner_errors or {})
    covariance = np.sum(list(sources.values()), axis=0)
    return HandEyeFit(
        T_mount=T_mount @ frames.exp(found.x[:6]),
        covariance=covariance[:6, :6],
        inflation=_covariance_inflation(covariance, found.gls.covariance),
        repeatability=found.scatter,
        heldout_ratio=_heldout_ratio(found.parts, found.scatter, (found.prior, found.prior_vector), found.x),
        rotation_shares=_source_shares(sources, slice(0, 3)),
        position_shares=_source_shares(sources, slice(3, 6)),
        values=found.values + found.x[6:],
        values_covariance=covariance[6:, 6:],
    )


def _variance_sources(
    found: HandEyeSolution, errors: PoseErrors, scanner_errors: Mapping[str, Sequence[Array]]
) -> dict[str, Array]:
    """What each source does to the covariance (6 + P, 6 + P)."""
    rig, weighed = found.rig, found.gls
    mixed = rig.mixed(errors)
    sizes = fit_variances(mixed, both_starts=True)
    mean = sizes.variances if not errors.names and mixed.size > _PLUG_IN else mean_variances(mixed, sizes)
    names = (*WHITE_COMPONENTS, *errors.names)
    components = zip(names, mean, mixed.components[:, 0], strict=True)
    sources = {name: size * weighed.gain @ C @ weighed.gain.T for name, size, C in components}
    for name, twists in scanner_errors.items():
        repeated = weighed.gain @ rig.reduce(twists)
        sources[name] = repeated @ repeated.T
    # The rest is what the prior leaves where nothing is seen.
    sources["unseen"] = weighed.covariance @ found.prior @ weighed.covariance
    return sources


def _covariance_inflation(covariance: Array, independent: Array) -> float:
    ratio = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(independent)[1]
    return float(max(1.0, np.exp(ratio / len(covariance))))


def _source_shares(sources: dict[str, Array], axes: slice) -> dict[str, float]:
    """Of every source in the variance of some axes of the hand-eye together."""
    own = {name: float(np.trace(matrix[axes, axes])) for name, matrix in sources.items()}
    return {name: square / max(sum(own.values()), 1e-300) for name, square in own.items()}


def capture_repeatability(capture: Capture, unconstrained: UnconstrainedPoses, T_mount: Array) -> Repeatability:
    """The repeatability of one capture's poses, whatever its hand-eye, linearised at T_mount (4, 4)."""
    nothing = np.zeros((6 * len(capture.scans), 0))
    own = CaptureEvidence(
        capture, unconstrained.overlaps.gram, unconstrained.twists, capture.hand_eye_frames(T_mount), nothing
    )
    return estimate_repeatability(own.reduced_poses)


def _heldout_ratio(
    parts: Sequence[CaptureEvidence], scatter: Sequence[Repeatability], prior: tuple[Array, Array], x: Array
) -> float:
    """Rms of views left out in groups over that of the same pairs under the estimates x (6 + P,) of all views.

    Args:
        prior: precision (6 + P, 6 + P), and that times its middle (6 + P,).
    """
    outside = np.zeros(2)
    for k, e in enumerate(parts):
        for fold in e.folds():
            fewer = e.without(fold)
            rest = [(o, s) for i, (o, s) in enumerate(zip(parts, scatter, strict=True)) if i != k]
            rest += [(fewer, scatter[k])] if len(fewer.gram.pairs) else []
            if rest:
                rig = stack_captures([o for o, _ in rest])
                left_out = rig.fit_gls([s for _, s in rest], prior[0]).solve(rig.z, prior[1])
                outside += e.squares(fold, (left_out, x))
    return float(np.sqrt(outside[0] / outside[1])) if outside[1] > 0 else float("nan")
