"""The linear model of overlapping surfaces: views freed by their overlaps, read through the visible directions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.term import Term, sizes_of, values_of
from stitch.observations.error_model import with_errors
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import pose_errors
from stitch.observations.response import PointSums, Prior, Response
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.pose_channel import PoseChannel, jacobian, mixed_model, pose_channel
from stitch.observations.surfaces.scanner_field import field_scatter
from stitch.observations.surfaces.surface_trial import SurfaceTrial
from stitch.observations.surfaces.view_responses import view_columns, view_responses
from stitch.statistics.folds import JointEnd, grouped_folds
from stitch.statistics.identifiability import independent
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.variance_components import VarianceFit, at_variances, fit_variances

# Columns of the model weaker than this many sigmas at their plausible size are not in the fit either.
_UNSEEN = 0.25
# Scoring every candidate beside all errors that poses may have takes a minute for so many views; there poses count as
# scattering independently, and effects are sought several at once.
_MOST_VIEWS = 100


@dataclass(frozen=True)
class Surfaces:
    """V freed views; a response counts twists (6V, P), the channel their n visible directions."""

    capture: Capture  # without the effects in use
    freed: FreePoses
    channel: PoseChannel

    @property
    def centre(self) -> Array:
        """(3,) of the overlaps, reference frame."""
        return self.freed.overlaps.gram.centre

    def by_twists(self, moved: Array) -> Array:
        """(n, P) visible directions of twists (6V, P): a response counts nothing else."""
        return self.reduce(moved)

    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Twists (6V, P) of each term, and the sums of point effects."""
        return view_responses(measurement, model, terms, self.freed)

    def reduce(self, response: Array) -> Array:
        """(n, P) visible directions of twists (6V, P)."""
        return np.asarray(self.channel.reduction @ response)

    def expand(self, columns: Array) -> Array:
        """(6V, P) the shortest twists that make numbers (n, P) of the channel."""
        return np.asarray(self.channel.expansion @ columns)

    def trial(
        self, linear: LinearModel, response: Array, points: PointSums | None = None, prior: Prior | None = None
    ) -> SurfaceTrial:
        """A model with the columns of twists (6V, k)."""
        return SurfaceTrial(linear, self.freed, response, points, prior)

    def touched(self, views: Indices) -> Mask:
        """(pairs,) with one of the views."""
        return np.asarray(np.isin(self.freed.overlaps.gram.pairs, views).any(axis=1))

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        return self._folds

    @cached_property
    def _folds(self) -> list[Indices]:
        return grouped_folds(self.capture.T_reference_mount, self.freed.overlaps.gram.lever)

    def ends(self, joints: Array) -> list[JointEnd]:
        """None: what overlaps leave belongs to pairs of views."""
        return []

    def at_part(self, numbers: Array) -> Array:
        """(V, 3) translations of the twists that make numbers (n,) of the channel, less the common motion."""
        out = self.expand(numbers).reshape(-1, 6)[:, 3:]
        return np.asarray(out - out.mean(axis=0))


def surface_model(
    measurement: Measurement,
    model: Model,
    capture: Capture,
    freed: FreePoses,
    variances: Callable[[Sequence[str]], Array] | None = None,
) -> LinearModel:
    """Reduce freed views to a linear model.

    Args:
        capture: without the effects of the model.
        freed: its views moved by the overlaps alone, from the model's poses.
        variances: of scatter, noise and further errors of these names, of views that nobody has taken; None: as the
            views tell.
    """
    g, frames_of_mount = freed.overlaps.gram, capture.hand_eye_frames(model.T_mount)
    channel = pose_channel(g, freed.twists, frames_of_mount, capture.T_reference_flange)
    extra = view_columns(measurement, model, freed)
    sizes = sizes_of(model.terms)
    field = channel.reduction @ field_scatter(measurement, freed)
    alone = replace(mixed_model(channel), fixed=(field @ field.T)[None])
    half = np.linalg.cholesky(alone.covariance(_null(alone, (), variances).variances)[0])
    white = (np.asarray(np.linalg.solve(half, c), float) for c in (channel.hand_eye, channel.reduction @ extra))
    own, further = white
    seen = independent(own, further, sizes, _UNSEEN)
    mixed = replace(mixed_model(channel, channel.reduction @ extra[:, seen]), fixed=alone.fixed)
    design = np.hstack([jacobian(frames_of_mount, g.centre), extra[:, seen]])
    errors = None
    if measurement.views.count < _MOST_VIEWS:
        errors = pose_errors([measurement], model, [g.centre]).reduced(channel.reduction)
        mixed = with_errors(mixed, errors)
    null = _null(mixed, () if errors is None else errors.names, variances)
    values = values_of(model.terms)
    return LinearModel(
        measurement,
        model,
        Surfaces(capture, freed, channel),
        design,
        sizes=np.append(np.full(6, np.inf), sizes[seen]),
        values=np.append(np.zeros(6), values[seen]),
        mixed=mixed,
        null=null,
        pose_errors=errors,
        by_joints=np.zeros(2) if errors is None else errors.by_joints,
    )


def _null(mixed: MixedModel, names: Sequence[str], variances: Callable[[Sequence[str]], Array] | None) -> VarianceFit:
    return fit_variances(mixed, both_starts=True) if variances is None else at_variances(mixed, variances(names))
