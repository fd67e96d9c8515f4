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

# The first components of whatever was observed, by their names; what poses err beside follows them.
WHITE_COMPONENTS = ("white rotation", "white translation", "sensor noise")
# A component that is as good as absent, as a share of the variance that it usually has.
_NEGLIGIBLE_SHARE = 1e-2
# Share of a column below which what the model leaves of it is rounding, and no direction that views tell of.
_EXPLAINED = 1e-9
# Models beside further columns that are kept: those of one round of a selection, but of so many numbers in all at most:
# 2,773 poses of a probe take 40 MB each.
_REMEMBERED, _REMEMBERED_NUMBERS = 12, 200_000
# Sets of columns that are held against a model at once: enough for one large product, few for the memory.
_SETS_AT_ONCE = 16
# Numbers of the sums of views that are made at once: they stay in the cache.
_SUMS_AT_ONCE = 200_000
# Among more numbers a search takes a second: one from the likeliest start must do.
_SINGLE_START_SIZE = 250


class PointSums(Protocol):
    """Sums of what the parameters of an effect do to the points themselves."""

    def select(self, keep: slice | Mask) -> "PointSums":
        """The sums of some of the parameters."""


@dataclass(frozen=True)
class CoefficientPrior:
    """What is believed of k coefficients before anything is seen."""

    precision: Array  # (k,) 0 where nothing is believed
    mean: Array  # (k,)


@dataclass(frozen=True)
class Response:
    """Columns of P parameters in the coordinates of an observation: twists of the views, or rows of targets."""

    columns: Array  # (·, P) per unit of each parameter
    points: PointSums | None = None  # of an effect that changes the points, where the columns do not say it all


