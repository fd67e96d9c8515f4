"""The one linear form that all of diagnosis reads, whatever was observed.

    z = A·α + noise,   cov(noise) = Σ_i λ_i C_i

z are the numbers that were seen (reduced observations), A what hand-eye, landmarks and effects in use do to them. An
observation says how its own coordinates (responses: twists of the views, or rows of targets) are reduced to them, how a
model with further columns is tried, and which views may be left out. A further kind is a subclass of `Rows`
(`rows.py`) where every view has numbers of its own; nothing of diagnosis changes.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from stitch.model.model import Model, Term
from stitch.numerics.common_covariance import SelectedColumns
from stitch.numerics.folds import JointEnd, grouped_folds
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import column_space
from stitch.numerics.reml import (
    ALWAYS_PRESENT,
    NOISE,
    FurtherColumns,
    FurtherPrior,
    MixedModel,
    ModelInformation,
    VarianceFit,
    at_variances,
    fit_variances,
    model_information,
    whitener,
)
from stitch.numerics.variance_posterior import Satterthwaite, satterthwaite
from stitch.observations.pose_errors import JOINT_SCATTER, USUAL_JOINT_SCATTER, PoseErrors
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement

# Names of the first components of every covariance; those of pose errors (`PoseErrors.names`) follow.
WHITE_COMPONENTS = ("white rotation", "white translation", "sensor noise")
# A component that is as good as absent, as a share of the variance that it usually has.
_NEGLIGIBLE_SHARE = 1e-2
# A column of which the model leaves a smaller share is explained: the rest is rounding.
_EXPLAINED = 1e-9
# Models conditioned on further columns that are cached: those of one round of a selection, fewer where they are large,
# as of 2,773 poses of a probe, which take 40 MB each.
_CACHED_MODELS, _CACHED_NUMBERS = 12, 200_000
# Sets of columns that are whitened in one product: enough to be fast, few for the memory.
_SETS_AT_ONCE = 16
# Size of an array of sums that is computed in one piece: it stays in the processor's cache.
_SUMS_AT_ONCE = 200_000
# Among more numbers a search takes a second: one from the likeliest start must do.
_SINGLE_START_SIZE = 250


class PointSums(Protocol):
    """Sums over correspondences for parameters of effects that move points within a view (`PointGram`)."""

    def select(self, keep: slice | Mask | Indices) -> "PointSums":
        """Return the sums of some of the parameters."""


@dataclass(frozen=True)
class CoefficientPrior:
    """A normal prior of k independent coefficients."""

    precision: Array  # (k,) 1/variance; 0 where nothing is believed
    mean: Array  # (k,)


@dataclass(frozen=True)
class Response:
    """How an observation changes per unit of each of P parameters, in its own coordinates."""

    columns: Array  # (·, P) left twists of the views (6V rows), or rows of targets
    points: PointSums | None = None  # of an effect that moves points within a view, which no twist describes


class LinearTrial(Protocol):
    """A linear model with k columns, fitted to an observation and tested on views that were left out.

    Coefficients are (u + k,): first u unknowns that the observation has of its own, then those of the columns.
    """

    def solve(self, left_out: Indices | None = None) -> Array:
        """Return the coefficients (u + k,) by least squares, fitted without some views (indices)."""

    def solve_each(self, priors: Sequence[CoefficientPrior], left_out: Indices | None = None) -> list[Array]:
        """Return the coefficients (u + k,) under each prior; columns beyond those that a prior has stay at zero."""

    def squares(self, coefficients: Array, units: Indices | Mask | None = None) -> Array:
        """Return sums of squared residuals, length_unit², of all units or some: of pairs of views, or of views."""

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Return the χ² of the residuals of left-out views: their squares in units of the null's scatter."""

    def influential_views(self, coefficients: Array) -> Indices:
        """Return the views (n,) of which a single one could decide the coefficients."""


