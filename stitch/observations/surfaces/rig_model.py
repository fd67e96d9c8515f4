"""The freed views of all sessions of a rig as one mixed model: hand-eye and effects beside errors of the poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from stitch.frames import Array
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.pose_channel import Repeatability, mean_basis, pose_covariance
from stitch.statistics.least_squares import GeneralisedFit, generalised_fit
from stitch.statistics.restricted_likelihood import MixedModel


@dataclass(frozen=True)
class RigModel:
    """N visible directions of all sessions; 6 + P unknowns."""

    parts: Sequence[CaptureEvidence]
    z: Array  # (N,)
    columns: Array  # (N, 6 + P) of hand-eye and effects

    def fit_gls(self, scatter: Sequence[Repeatability], prior: Array) -> GeneralisedFit:
        """Generalised least squares under the scatter of every session alone, with a prior (6 + P, 6 + P)."""
        noise = [pose_covariance(e.reduced_poses, s) for e, s in zip(self.parts, scatter, strict=True)]
        return generalised_fit(block_diag(*noise), self.columns, prior)

    def mixed(self, errors: PoseErrors) -> MixedModel:
        """All sessions as one block: what the arm does wrong it does wrong in all of them."""
        channels = [e.reduced_poses for e in self.parts]
        own = zip(*((c.rotation, c.translation, c.noise) for c in channels), strict=True)
        R = block_diag(*(c.reduction for c in channels))
        components = np.array([*(block_diag(*c) for c in own), *(R @ C @ R.T for C in errors.components)])
        mean = mean_basis(self.columns)
        return MixedModel(self.z[None], mean[None], components[:, None], further=errors.prior)

    def reduce(self, twists: Sequence[Array]) -> Array:
        """(N, K) visible directions of twists (6V, K) of every session."""
        return np.concatenate([e.reduced_poses.reduction @ t for e, t in zip(self.parts, twists, strict=True)])


def stack_captures(parts: Sequence[CaptureEvidence]) -> RigModel:
    """All sessions stacked."""
    columns = [np.column_stack([e.reduced_poses.hand_eye, e.reduced_poses.reduction @ e.effect_twists]) for e in parts]
    return RigModel(parts, np.concatenate([e.reduced_poses.z for e in parts]), np.concatenate(columns))
