"""What labelled points say about the views, beside hand-eye, landmarks and model; every view is a block of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import corrected
from stitch.observations.surfaces.gram import column_space
from stitch.observations.surfaces.point_effects import PointGram
from stitch.observations.targets.landmarks import Drawing, Landmarks, initial_landmarks
from stitch.observations.targets.rows import Rows, effect_rows, evidence_of_rows, rows_of
from stitch.observations.targets.target_trial import TargetTrial
from stitch.stages.joint_fit import UNSEEN
from stitch.statistics.block_least_squares import whitener
from stitch.statistics.folds import JointEnd, grouped_folds, joint_ends
from stitch.statistics.identifiability import independent
from stitch.statistics.satterthwaite import Satterthwaite, satterthwaite
from stitch.statistics.variance_components import Evidence, VarianceFit, fit_variances


@dataclass(frozen=True)
class TargetEvidence:
    """One session under its model. A response counts rows: n = B·m of them, those of absent targets at zero."""

    measurement: Measurement
    terms: tuple[Term, ...]
    T_mount: Array
    rows: Rows
    landmarks: Landmarks
    model: Array  # (n, a) of hand-eye, landmarks and effects in use that the views can see
    evidence: Evidence
    null: VarianceFit

    @cached_property
    def degrees_of_freedom(self) -> Satterthwaite:
        """How well the null's scatter is known."""
        return satterthwaite(self.evidence, self.null)

    def columns(self, candidates: Sequence[Term]) -> tuple[list[Array], PointGram | None, list[slice | None]]:
        """Rows (n, P) of each candidate; point effects need no sums over pairs here."""
        found = [effect_rows(self.rows, self.measurement, self.terms, c) for c in candidates]
        return [c.reshape(self.rows.residual.size, c.shape[2]) for c in found], None, [None] * len(found)

    def in_channel(self, response: Array) -> Array:
        """(n, P): the rows themselves."""
        return response

    def in_blocks(self, columns: Array) -> Array:
        """(B, m, P)."""
        return columns.reshape(*self.rows.residual.shape, columns.shape[1])

    @cached_property
    def half(self) -> Array:
        """(B, m, m) inverse Cholesky factors of the null's covariance."""
        return whitener(self.evidence, self.null.variances)

    @cached_property
    def white_model(self) -> Array:
        """(n, a) hand-eye, landmarks and model in units of the null's scatter."""
        return self.whiten_raw(self.model)

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal basis of `white_model`."""
        return column_space(self.white_model)

    @cached_property
    def white_z(self) -> Array:
        """(n,) what was seen, in the same units, without what the model explains."""
        return self.whiten_channel(-self.rows.residual.reshape(-1, 1))[:, 0]

    def whiten_raw(self, columns: Array) -> Array:
        """(n, P) columns in those units."""
        return np.asarray((self.half @ self.in_blocks(columns)).reshape(columns.shape))

    def whiten_channel(self, columns: Array) -> Array:
        """(n, P) columns in those units, what the model explains projected out."""
        white = self.whiten_raw(columns)
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    def whiten(self, response: Array) -> Array:
        """The same."""
        return self.whiten_channel(response)

    def conditioned_on(self, columns: Array) -> "TargetEvidence":
        """The evidence with further free columns (n, p) in its model."""
        more = replace(self.evidence, A=np.concatenate([self.evidence.A, self.in_blocks(columns)], axis=2))
        null = fit_variances(more, start=self.null.variances)
        return replace(self, model=np.hstack([self.model, columns]), evidence=more, null=null)

    def trial(
        self, response: Array, points: PointGram | None = None, precision: Array | None = None
    ) -> TargetTrial:  # fmt: skip
        """A model with the columns of rows (n, k)."""
        if response is self.model:
            return self._present
        return TargetTrial(self.rows, self._covariance, self.in_blocks(response), precision)

    @cached_property
    def _covariance(self) -> Array:
        return self.evidence.covariance(self.null.variances)

    @cached_property
    def _present(self) -> TargetTrial:
        """The model as it is, asked for every candidate."""
        return TargetTrial(self.rows, self._covariance, self.in_blocks(self.model))

    def touched(self, views: Indices) -> Array:
        """(V,) bool."""
        return np.asarray(np.isin(np.arange(len(self.rows.lever)), views))

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        return grouped_folds(self.rows.capture.T_reference_mount, self.rows.reach)

    def ends(self) -> list[JointEnd]:
        """Both ends of every joint's range, of the views that show a target."""
        return joint_ends(self.measurement.views.joints, np.flatnonzero(self.rows.used.any(axis=1)))

    def at_part(self, numbers: Array) -> Array:
        """(V, 3) mean displacement of the targets that a view shows; zero for one that shows none."""
        V = len(self.rows.lever)
        shown = self.rows.used[:, : self.rows.positions : 3]
        moved = numbers.reshape(self.rows.residual.shape)[:V, : self.rows.positions].reshape(V, -1, 3)
        return np.asarray(moved.sum(axis=1) / np.maximum(shown.sum(axis=1), 1)[:, None])

    def displaced(self) -> Array:
        """(V, 3) how far the targets of every view sit from where the model puts them."""
        return self.at_part(-(self.rows.residual + self._present.X @ self._present.solve(None)))


def target_evidence(
    measurement: Measurement, terms: Sequence[Term], T_mount: Array, drawing: Drawing | None
) -> TargetEvidence:
    """Linearise the labelled points of a session about its model.

    Args:
        measurement: with the sightings that count.
    """
    own = corrected(measurement, terms, T_mount)
    landmarks = initial_landmarks(own, T_mount, drawing)
    rows = rows_of(own, T_mount, landmarks)
    base = np.concatenate([rows.hand_eye, rows.landmarks], axis=2)
    extra = np.concatenate([base[..., :0], *(effect_rows(rows, measurement, terms, t) for t in terms)], axis=2)
    sizes = np.array([p.typical for t in terms for p in measurement.parameters(t.effect)])
    # Parameters that the fit left at zero are not in the model.
    used = np.array([v != 0 and not p.discrete for t in terms
                     for p, v in zip(measurement.parameters(t.effect), t.values, strict=True)], bool)  # fmt: skip
    whole = evidence_of_rows(rows, np.concatenate([base, extra[..., used]], axis=2))
    half = whitener(whole, fit_variances(whole, both_starts=True).variances)
    n = rows.residual.size
    own_columns, further = ((half @ c).reshape(n, c.shape[2]) for c in (base, extra))
    seen = used & independent(own_columns, further * used, sizes, 1 / UNSEEN)
    A = np.concatenate([base, extra[..., seen]], axis=2)
    evidence = evidence_of_rows(rows, A)
    null = fit_variances(evidence, both_starts=True)
    return TargetEvidence(measurement, tuple(terms), T_mount, rows, landmarks, A.reshape(n, -1), evidence, null)
