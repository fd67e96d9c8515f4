"""One step of the fit to labelled points: Gauss–Newton over rows about a model, with REML of the poses' scatter."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array, Mask, exp
from stitch.model.model import Model
from stitch.model.term import sizes_of, split, stacked, values_of
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import Rows, mixed_model_of_rows
from stitch.observations.targets.target_fit import rms_of
from stitch.stages.fit import WEAK, fitted_parameters
from stitch.statistics.block_least_squares import Blocks
from stitch.statistics.parameter_selection import Whitened
from stitch.statistics.variance_components import fit_variances, whitener


@dataclass(frozen=True)
class Step:
    """Where a step ended, and from where it came."""

    model: Model
    moved: float  # of all unknowns, sigmas
    landmarks: Landmarks
    linearised: "Linearised"
    fitted: Mask  # (P,) parameters of the effects
    blocks: Blocks
    covariance: Array  # of all unknowns
    variances: Array  # (3,)

    @property
    def rms(self) -> float:
        """3D, before the step."""
        return rms_of_rows(self.linearised.rows)


@dataclass(frozen=True)
class Linearised:
    """Rows of targets about a model; P parameters of effects."""

    model: Model
    landmarks: Landmarks
    rows: Rows
    columns: Array  # (B, m, P)
    start: Array | None  # (3,) variances of the step before

    @cached_property
    def base(self) -> Array:
        """(B, m, a) columns of hand-eye and landmarks."""
        return np.concatenate([self.rows.hand_eye, self.rows.landmarks], axis=2)

    @cached_property
    def values(self) -> Array:
        """(P,) of the effects at which the rows were taken."""
        return values_of(self.model.terms)

    @cached_property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return sizes_of(self.model.terms)

    def choose(self, before: Mask | None) -> Mask:
        """(P,) the parameters that the views ask for, those of before first."""
        before = np.zeros(len(self.values), bool) if before is None else before
        return fitted_parameters(self.model.terms, before, self._whitened)

    def solve(self, choice: Mask) -> Step:
        """The step, with the variances of scatter and noise estimated anew."""
        X = np.concatenate([self.base, self.columns[..., choice]], axis=2)
        variances = self._variances(X)
        blocks = self._blocks(X, self.sizes[choice], self.values[choice], variances)
        x, covariance, a = blocks.solve(), blocks.estimates_covariance(), self.base.shape[2]
        held, values = np.array([p.held for p in stacked(self.model.terms)], bool), self.values.copy()
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[np.logical_not(held | choice)] = 0.0
        values[choice] += x[a:]
        model = Model(self.model.T_mount @ exp(x[:6]), split(self.model.terms, values))
        moved = float(np.max(np.abs(x) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))))
        landmarks = self.landmarks.moved(x[6:a])
        return Step(model, moved, landmarks, self, choice, blocks=blocks, covariance=covariance, variances=variances)

    def _variances(self, A: Array) -> Array:
        """(3,) by REML with the columns A (B, m, a) as free mean."""
        mixed = mixed_model_of_rows(self.rows, A)
        return fit_variances(mixed, start=self.start, both_starts=self.start is None).variances

    def _whitened(self, free: Mask) -> Whitened:
        mixed = mixed_model_of_rows(self.rows, self.base)
        half = whitener(mixed, self._variances(np.concatenate([self.base, self.columns[..., free]], axis=2)))
        z = (mixed.z + self.columns @ self.values)[..., None]
        n = self.rows.residual.size
        base, further, seen = ((half @ c).reshape(n, c.shape[2]) for c in (self.base, self.columns, z))
        return Whitened(base, further, seen[:, 0])

    def _blocks(self, X: Array, sizes: Array, values: Array, variances: Array) -> Blocks:
        """The step's normal equations; the prior of the effects is about zero, not about their present values."""
        mixed = mixed_model_of_rows(self.rows, X)
        distance = float(np.median(np.linalg.norm(np.concatenate(self.rows.capture.point_sets), axis=1)))
        unknown = X.shape[2] - len(sizes)
        # One radian and one working distance: keeps the unseen finite, moves nothing else.
        far = np.concatenate([[1.0] * 3, [distance] * (unknown - 3)])
        precision = np.concatenate([far, WEAK * sizes]) ** -2.0
        pull = np.concatenate([np.zeros(unknown), -values * precision[unknown:]])
        return Blocks(mixed.z, X, mixed.covariance(variances), precision, pull)


def rms_of_rows(rows: Rows) -> float:
    """3D distance of the targets from where they are, length_unit."""
    return rms_of(rows.distances(rows.residual))
