"""What the overlaps say about the views, beside hand-eye and model, ready for every candidate."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.capture import Capture
from stitch.effects.chain import Chain, Term
from stitch.effects.columns import PointGram, all_columns
from stitch.effects.visible import independent, project_out
from stitch.folds import grouped_folds
from stitch.frames import Array
from stitch.free_poses import FreePoses
from stitch.hand_eye import jacobian
from stitch.repeatability import PoseChannel, evidence_of, pose_channel
from stitch.variance import Evidence, VarianceFit, fit_variances

# Columns of the model weaker than this many sigmas at their plausible size are not in the fit either.
_UNSEEN = 0.25


@dataclass(frozen=True)
class PoseEvidence:
    """One session under its model: channel, nuisance, null fit."""

    chain: Chain
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
        return np.asarray(np.einsum("c,cij->ij", self.null.variances, self.evidence.components[:, 0]))

    def columns(self, candidates: Sequence[Term]) -> tuple[list[Array], PointGram | None, list[slice | None]]:
        """Twists (6V, P) of each candidate, and the sums of point effects."""
        return all_columns(self.chain, self.terms, candidates, self.T_mount, self.freed)

    @cached_property
    def half(self) -> Array:
        """(n, n) Cholesky factor of the null's covariance."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def white_left(self) -> Array:
        """(n, 6V) twists of the views in units of the null's scatter."""
        return np.asarray(np.linalg.solve(self.half, self.channel.left))

    @cached_property
    def raw_white_z(self) -> Array:
        """(n,) what was seen in those units, with all that hand-eye and model explain."""
        return np.asarray(np.linalg.solve(self.half, self.channel.z))

    @cached_property
    def white_model(self) -> Array:
        """(n, a) hand-eye and model in units of the null's scatter."""
        return np.asarray(np.linalg.solve(self.half, self.channel.left @ self.model))

    @cached_property
    def white_z(self) -> Array:
        """(n,) what was seen, in the same units, without what hand-eye and model explain."""
        return self.whiten_channel(self.channel.z[:, None])[:, 0]

    def whiten_channel(self, columns: Array) -> Array:
        """(n, P) columns of the channel in those units, what hand-eye and model explain projected out."""
        return project_out(self.white_model, np.asarray(np.linalg.solve(self.half, columns), float))

    def whiten(self, twists: Array) -> Array:
        """The same from twists (6V, P)."""
        return self.whiten_channel(self.channel.left @ twists)

    def folds(self) -> list[Array]:
        """Groups of views to leave out."""
        return [np.asarray(f) for f in grouped_folds(self.capture.T_reference_mount, self.freed.overlaps.gram.lever)]


def pose_evidence(
    chain: Chain, terms: Sequence[Term], capture: Capture, T_mount: Array, freed: FreePoses
) -> PoseEvidence:
    """Reduce freed views to evidence.

    Args:
        capture: without the effects in `terms`.
        freed: its views moved by the overlaps alone, from the model's poses.
    """
    g = freed.overlaps.gram
    channel = pose_channel(g, freed.twists, capture.carriers(T_mount), capture.T_reference_flange)
    hand_eye = jacobian(capture.carriers(T_mount), g.centre)
    extra = np.hstack([np.zeros((6 * g.views, 0)), *all_columns(chain, terms, terms, T_mount, freed)[0]])
    sizes = np.array([p.typical for t in terms for p in chain.parameters(t.effect)])
    start = fit_variances(evidence_of(channel), both_starts=True)
    half = np.linalg.cholesky(np.einsum("c,cij->ij", start.variances, evidence_of(channel).components[:, 0]))
    own, further = (np.asarray(np.linalg.solve(half, c), float) for c in (channel.hand_eye, channel.left @ extra))
    seen = independent(own, further, sizes, _UNSEEN)
    model = np.hstack([hand_eye, extra[:, seen]])
    evidence = evidence_of(channel, channel.left @ extra[:, seen])
    null = fit_variances(evidence, both_starts=True)
    return PoseEvidence(chain, tuple(terms), capture, T_mount, freed, channel, model, evidence, null)