class Observation(ABC):
    """What was observed of one session under its model, reduced to n numbers.

    Changes that effects cause (responses) are in coordinates of the observation. Where these are not the reduced
    numbers themselves, a subclass overrides `reduce` and `expand`; where each number belongs to one view,
    `numbers_per_view`.
    """

    capture: Capture  # of the views, in the order of time, with the effects in use taken out
    centre: Array  # (3,) point of the reference frame about which twists of the views turn

    @property
    @abstractmethod
    def reach(self) -> float:
        """Length, length_unit, that makes a radian of orientation comparable with a distance."""

    @property
    def numbers_per_view(self) -> int | None:
        """How many reduced numbers each view has, which stand view after view; None where views share numbers."""
        return None

    @abstractmethod
    def from_twists(self, moved: Array) -> Array:
        """Return the change (n, P) of the reduced numbers by left twists (6V, P) of the views."""

    @abstractmethod
    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Return per term how the observation changes with its parameters, at `model`."""

    def reduce(self, response: Array) -> Array:
        """Return the change (n, P) of the reduced numbers for a change (·, P) in the observation's coordinates."""
        return response

    def expand(self, columns: Array) -> Array:
        """Return a change (·, P) in the observation's coordinates that `reduce` maps to `columns` (n, P)."""
        return columns

    @abstractmethod
    def trial(self, linear: "LinearModel", response: Array, points: PointSums | None = None) -> LinearTrial:
        """Return the trial of a model with columns `response` (·, k); `points` are sums of the last of them."""

    @abstractmethod
    def affected_squares(self, views: Indices) -> Mask:
        """Return a mask (units,) of the sums of `LinearTrial.squares` that any of the views has a part in."""

    @cached_property
    def folds(self) -> list[Indices]:
        """Groups of views that are left out in turn: neighbours in time or pose."""
        return grouped_folds(self.capture.T_base_flange, self.reach)

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Return ends of joints' ranges to leave out, from joints (V, n) rad; none where views share squares."""
        return []

    @abstractmethod
    def part_displacements(self, numbers: Array) -> Array:
        """Return displacements (V, 3) at the part that make reduced numbers (n,), less their mean; reference frame."""


