"""The freed views of all sessions of a rig as one mixed model: hand-eye and effects beside errors of the poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from stitch.frames import Array, Indices
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.pose_channel import mean_of
from stitch.statistics.least_squares import generalised
from stitch.statistics.variance_components import MixedModel


@dataclass(frozen=True)
class RigModel:
    """N visible directions of all sessions; 6 + P unknowns."""

    parts: Sequence[CaptureEvidence]
    errors: PoseErrors
    mixed: MixedModel
    columns: Array  # (N, 6 + P) of hand-eye and effects

    def without(self, k: int, views: Indices) -> "RigModel":
        """Without some views of session k."""
        before = sum(e.gram.views for e in self.parts[:k])
        parts = [*self.parts[:k], self.parts[k].without(views), *self.parts[k + 1 :]]
        return rig_model(parts, self.errors.without(before + views))

    def solve(self, variances: Array, prior: Array, pull: Array) -> Array:
        """(6 + P,) unknowns by generalised least squares with a prior."""
        return generalised(self.mixed.covariance(variances)[0], self.columns, prior).solve(self.mixed.z[0], pull)

    def gain(self, variances: Array, prior: Array) -> Array:
        """(6 + P, N) from what was seen to the unknowns."""
        return generalised(self.mixed.covariance(variances)[0], self.columns, prior).gain

    def reduce(self, twists: Sequence[Array]) -> Array:
        """(N, K) visible directions of twists (6V, K) of every session."""
        return np.concatenate([e.channel.reduction @ t for e, t in zip(self.parts, twists, strict=True)])


def rig_model(parts: Sequence[CaptureEvidence], errors: PoseErrors) -> RigModel:
    """All sessions as one block: what the arm does wrong it does wrong in all of them."""
    channels = [e.channel for e in parts if len(e.gram.pairs)]
    kept = [e for e in parts if len(e.gram.pairs)]
    columns = np.concatenate([np.column_stack([e.channel.hand_eye, e.channel.reduction @ e.extra]) for e in kept])
    own = [
        block_diag(*matrices)
        for matrices in zip(*((c.rotation, c.translation, c.noise) for c in channels), strict=True)
    ]
    R = _reduction(parts)
    components = np.array([*own, *(R @ C @ R.T for C in errors.components)])
    z = np.concatenate([c.z for c in channels])
    mixed = MixedModel(z[None], mean_of(columns)[None], components[:, None], scales=errors.scales)
    return RigModel(parts, errors, mixed, columns)


def _reduction(parts: Sequence[CaptureEvidence]) -> Array:
    """(N, 6V) of all sessions; a session without pairs shows nothing."""
    return np.asarray(
        block_diag(*(e.channel.reduction if len(e.gram.pairs) else np.zeros((0, 6 * e.gram.views)) for e in parts))
    )
