"""The freed views of all sessions of a rig as one mixed model: hand-eye and effects beside errors of the poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from stitch.frames import Array
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.pose_channel import Repeatability, covariance_of, mean_of
from stitch.statistics.least_squares import Generalised, generalised
from stitch.statistics.restricted_likelihood import MixedModel


@dataclass(frozen=True)
class RigModel:
    """N visible directions of all sessions; 6 + P unknowns."""

    parts: Sequence[CaptureEvidence]
    z: Array  # (N,)
    columns: Array  # (N, 6 + P) of hand-eye and effects

    def weighed(self, scatter: Sequence[Repeatability], prior: Array) -> Generalised:
        """Generalised least squares under the scatter of every session alone, with a prior (6 + P, 6 + P)."""
        noise = [covariance_of(e.channel, s) for e, s in zip(self.parts, scatter, strict=True)]
        return generalised(block_diag(*noise), self.columns, prior)

    def mixed(self, errors: PoseErrors) -> MixedModel:
        """All sessions as one block: what the arm does wrong it does wrong in all of them."""
        channels = [e.channel for e in self.parts]
        own = zip(*((c.rotation, c.translation, c.noise) for c in channels), strict=True)
        R = block_diag(*(c.reduction for c in channels))
        components = np.array([*(block_diag(*c) for c in own), *(R @ C @ R.T for C in errors.components)])
        mean = mean_of(self.columns)
        return MixedModel(self.z[None], mean[None], components[:, None], further=errors.prior)

    def reduce(self, twists: Sequence[Array]) -> Array:
        """(N, K) visible directions of twists (6V, K) of every session."""
        return np.concatenate([e.channel.reduction @ t for e, t in zip(self.parts, twists, strict=True)])


def rig_model(parts: Sequence[CaptureEvidence]) -> RigModel:
    """All sessions stacked."""
    columns = [np.column_stack([e.channel.hand_eye, e.channel.reduction @ e.extra]) for e in parts]
    return RigModel(parts, np.concatenate([e.channel.z for e in parts]), np.concatenate(columns))