@dataclass(frozen=True)
class LinearModel:
    """One session under its model: z = A·α + noise, of n reduced numbers z, with the noise's variances fitted to z.

    The a coefficients α are those of hand-eye, landmarks and effects in use.
    """

    measurement: Measurement
    model: Model
    observation: Observation
    design: Array  # (·, a) columns of A in the observation's coordinates
    _: KW_ONLY
    sizes: Array  # (a,) plausible sizes of the effects' parameters; infinite for the rest
    values: Array  # (a,) present values of the effects' parameters; 0 for the rest
    mixed: MixedModel  # z, A and the components of the covariance
    null: VarianceFit  # variances of the components, fitted without further columns
    pose_errors: PoseErrors | None = None  # pose errors beside white scatter; its components are (c, n, n) of z
    # (B, m, joints) changes of z by plausible offsets of the joints, where the covariance has no scatter of the joints.
    offsets: Array | None = None
    # (2,) variances, rad² and length_unit², by which a unit of joint scatter turns and moves the flange along an axis.
    flange_per_joint: Array = field(default_factory=lambda: np.zeros(2))
    full_model: "LinearModel | None" = None  # from which this was restricted, if some causes are left out

    @cached_property
    def satterthwaite(self) -> Satterthwaite:
        """How well the variances of `null` are known, as degrees of freedom."""
        return satterthwaite(self.mixed, self.null)

    def flange_scatter(self, fit: VarianceFit) -> Array:
        """Return the variances (2,) of the flange's scatter from view to view, along each axis: rad² and length_unit².

        Args:
            fit: variances [rotation, translation, noise factor, one per component of `component_names`]. The scatter
                of the joints, if it is a component, moves the flange too and is added.
        """
        white = fit.variances[:NOISE]
        if JOINT_SCATTER not in self.component_names:
            return white
        return white + fit.variances[NOISE + 1 + self.component_names.index(JOINT_SCATTER)] * self.flange_per_joint

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components after `WHITE_COMPONENTS`: pose errors, or joint scatter alone, or none."""
        if self.pose_errors is not None:
            return self.pose_errors.names
        return (JOINT_SCATTER,) if self.mixed.further is not None else ()

    @property
    def causes(self) -> frozenset[str]:
        """Names of the causes of pose errors: effects of the library, and components that are not made of effects."""
        return frozenset(self.component_names) if self.pose_errors is None else self.pose_errors.causes

    def in_blocks(self, columns: Array) -> Array:
        """Return columns (n, P) as (B, m, P), in the B independent blocks of m numbers that `mixed` has."""
        return columns.reshape(*self.mixed.z.shape, columns.shape[1])

    @cached_property
    def covariance(self) -> Array:
        """(B, m, m) of the reduced observations under the null."""
        return self.mixed.covariance(self.null.variances)

    @cached_property
    def whitening(self) -> Array:
        """(B, m, m) inverse Cholesky factors of the null's covariance."""
        return whitener(self.mixed, self.null.variances)

    def whiten(self, columns: Array, blocks: Indices | None = None) -> Array:
        """Return columns (n, P) times the inverse Cholesky factor of the covariance: their errors are white, unit size.

        The covariance is that of `null`, the variances fitted without further columns.

        Args:
            blocks: numbers of the blocks whose rows are returned, in this order, among the B of `in_blocks`; None: all.
        """
        X, inverse_root = self.in_blocks(columns), self.whitening
        if blocks is not None:
            X, inverse_root = X[blocks], inverse_root[blocks]
        return (inverse_root @ X).reshape(-1, columns.shape[1])

    def restricted(self, keep: Collection[str]) -> Self:
        """Return the model in which poses err by these causes alone, its variances fitted anew.

        White scatter and the sensor's noise always stay, so that () leaves these. Each set is fitted once and cached.

        Args:
            keep: names of effects or of components; those that are not among `causes` are ignored.
        """
        # A model without a prior of pose errors can still be given the scatter of its joints, if it knows the joints.
        possible = self.causes if self.offsets is None else self.causes | {JOINT_SCATTER}
        kept = possible.intersection(keep)
        if kept == self.causes:
            return self
        if kept not in self._restricted:
            self._restricted[kept] = self._fit_restricted(kept)
        return self._restricted[kept]

    def without(self, causes: Collection[str]) -> Self:
        """Return the model in which poses do not err by these causes."""
        return self.restricted(self.causes.difference(causes))

    @cached_property
    def _restricted(self) -> dict[frozenset[str], Self]:
        """Cache of `restricted`, by the causes kept."""
        return {}

    def _fit_restricted(self, kept: frozenset[str]) -> Self:
        """Return the model with the pose errors `kept` alone, its variances fitted anew.

        Three cases. Nothing is kept: rotation scatter, translation scatter and the sensor's noise remain. The model has
        a prior of pose errors: its components are restricted to the causes kept. It has none, as that of labelled
        points or of many views: the scatter of the joints (`JOINT_SCATTER`) is the one component that can be added.
        """
        if not kept:
            mixed = replace(self.mixed, components=self.mixed.components[: NOISE + 1], further=None)
            null = fit_variances(mixed, both_starts=True)
            return replace(self, mixed=mixed, null=null, pose_errors=None, full_model=None)
        if self.pose_errors is not None:
            errors = self.pose_errors.restricted(kept)
            mixed = with_pose_errors(self.mixed, errors)
            return replace(self, mixed=mixed, pose_errors=errors, full_model=self).refit()
        assert self.offsets is not None
        components = np.concatenate([self.mixed.components, (self.offsets @ self.offsets.transpose(0, 2, 1))[None]])
        further = FurtherPrior(np.array([USUAL_JOINT_SCATTER]), np.array([ALWAYS_PRESENT]), np.zeros(1, bool))
        mixed = replace(self.mixed, components=components, further=further, common=None)
        return replace(self, mixed=mixed, offsets=None, null=fit_variances(mixed, both_starts=True))

    def refit(self) -> Self:
        """Return the model with its variances fitted anew: the likeliest of the fits from several starts.

        The likelihood has several maxima, since some components of the covariance can stand in for others. Among more
        than `_SINGLE_START_SIZE` observations a fit takes long, and only the likeliest start is used.
        """
        starts = [other.null for other in self.alternative_starts]
        starts += [at_variances(self.mixed, self.null.variances)] if self.full_model is None else []
        if self.mixed.size > _SINGLE_START_SIZE:
            starts = [min(starts, key=lambda fit: fit.deviance)]
        fits = [fit_variances(self.mixed, start=fit.variances) for fit in starts]
        return replace(self, null=min(fits, key=lambda fit: fit.deviance))

    @cached_property
    def alternative_starts(self) -> tuple[Self, ...]:
        """This model at two or three other variances, from which a fit of them may reach another local maximum.

        The variances are those of rotation scatter, translation scatter and noise, then one per pose error. The starts:

        1. the three of the fit without pose errors, each pose error nearly 0;
        2. the three of this model, each pose error nearly 0;
        3. all those of `full_model`, the model that this one was restricted from, if there is one.

        () without pose errors: the other maxima are those at which scatter stands in for pose errors.
        """
        if self.pose_errors is None:
            return ()
        outermost: LinearModel = self
        while outermost.full_model is not None:
            outermost = outermost.full_model
        nearly_none = _NEGLIGIBLE_SHARE * self.pose_errors.scales**2
        white_fits = (outermost.restricted(()).null, self.null)
        starts = [np.append(fit.variances[: NOISE + 1], nearly_none) for fit in white_fits]
        if self.full_model is not None and self.full_model.pose_errors is not None:
            fitted = self.full_model.null.variances
            by_name = dict(zip(self.full_model.pose_errors.names, fitted[NOISE + 1 :], strict=True))
            starts.append(np.append(fitted[: NOISE + 1], [by_name[name] for name in self.pose_errors.names]))
        return tuple(replace(self, null=at_variances(self.mixed, variances)) for variances in starts)

    def responses(self, terms: Sequence[Term]) -> list[Response]:
        """Return per term how the observation changes with its parameters."""
        return self.observation.responses(self.measurement, self.model, terms)

    def reduce(self, response: Array) -> Array:
        """Return the change (n, P) of the reduced numbers for a change (·, P) in the observation's coordinates."""
        return self.observation.reduce(response)

    @cached_property
    def white_design(self) -> Array:
        """(n, a) columns A, whitened."""
        return self.whiten(self.reduce(self.design))

    @cached_property
    def white_z(self) -> Array:
        """(n,) reduced numbers z, whitened."""
        return self.whiten(self.mixed.z.reshape(-1, 1))[:, 0]

    @cached_property
    def white_residual(self) -> Array:
        """(n,) whitened z, less its projection onto the whitened columns A."""
        return self.residual(self.mixed.z.reshape(-1, 1))[:, 0]

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal basis of the space of `white_design`."""
        return column_space(self.white_design)

    def explained_without(self, views: Indices) -> Array:
        """Return an orthonormal basis (n, r) of the whitened columns of the model and of free motions of some views.

        Projecting it out of the observations leaves these views out of a fit.
        """
        twists = np.eye(6 * self.measurement.views.count)[:, (6 * views[:, None] + np.arange(6)).ravel()]
        return column_space(np.hstack([self.white_design, self.whiten(self.observation.from_twists(twists))]))

    def residual(self, columns: Array) -> Array:
        """Return the whitened columns (n, P) less their projection onto the model's columns.

        A column that the model explains is exactly zero: what is left of it would be rounding.
        """
        white = self.whiten(columns)
        residual = white - self._explained @ (self._explained.T @ white)
        residual[:, np.sum(residual**2, axis=0) <= _EXPLAINED**2 * np.sum(white**2, axis=0)] = 0.0
        return residual

    def information(self, columns: Sequence[SelectedColumns]) -> Iterator[tuple[Array, Array]]:
        """Yield I (P, P) and v (P,) per set of columns (n, P): the log likelihood of coefficients θ is vᵀθ − ½ θᵀIθ.

        The model's own coefficients are free: they are projected out. The variances are those of the null.

        Two ways give the same. Where all views have one covariance but for a rotation (`mixed.common`), sums over the
        views are cached and each set is made of these. Else the columns are whitened, several sets in one product.
        """
        common = self.mixed.common if self.mixed.common is not None and self.mixed.sums.are_cached else None
        for sets in (columns[start : start + _SETS_AT_ONCE] for start in range(0, len(columns), _SETS_AT_ONCE)):
            if common is not None:
                common.cache([selected.whole for selected in sets])
                yield from map(self._own_information.of, sets)
                continue
            white = self.whiten(np.hstack([selected.columns for selected in sets]))
            explained = self._explained.T @ white
            vector = white.T @ self.white_residual
            ends = np.cumsum([0, *(selected.count for selected in sets)])
            for of_set in map(slice, ends[:-1], ends[1:]):
                X, projected = white[:, of_set], explained[:, of_set]
                yield X.T @ X - projected.T @ projected, vector[of_set]

    def information_of_motions(self, twists: Array, shapes: Array) -> tuple[Array, Array]:
        """Return I (S, kR, kR) and v (S, kR): in each of S sets the log likelihood of kR coefficients is vᵀθ − ½ θᵀIθ.

        Coefficient (i, r) moves view v by twists[v, :, i] · shapes[s, v, r]. So I and v are sums over the views of
        6×6 matrices times products of two shapes; no column of all n observations is formed.

        Args:
            twists: (V, 6, k) of the views about the observation's centre (rad, length_unit), per unit of each motion.
            shapes: (S, V, R) factors of the views.
        """
        own, shared, sign, pulls = self._sums_of_twists
        (sets, views, count), k = shapes.shape, twists.shape[2]
        information = _sum_over_views(twists.transpose(0, 2, 1) @ own @ twists, shapes)
        by_shape = shapes.transpose(0, 2, 1).reshape(-1, views)
        by_motion = (by_shape @ (shared @ twists).reshape(views, -1)).reshape(sets, count, -1, k)
        moved = by_motion.transpose(0, 2, 3, 1).reshape(sets, -1, k * count)
        pulled = (by_shape @ np.einsum("vi,vik->vk", pulls, twists)).reshape(sets, count, k)
        return information + sign * moved.transpose(0, 2, 1) @ moved, pulled.transpose(0, 2, 1).reshape(sets, -1)

    @cached_property
    def _sums_of_twists(self) -> tuple[Array, Array, float, Array]:
        """Return D (V, 6, 6), F (V, r, 6), a sign s and q (V, 6): sums over all numbers of unit twists of the views.

        Let U_v (n, 6) be the whitened unit twists of view v, what the model's columns explain taken off. Then
        U_vᵀU_w = δ_vw D_v + s F_vᵀF_w for any two views, and q_v is U_vᵀ times the whitened residual. Two cases:

        - Views share numbers, as of surfaces: F_v is U_v itself, r = n, s = 1, and D is zero.
        - Each view has numbers of its own: with T_v (numbers, 6) its whitened unit twists and E_v its rows of the
          orthonormal basis E (n, r) of what the model explains, D_v = T_vᵀT_v, F_v = E_vᵀT_v and s = −1.
        """
        views, numbers = self.measurement.views.count, self.observation.numbers_per_view
        if numbers is None:
            unit = self.residual(self.observation.from_twists(np.eye(6 * views)))
            shared = unit.reshape(-1, views, 6).transpose(1, 0, 2)
            return np.zeros((views, 6, 6)), shared, 1.0, (unit.T @ self.white_residual).reshape(views, 6)
        unit = self.whiten(self.observation.from_twists(np.tile(np.eye(6), (views, 1))))

        def of_views(rows: Array) -> Array:
            """Return the rows (n, k) of the views' own numbers as (V, numbers, k)."""
            return rows.reshape(-1, numbers, rows.shape[-1])[:views]

        transposed = of_views(unit).transpose(0, 2, 1)
        shared = (transposed @ of_views(self._explained)).transpose(0, 2, 1)
        pulls = (transposed @ of_views(self.white_residual[:, None]))[..., 0]
        return transposed @ of_views(unit), shared, -1.0, pulls

    @cached_property
    def _own_information(self) -> ModelInformation:
        """What `information` needs of this model at the variances of `null`; of models with `mixed.common` alone."""
        return model_information(self.mixed, self.null)

    def conditioned_on(
        self, columns: Array | Sequence[SelectedColumns], sizes: Array, start: Array | None = None
    ) -> "LinearModel":
        """Return the model with p further columns in its free mean, its variances fitted anew; the last are cached.

        Args:
            columns: (n, p) reduced observations per unit of each parameter, as one array or as sets side by side.
            sizes: (p,) plausible sizes of the parameters.
            start: (c,) variances at which the fit begins; None: those of the null. With a prior of pose errors the fit
                has starts of its own (`refit`), and this one is not used.
        """
        sets = [SelectedColumns(columns)] if isinstance(columns, np.ndarray) else columns
        if self.mixed.common is None:
            # Only the sums of `common` are cached by set: without them the sets are one array of columns.
            sets = [SelectedColumns(np.hstack([selected.columns for selected in sets]))]
        key = (*(selected.key for selected in sets), sizes.tobytes())
        conditioned = self._conditioned.get(key)
        if conditioned is None:
            further = FurtherColumns(self.mixed, sets)
            mixed = further.in_mean()
            response = self.observation.expand(further.G.reshape(self.mixed.z.size, -1))
            conditioned = replace(
                self,
                design=np.hstack([self.design, response]),
                sizes=np.append(self.sizes, sizes),
                values=np.append(self.values, np.zeros(len(sizes))),
                mixed=mixed,
                full_model=None,
            )
            if self.pose_errors is None:
                null = fit_variances(mixed, start=self.null.variances if start is None else start)
                conditioned = replace(conditioned, null=null)
            else:
                conditioned = conditioned.refit()
            if len(self._conditioned) >= min(_CACHED_MODELS, _CACHED_NUMBERS // max(self.mixed.size, 1)):
                self._conditioned.clear()
            self._conditioned[key] = conditioned
        return conditioned

    @cached_property
    def _conditioned(self) -> dict[tuple[Any, ...], "LinearModel"]:
        """Cache of `conditioned_on`, by columns and sizes: several effects are tested beside the same others."""
        return {}

    def trial(self, response: Array, points: PointSums | None = None) -> LinearTrial:
        """Return the trial of a model with columns `response` (·, k); `points` are sums of the last of them."""
        return self.observation.trial(self, response, points)

    @cached_property
    def baseline_trial(self) -> LinearTrial:
        """The trial of the model as it is, without further columns."""
        return self.trial(self.design)

    def view_displacements(self) -> Array:
        """Return how far (V, 3), length_unit, the part's points of every view lie from the model, reference frame."""
        explained = self.design @ self.baseline_trial.solve()[-self.design.shape[1] :]
        return self.observation.part_displacements(self.mixed.z.ravel() - self.reduce(explained[:, None])[:, 0])

    def __repr__(self) -> str:
        return f"LinearModel({self.mixed.size} numbers of {self.measurement.views.count} views, {self.model!r})"


def _sum_over_views(matrices: Array, shapes: Array) -> Array:
    """Return Σ_v shapes[s, v, r] shapes[s, v, q] M_v for all r and q: (S, kR, kR), entry (i, r), (j, q) from M_v[i, j].

    Args:
        matrices: M (V, k, k).
        shapes: (S, V, R) factors of the views; `_SUMS_AT_ONCE` says of how many sets at a time.
    """
    (sets, views, count), k = shapes.shape, matrices.shape[1]
    out = np.empty((sets, k, count, k, count))
    portion = max(_SUMS_AT_ONCE // (views * count * k * k), 1)
    for at in (slice(start, start + portion) for start in range(0, sets, portion)):
        some = shapes[at]
        weighted = (some[..., None] * matrices.reshape(views, 1, k * k)).reshape(len(some), views, -1)
        sums = (some.transpose(0, 2, 1) @ weighted).reshape(-1, count, count, k, k)
        out[at] = sums.transpose(0, 3, 1, 4, 2)
    return out.reshape(sets, k * count, k * count)


def with_pose_errors(mixed: MixedModel, errors: PoseErrors) -> MixedModel:
    """Return a mixed model of one block with its components of scatter and noise, and those of pose errors."""
    components = np.concatenate([mixed.components[: NOISE + 1], errors.components[:, None]])
    return replace(mixed, components=components, further=errors.prior, common=None)
