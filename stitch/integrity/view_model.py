"""What overlaps and targets say about the pose of every view, as one linear model of visible directions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, visible_directions
from stitch.statistics.least_squares import column_space, summed_squares
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.variance_components import VarianceFit, fit_variances

# Combinations of parameters weaker than this share of the strongest are not seen.
SEEN = 1e-6
# A direction of one view's displacement is held if surfaces see this share of it. Where a scan slides along the others
# it is 0.001 and less, and what little is seen is their noise; elsewhere 0.9.
_HELD_SHARE = 0.1


@dataclass(frozen=True)
class ViewModel:
    """Linear evidence about the poses of V views: n visible directions."""

    z: Array  # (n,)
    hand_eye: Array  # (n, 6) response to a common correction of the hand-eye
    views: Array  # (V, n, 6) response to a left twist of one view about `centre`, rotations in 1/lever
    carried: Array  # (V, 6, 6) from a twist of the flange to that twist, rotations in 1/lever
    mounts: Array  # (V, n, 6) response of one view to a correction of its own hand-eye
    mount_twists: Array  # (V, 6, 6) the twist of a view that such a correction makes, rotations in 1/lever
    noise: Array  # (n, n) covariance of the sensor noise within overlaps
    centre: Array  # (3,) reference frame
    lever: float  # length_unit: rotations about `centre` count as displacements at this distance
    usual: Array | None = None  # (n, n) covariance of what effects of the library may do
    errors: PoseErrors | None = None  # of the n numbers, beside white scatter, in sizes that the views show

    def with_usual(self, twists: Array) -> "ViewModel":
        """The model of an arm that may have effects: twists (6V, P) of the views about the centre, rad and length."""
        unit = np.array([self.lever] * 3 + [1.0] * 3)
        columns = np.einsum("vni,vip->np", self.views, twists.reshape(self.count, 6, -1) * unit[:, None])
        return replace(self, usual=columns @ columns.T)

    def with_errors(self, errors: PoseErrors) -> "ViewModel":
        """The model of poses that may err beside white scatter by twists about the centre, in rad and length."""
        unit = np.array([self.lever] * 3 + [1.0] * 3)
        return replace(self, errors=errors.project((self.views * unit).transpose(1, 0, 2).reshape(len(self.z), -1)))

    @property
    def count(self) -> int:
        """Number of views."""
        return len(self.views)

    def mixed(self, further: Array | None = None) -> MixedModel:
        """The model with further columns (n, K) in its mean, ready for restricted maximum likelihood."""
        mean = self.hand_eye if further is None else np.column_stack([self.hand_eye, further])
        usual = None if self.usual is None else self.usual[None]
        A, components = column_space(mean, SEEN)[None], self._components
        if self.errors is None:
            return MixedModel(self.z[None], A, components, usual)
        every = np.concatenate([components, self.errors.components[:, None]])
        return MixedModel(self.z[None], A, every, usual, further=self.errors.prior)

    @cached_property
    def held_responses(self) -> Array:
        """(V, n, 6) as `views`, less the directions in which nothing holds a single view."""
        _, values, vectors = np.linalg.svd(self.views, full_matrices=False)
        held = vectors * (values**2 > _HELD_SHARE)[:, :, None]
        return np.asarray(self.views @ held.transpose(0, 2, 1) @ vectors)

    @cached_property
    def _components(self) -> Array:
        """(3, 1, n, n) covariances of unit scatter of the flange, rotation and translation, and of the noise."""
        blocks = self.views @ self.carried
        return np.array([*(summed_squares(b) for b in (blocks[:, :, :3], blocks[:, :, 3:])), self.noise])[:, None]

    def fit(self, further: Array | None = None) -> VarianceFit:
        """Scatter of the poses (rotation², translation², noise factor) with further columns in the mean."""
        return fit_variances(self.mixed(further), both_starts=self.errors is not None)

    def deviance(self, further: Array | None = None) -> float:
        """−2 log of the full likelihood of z with further columns in the mean, comparable between means."""
        fit = self.fit(further)
        C = self.mixed(further).covariance(fit.variances)[0]
        return float(np.linalg.slogdet(C)[1] + self.z @ projector(self, fit, further).projected)

    def columns(self, free_views: Sequence[int]) -> Array | None:
        """(n, 6k) that let some views stand anywhere."""
        return np.concatenate([self.views[v] for v in free_views], axis=1) if len(free_views) else None


def view_model(capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses) -> ViewModel:
    """The evidence of overlaps and targets about the poses of a capture.

    Args:
        T_mount: (4, 4) hand-eye of the model poses from which `freed.twists` are counted.
    """
    g = unconstrained.overlaps.gram
    values, vectors, scale = visible_directions(g)
    left = (vectors.T / scale[None, :]).reshape(len(values), g.views, 6).transpose(1, 0, 2)
    to_centre = frames.make(np.eye(3), -g.centre)
    J = frames.adjoint(to_centre @ capture.hand_eye_frames(T_mount))
    carried = frames.adjoint(to_centre @ capture.T_reference_flange)
    lever = max(g.lever, 1e-300)
    unit = np.diag([1 / lever] * 3 + [1.0] * 3)
    return ViewModel(
        z=np.einsum("vni,vi->n", left, unconstrained.twists),
        hand_eye=np.einsum("vni,vij->nj", left, J),
        views=left @ unit,
        carried=np.linalg.inv(unit) @ carried,
        mounts=left @ J,
        mount_twists=np.linalg.inv(unit) @ J,
        noise=np.diag(g.variance / values),
        centre=g.centre,
        lever=lever,
    )


@dataclass(frozen=True)
class Projector:
    """P of one null hypothesis: a fitted covariance and a free mean."""

    P: Array  # (n, n)
    projected: Array  # (n,) P z
    degrees: int  # n less the columns of the mean


def projector(model: ViewModel, fit: VarianceFit, further: Array | None = None) -> Projector:
    """P for variances that were fitted, with further columns (n, K) in the mean."""
    mixed = model.mixed(further)
    A = mixed.A[0]
    C = mixed.covariance(fit.variances)[0]
    both = np.linalg.solve(C, np.column_stack([A, np.eye(len(C))]))
    CA, inverse = both[:, : A.shape[1]], both[:, A.shape[1] :]
    P = inverse - CA @ np.linalg.solve(A.T @ CA, CA.T)
    return Projector(P, P @ model.z, len(C) - A.shape[1])
