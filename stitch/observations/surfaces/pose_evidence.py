"""What the overlaps say about the views, beside hand-eye and model, ready for every candidate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement, Term
from stitch.observations.surfaces.capture_evidence import jacobian
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.gram import column_space, fit_columns
from stitch.observations.surfaces.point_effects import PointGram, all_columns
from stitch.observations.surfaces.pose_channel import PoseChannel, evidence_of, pose_channel
from stitch.observations.surfaces.pose_trial import PoseTrial
from stitch.observations.surfaces.scanner_field import field_scatter
from stitch.statistics.folds import JointEnd, grouped_folds
from stitch.statistics.identifiability import independent
from stitch.statistics.satterthwaite import Satterthwaite, satterthwaite
from stitch.statistics.variance_components import Evidence, VarianceFit, fit_variances

# Columns of the model weaker than this many sigmas at their plausible size are not in the fit either.
_UNSEEN = 0.25


@dataclass(frozen=True)
class PoseEvidence:
    """One session under its model: channel, nuisance, null fit."""

    measurement: Measurement
    terms: tuple[Term, ...]
    capture: Capture
    T_mount: Array
    freed: FreePoses
    channel: PoseChannel
    model: Array  # (6V, a) twists of hand-eye and effects in use that the views can see
    evidence: Evidence
    null: VarianceFit

    @cached_property
    def covariance(self) -> Array:
        """(n, n) of the channel under the null."""
        return np.asarray(self.evidence.covariance(self.null.variances)[0])

    @cached_property
    def degrees_of_freedom(self) -> Satterthwaite:
        """How well the null's scatter is known."""
        return satterthwaite(self.evidence, self.null)

    def columns(self, candidates: Sequence[Term]) -> tuple[list[Array], PointGram | None, list[slice | None]]:
        """Twists (6V, P) of each candidate, and the sums of point effects."""
        return all_columns(self.measurement, self.terms, candidates, self.T_mount, self.freed)

    @cached_property
    def half(self) -> Array:
        """(n, n) Cholesky factor of the null's covariance."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def white_reduction(self) -> Array:
        """(n, 6V) twists of the views in units of the null's scatter."""
        return np.asarray(np.linalg.solve(self.half, self.channel.reduction))

    @cached_property
    def raw_white_z(self) -> Array:
        """(n,) what was seen in those units, with all that hand-eye and model explain."""
        return np.asarray(np.linalg.solve(self.half, self.channel.z))

    @cached_property
    def white_model(self) -> Array:
        """(n, a) hand-eye and model in units of the null's scatter."""
        return np.asarray(np.linalg.solve(self.half, self.channel.reduction @ self.model))

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal basis of `white_model`."""
        return column_space(self.white_model)

    @cached_property
    def white_z(self) -> Array:
        """(n,) what was seen, in the same units, without what hand-eye and model explain."""
        return self.whiten_channel(self.channel.z[:, None])[:, 0]

    def whiten_raw(self, columns: Array) -> Array:
        """(n, P) columns of the channel in those units."""
        return np.asarray(np.linalg.solve(self.half, columns), float)

    def whiten_channel(self, columns: Array) -> Array:
        """(n, P) columns of the channel in those units, what hand-eye and model explain projected out."""
        white = self.whiten_raw(columns)
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    def whiten(self, twists: Array) -> Array:
        """The same from twists (6V, P)."""
        return self.whiten_channel(self.channel.reduction @ twists)

    def in_channel(self, response: Array) -> Array:
        """(n, P) of twists (6V, P)."""
        return np.asarray(self.channel.reduction @ response)

    def in_blocks(self, columns: Array) -> Array:
        """(1, n, P): all views are one block."""
        return columns[None]

    def conditioned_on(self, columns: Array) -> "PoseEvidence":
        """The evidence with further free columns (n, p) of the channel in its model."""
        more = replace(self.evidence, A=np.concatenate([self.evidence.A, columns[None]], axis=2))
        # Twists of the model are read through `left`: the pseudo-inverse carries channel columns back to twists.
        back = np.linalg.pinv(self.channel.reduction) @ columns
        null = fit_variances(more, start=self.null.variances)
        return replace(self, model=np.hstack([self.model, back]), evidence=more, null=null)

    def trial(
        self, response: Array, points: PointGram | None = None, precision: Array | None = None
    ) -> PoseTrial:  # fmt: skip
        """A model with the columns of twists (6V, k)."""
        return PoseTrial(self, response, points, precision)

    def touched(self, views: Indices) -> Array:
        """(pairs,) bool: pairs with one of the views."""
        return np.asarray(np.isin(self.freed.overlaps.gram.pairs, views).any(axis=1))

    def ends(self) -> list[JointEnd]:
        """None: what overlaps leave belongs to pairs of views."""
        return []

    def at_part(self, numbers: Array) -> Array:
        """(V, 3) translations of the twists that make numbers (n,) of the channel, less the common motion."""
        out = (np.linalg.pinv(self.channel.reduction) @ numbers).reshape(-1, 6)[:, 3:]
        return np.asarray(out - out.mean(axis=0))

    def displaced(self) -> Array:
        """(V, 3) how far every view sits from where the model puts it, at the part, reference frame.

        Directions that the overlaps cannot see are at zero, the common motion of all views is taken out.
        """
        explained = self.model @ fit_columns(self.white_model, self.raw_white_z)
        return self.at_part(self.channel.z - self.channel.reduction @ explained)

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        return [np.asarray(f) for f in grouped_folds(self.capture.T_reference_mount, self.freed.overlaps.gram.lever)]


def pose_evidence(
    measurement: Measurement, terms: Sequence[Term], capture: Capture, T_mount: Array, freed: FreePoses
) -> PoseEvidence:
    """Reduce freed views to evidence.

    Args:
        capture: without the effects in `terms`.
        freed: its views moved by the overlaps alone, from the model's poses.
    """
    g = freed.overlaps.gram
    channel = pose_channel(g, freed.twists, capture.hand_eye_frames(T_mount), capture.T_reference_flange)
    hand_eye = jacobian(capture.hand_eye_frames(T_mount), g.centre)
    extra = np.hstack([np.zeros((6 * g.views, 0)), *all_columns(measurement, terms, terms, T_mount, freed)[0]])
    sizes = np.array([p.typical for t in terms for p in measurement.parameters(t.effect)])
    field = channel.reduction @ field_scatter(measurement, freed)
    alone = replace(evidence_of(channel), fixed=(field @ field.T)[None])
    half = np.linalg.cholesky(alone.covariance(fit_variances(alone, both_starts=True).variances)[0])
    own, further = (np.asarray(np.linalg.solve(half, c), float) for c in (channel.hand_eye, channel.reduction @ extra))
    seen = independent(own, further, sizes, _UNSEEN)
    model = np.hstack([hand_eye, extra[:, seen]])
    evidence = replace(evidence_of(channel, channel.reduction @ extra[:, seen]), fixed=alone.fixed)
    null = fit_variances(evidence, both_starts=True)
    return PoseEvidence(measurement, tuple(terms), capture, T_mount, freed, channel, model, evidence, null)
