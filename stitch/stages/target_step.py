"""One step of the fit to labelled points: Gauss–Newton over rows about a model, with REML of the poses' scatter.

Sessions of one arm share its effects and its scatter; each has a hand-eye and targets of its own.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from stitch.frames import Array, Mask
from stitch.model.model import Model
from stitch.model.term import Term, sizes_of, stack_parameters, values_of, with_parameter_values
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import mixed_model_of_rows
from stitch.stages.fit import WEAK, fitted_parameters
from stitch.stages.sighted import LinearisedTargetSession, rms_of_rows
from stitch.statistics.block_least_squares import BlockLeastSquares
from stitch.statistics.parameter_selection import WhitenedData
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.stacked_blocks import block_columns, stack_blocks, stack_mixed_models
from stitch.statistics.variance_components import fit_variances, whitener

_MIN_VIEWS_FOR_REML = 3  # numbers for each that is free


@dataclass(frozen=True)
class TargetFitStep:
    """Where a step ended, and from where it came."""

    models: list[Model]  # of each session
    moved: float  # of all unknowns, sigmas
    landmarks: list[Landmarks]
    linearised: "LinearisedTargets"
    fitted: Mask  # (P,) parameters of the effects
    blocks: BlockLeastSquares
    covariance: Array  # of all unknowns: those of each session, then the effects
    variances: Array  # (3,)

    @property
    def model(self) -> Model:
        """Of the first session; the effects are those of all."""
        return self.models[0]

    @property
    def rms(self) -> float:
        """3D, before the step."""
        return rms_of_rows([own.rows for own in self.linearised.sessions])


@dataclass(frozen=True)
class LinearisedTargets:
    """Rows of targets of all sessions about their models."""

    sessions: list[LinearisedTargetSession]
    start: Array | None  # (3,) variances of the step before

    @property
    def terms(self) -> tuple[Term, ...]:
        """Effects in use."""
        return self.sessions[0].model.terms

    @cached_property
    def base(self) -> Array:
        """(B, m, a) columns of every session's hand-eye and landmarks."""
        return block_columns([own.base for own in self.sessions])

    @cached_property
    def columns(self) -> Array:
        """(B, m, P) of the effects."""
        return stack_blocks([own.columns for own in self.sessions])

    @cached_property
    def values(self) -> Array:
        """(P,) of the effects at which the rows were taken."""
        return values_of(self.terms)

    @cached_property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return sizes_of(self.terms)

    @property
    def own(self) -> list[slice]:
        """Each session's own unknowns among all."""
        ends = [int(n) for n in np.cumsum([0, *(own.unknowns for own in self.sessions)])]
        return [slice(begin, end) for begin, end in pairwise(ends)]

    @property
    def begins(self) -> list[int]:
        """Of each session's blocks among all."""
        return [int(n) for n in np.cumsum([0, *(len(own.columns) for own in self.sessions)])[:-1]]

    def choose(self, before: Mask | None) -> Mask:
        """(P,) the parameters that the views ask for, those of before first."""
        before = np.zeros(len(self.values), bool) if before is None else before
        return fitted_parameters(self.terms, before, self._whitened)

    def solve(self, choice: Mask) -> TargetFitStep:
        """The step, with the variances of scatter and noise estimated anew."""
        held = np.array([p.held for p in stack_parameters(self.terms)], bool)
        # What the views cannot see goes to zero, and the rest must make up for it; the time of an event stays.
        stays = held | choice
        mixed = self._mixed(np.concatenate([self.base, self.columns[..., choice]], axis=2))
        mixed = replace(mixed, z=mixed.z + self.columns[..., ~stays] @ self.values[~stays])
        variances = self._variances(mixed)
        blocks = self._blocks(mixed, self.sizes[choice], self.values[choice], variances)
        x, covariance, a = blocks.solve(), blocks.estimates_covariance(), self.base.shape[2]
        values = np.where(stays, self.values, 0.0)
        values[choice] += x[a:]
        moved = float(np.max(np.abs(x) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))))
        terms = with_parameter_values(self.terms, values)
        every = [session.moved(x[own], terms) for session, own in zip(self.sessions, self.own, strict=True)]
        return TargetFitStep(
            models=[model for model, _ in every],
            moved=moved,
            landmarks=[landmarks for _, landmarks in every],
            linearised=self,
            fitted=choice,
            blocks=blocks,
            covariance=covariance,
            variances=variances,
        )

    def _mixed(self, A: Array) -> MixedModel:
        """With the columns A (B, m, a) as free mean."""
        every = []
        for session, begin in zip(self.sessions, self.begins, strict=True):
            B, m = session.rows.residual.shape
            every.append(mixed_model_of_rows(session.rows, A[begin : begin + B, :m]))
        return stack_mixed_models(every, A)

    def _variances(self, mixed: MixedModel) -> Array:
        """(3,) by REML."""
        return fit_variances(mixed, start=self._starting_variances).variances

    @cached_property
    def _starting_variances(self) -> Array:
        """(3,) variances from which any search begins: of the step before, or where all effects take what they can."""
        if self.start is not None:
            return self.start
        every = np.concatenate([self.base, self.columns], axis=2)
        # Of few numbers all effects leave no scatter to be seen.
        enough = self._mixed(self.base).size > _MIN_VIEWS_FOR_REML * every.shape[2]
        return fit_variances(self._mixed(every if enough else self.base), both_starts=True).variances

    def _whitened(self, free: Mask) -> WhitenedData:
        mixed = self._mixed(self.base)
        beside = self._mixed(np.concatenate([self.base, self.columns[..., free]], axis=2))
        half = whitener(mixed, self._variances(beside))
        z = (mixed.z + self.columns @ self.values)[..., None]
        n = mixed.z.size
        base, further, seen = ((half @ c).reshape(n, c.shape[2]) for c in (self.base, self.columns, z))
        return WhitenedData(base, further, seen[:, 0])

    def _blocks(self, mixed: MixedModel, sizes: Array, values: Array, variances: Array) -> BlockLeastSquares:
        """The step's normal equations; the prior of the effects is about zero, not about their present values."""
        far = []
        for own in self.sessions:
            distance = float(np.median(np.linalg.norm(np.concatenate(own.rows.capture.point_sets), axis=1)))
            # One radian and one working distance: keeps the unseen finite, moves nothing else.
            far += [1.0] * 3 + [distance] * (own.unknowns - 3)
        precision = np.concatenate([far, WEAK * sizes]) ** -2.0
        pull = np.concatenate([np.zeros(len(far)), -values * precision[len(far) :]])
        return BlockLeastSquares(mixed.z, mixed.A, mixed.covariance(variances), precision, pull)