class LinearTrial(Protocol):
    """A model with some columns, in the linear approximation."""

    def solve(self, left_out: Indices | None = None) -> Array:
        """(… + k,) coefficients by least squares, without some views; what the observation frees beside comes first."""

    def solve_each(self, priors: Sequence[CoefficientPrior], left_out: Indices | None = None) -> list[Array]:
        """The same under each prior; one of fewer coefficients is of the first ones, and the others are zero."""

    def squares(self, coefficients: Array, units: Indices | Mask | None = None) -> Array:
        """(units,) sums of squares of what remains, in the terms of residual_rms; of all units or of some."""

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Sum of the squares of what left-out views deviate from the model by, in units of their scatter."""

    def influential_views(self, coefficients: Array) -> Indices:
        """(n,) views of which one alone could carry the coefficients (k,)."""


class Observation(ABC):
    """What was observed of one session under its model: of numbers that a response counts as they are.

    One whose responses count something else overrides `reduce` and `expand`; what its views share, `numbers_per_view`.
    """

    capture: Capture  # of the views, in the order of time, without the effects in use
    centre: Array  # (3,) about which twists of the views count, reference frame

    @property
    @abstractmethod
    def reach(self) -> float:
        """Length that makes a radian of orientation comparable with a distance."""

    @property
    def numbers_per_view(self) -> int | None:
        """Numbers that belong to one view, block after block; None where views share them."""
        return None

    @abstractmethod
    def from_twists(self, moved: Array) -> Array:
        """(n, P) reduced observations of left twists (6V, P) of the views."""

    @abstractmethod
    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Per term how the observation answers to its parameters."""

    def reduce(self, response: Array) -> Array:
        """(n, P) reduced observations of a response (·, P)."""
        return response

    def expand(self, columns: Array) -> Array:
        """(·, P) a response that has these reduced observations (n, P)."""
        return columns

    @abstractmethod
    def trial(self, linear: "LinearModel", response: Array, points: PointSums | None = None) -> LinearTrial:
        """A model with the columns of a response (·, k); `points` belong to its last ones."""

    @abstractmethod
    def affected_squares(self, views: Indices) -> Mask:
        """(units,) which squares of a trial some views have a part in."""

    @cached_property
    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        return grouped_folds(self.capture.T_base_flange, self.reach)

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Ends of joints' ranges that may be left out; none where a square of a trial is no view's own."""
        return []

    @abstractmethod
    def part_displacements(self, numbers: Array) -> Array:
        """(V, 3) what reduced observations (n,) displace at the part, reference frame, without a common motion."""


@dataclass(frozen=True)
class LinearModel:
    """One session under its model: what was seen beside hand-eye, landmarks and effects in use, reduced.

    How large the errors of what was seen are, the numbers tell.
    """

    measurement: Measurement
    model: Model
    observation: Observation
    design: Array  # (·, a) response to hand-eye, landmarks and effects in use
    _: KW_ONLY
    sizes: Array  # (a,) plausible ones of the effects' parameters; infinite for the rest
    values: Array  # (a,) at which the parameters of effects in use stand; 0 for the rest
    mixed: MixedModel  # what was seen, its mean's columns, and the components of the covariance
    null: VarianceFit  # fitted without further columns
    pose_errors: PoseErrors | None = None  # how poses may err beside white scatter, reduced (c, n, n)
    # (B, m, n) plausible offsets of the joints, each block a view, where the covariance counts no scatter of theirs.
    offsets: Array | None = None
    # (2,) variances, rad² and length_unit², by which a unit of joint scatter turns and moves the flange along an axis.
    flange_per_joint: Array = field(default_factory=lambda: np.zeros(2))
    full_model: "LinearModel | None" = None  # the one that this was taken from, where some pose errors are left out

    @cached_property
    def satterthwaite(self) -> Satterthwaite:
        """How well the null's scatter is known."""
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
        """Components beside the flange's scatter and noise; without a prior of pose errors joints may scatter still."""
        if self.pose_errors is not None:
            return self.pose_errors.names
        return (JOINT_SCATTER,) if self.mixed.further is not None else ()

    @property
    def causes(self) -> frozenset[str]:
        """Names of all that poses err by beside white scatter: effects of the library, and other components."""
        return frozenset(self.component_names) if self.pose_errors is None else self.pose_errors.causes

    def in_blocks(self, columns: Array) -> Array:
        """(B, m, P) columns (n, P) as the variance components take them."""
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
            blocks: the blocks (rows of the B) whose columns are returned; None: all.
        """
        X, half = self.in_blocks(columns), self.whitening
        if blocks is not None:
            X, half = X[blocks], half[blocks]
        return (half @ X).reshape(-1, columns.shape[1])

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
        """What `restricted` has fitted already."""
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
        """Per term how the observation answers to its parameters."""
        return self.observation.responses(self.measurement, self.model, terms)

    def reduce(self, response: Array) -> Array:
        """(n, P) reduced observations of a response (·, P)."""
        return self.observation.reduce(response)

    @cached_property
    def white_design(self) -> Array:
        """(n, a) `design` in units of the null's scatter."""
        return self.whiten(self.reduce(self.design))

    @cached_property
    def white_z(self) -> Array:
        """(n,) what was seen in those units, with all that the model explains."""
        return self.whiten(self.mixed.z.reshape(-1, 1))[:, 0]

    @cached_property
    def white_residual(self) -> Array:
        """(n,) what was seen in those units, without what the model explains."""
        return self.residual(self.mixed.z.reshape(-1, 1))[:, 0]

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal basis of `white_design`."""
        return column_space(self.white_design)

    def explained_without(self, views: Indices) -> Array:
        """(n, r) orthonormal basis of the whitened columns of the model and of free motions of `views` (indices).

        Projecting it out of the observations leaves these views out of a fit.
        """
        twists = np.eye(6 * self.measurement.views.count)[:, (6 * views[:, None] + np.arange(6)).ravel()]
        return column_space(np.hstack([self.white_design, self.whiten(self.observation.from_twists(twists))]))

    def residual(self, columns: Array) -> Array:
        """(n, P) whitened columns, what the model explains projected out; zero where only rounding is left."""
        white = self.whiten(columns)
        left = white - self._explained @ (self._explained.T @ white)
        left[:, np.sum(left**2, axis=0) <= _EXPLAINED**2 * np.sum(white**2, axis=0)] = 0.0
        return left

    def information(self, columns: Sequence[SelectedColumns]) -> Iterator[tuple[Array, Array]]:
        """Yield I (P, P) and v (P,) per set of columns (n, P): the log likelihood of coefficients θ is vᵀθ − ½ θᵀIθ.

        The model's own coefficients are free: they are projected out. The variances are those of the null.

        Two ways give the same. Where all views have one covariance but for a rotation (`mixed.common`), sums over the
        views are cached and each set is made of these. Else the columns are whitened, several sets in one product.
        """
        common = self.mixed.common if self.mixed.common is not None and self.mixed.sums.are_kept else None
        for sets in (columns[start : start + _SETS_AT_ONCE] for start in range(0, len(columns), _SETS_AT_ONCE)):
            if common is not None:
                common.keep([selected.whole for selected in sets])
                yield from map(self._own_information.of, sets)
                continue
            portion = [selected.columns for selected in sets]
            white = self.whiten(np.hstack(portion))
            explained = self._explained.T @ white
            vector = white.T @ self.white_residual
            ends = np.cumsum([0, *(X.shape[1] for X in portion)])
            for at in map(slice, ends[:-1], ends[1:]):
                yield white[:, at].T @ white[:, at] - explained[:, at].T @ explained[:, at], vector[at]

    def information_of_motions(self, twists: Array, shapes: Array) -> tuple[Array, Array]:
        """Return I (S, kR, kR) and v (S, kR): in each of S sets the log likelihood of kR coefficients is vᵀθ − ½ θᵀIθ.

        Coefficient (i, r) moves view v by twists[v, :, i] · shapes[s, v, r]. So I and v are sums over the views of
        6×6 matrices times products of two shapes; no column of all n observations is formed.

        Args:
            twists: (V, 6, k) of the views about the observation's centre (rad, length_unit), per unit of each motion.
            shapes: (S, V, R) factors of the views.
        """
        of_views, across, sign, vector = self._sums_of_twists
        (sets, views, count), k = shapes.shape, twists.shape[2]
        of_views = (twists.transpose(0, 2, 1) @ of_views @ twists).reshape(views, 1, k * k)
        information = np.empty((sets, count, k, count, k))
        portion = max(_SUMS_AT_ONCE // (views * count * k * k), 1)
        for at in (slice(start, start + portion) for start in range(0, sets, portion)):
            some = shapes[at]
            weighted = (some[..., None] * of_views).reshape(len(some), views, -1)
            sums = (some.transpose(0, 2, 1) @ weighted).reshape(-1, count, count, k, k)
            information[at] = sums.transpose(0, 1, 3, 2, 4)
        by_shape = shapes.transpose(0, 2, 1).reshape(-1, views)
        by_motion = (by_shape @ (across @ twists).reshape(views, -1)).reshape(sets, count, -1, k)
        shared = by_motion.transpose(0, 2, 3, 1).reshape(sets, -1, k * count)
        seen = (by_shape @ np.einsum("vi,vik->vk", vector, twists)).reshape(sets, count, k)
        whole = information.transpose(0, 2, 1, 4, 3).reshape(sets, k * count, k * count)
        return whole + sign * shared.transpose(0, 2, 1) @ shared, seen.transpose(0, 2, 1).reshape(sets, -1)

    @cached_property
    def _sums_of_twists(self) -> tuple[Array, Array, float, Array]:
        """D (V, 6, 6), F (V, r, 6), sign s, q (V, 6): sums over unit twists of the views for `information_of_motions`.

        With the 6 whitened unit twists of view v as columns U_v, the model's columns projected out, the information of
        two views is U_vᵀU_w = δ_vw D_v + s F_vᵀF_w. q_v is U_vᵀ times the whitened residual.
        """
        views, rows = self.measurement.views.count, self.observation.numbers_per_view
        # Views share numbers: U_v has all n rows and is F_v itself. Else D_v is the block of the view, and what the
        # model explains (an orthonormal basis of r columns) is subtracted by F.
        if rows is None:
            unit = self.residual(self.observation.from_twists(np.eye(6 * views)))
            across = unit.reshape(-1, views, 6).transpose(1, 0, 2)
            return np.zeros((views, 6, 6)), across, 1.0, (unit.T @ self.white_residual).reshape(views, 6)
        unit = self.whiten(self.observation.from_twists(np.tile(np.eye(6), (views, 1)))).reshape(-1, rows, 6)[:views]
        turned = unit.transpose(0, 2, 1)
        across = (turned @ self._explained.reshape(-1, rows, self._explained.shape[1])[:views]).transpose(0, 2, 1)
        vector = (turned @ self.white_residual.reshape(-1, rows, 1)[:views])[..., 0]
        return turned @ unit, across, -1.0, vector

    @cached_property
    def _own_information(self) -> ModelInformation:
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
            if len(self._conditioned) >= min(_REMEMBERED, _REMEMBERED_NUMBERS // max(self.mixed.size, 1)):
                self._conditioned.clear()
            self._conditioned[key] = conditioned
        return conditioned

    @cached_property
    def _conditioned(self) -> dict[tuple[Any, ...], "LinearModel"]:
        """What `conditioned_on` has found last: effects are asked beside the same others several times."""
        return {}

    def trial(self, response: Array, points: PointSums | None = None) -> LinearTrial:
        """A model with the columns of a response (·, k)."""
        return self.observation.trial(self, response, points)

    @cached_property
    def baseline_trial(self) -> LinearTrial:
        """The model as it is."""
        return self.trial(self.design)

    def view_displacements(self) -> Array:
        """(V, 3) how far every view sits from where the model puts it, at the part, reference frame."""
        explained = self.design @ self.baseline_trial.solve()[-self.design.shape[1] :]
        return self.observation.part_displacements(self.mixed.z.ravel() - self.reduce(explained[:, None])[:, 0])

    def __repr__(self) -> str:
        return f"LinearModel({self.mixed.size} numbers of {self.measurement.views.count} views, {self.model!r})"


def with_pose_errors(mixed: MixedModel, errors: PoseErrors) -> MixedModel:
    """Return the mixed model of one block with scatter, noise, and what the poses err beside."""
    components = np.concatenate([mixed.components[: NOISE + 1], errors.components[:, None]])
    return replace(mixed, components=components, further=errors.prior, common=None)
