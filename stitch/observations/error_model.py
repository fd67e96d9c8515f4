"""Numbers that were seen, and how they may err: components of a covariance, their sizes, models with fewer."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from stitch.frames import Array, Indices
from stitch.observations.arm_errors import JOINT_SCATTER, USUAL_JOINT_SCATTER
from stitch.observations.pose_errors import PoseErrors
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.satterthwaite import Satterthwaite, satterthwaite
from stitch.statistics.variance_components import VarianceFit, at_variances, fit_variances, whitener
from stitch.statistics.variance_prior import ALWAYS_PRESENT, NOISE, FurtherPrior

# The first components of whatever was observed, by their names; what poses err beside follows them.
WHITE_COMPONENTS = ("white rotation", "white translation", "sensor noise")
# A component that is as good as absent, as a share of the variance that it usually has.
_NEGLIGIBLE_SHARE = 1e-2
# Among more numbers a search takes a second: one from the likeliest start must do.
_SINGLE_START_SIZE = 250


def with_pose_errors(mixed: MixedModel, errors: PoseErrors) -> MixedModel:
    """The mixed model of one block with scatter, noise, and what the poses err beside."""
    components = np.concatenate([mixed.components[: NOISE + 1], errors.components[:, None]])
    return replace(mixed, components=components, further=errors.prior)


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """What was seen of one session in the channel, under errors whose sizes the numbers tell."""

    mixed: MixedModel  # what was seen, its mean's columns, and the components of the covariance
    null: VarianceFit  # fitted without further columns
    pose_errors: PoseErrors | None = None  # how poses may err beside white scatter, in the channel (c, n, n)
    # (B, m, n) plausible offsets of the joints, each block a view, where the covariance counts no scatter of theirs.
    offsets: Array | None = None
    # (2,) variances, rad² and length_unit², by which a unit of joint scatter turns and moves the flange along an axis.
    flange_per_joint: Array = field(default_factory=lambda: np.zeros(2))
    full_model: "ErrorModel | None" = None  # the one that this was taken from, where some pose errors are left out

    @cached_property
    def satterthwaite(self) -> Satterthwaite:
        """How well the null's scatter is known."""
        return satterthwaite(self.mixed, self.null)

    def flange_scatter(self, fit: VarianceFit) -> Array:
        """(2,) variances along an axis by which the flange turns and moves anew in every view, by its joints too."""
        own = fit.variances[:NOISE]
        if JOINT_SCATTER not in self.component_names:
            return own
        return np.asarray(
            own + fit.variances[NOISE + 1 + self.component_names.index(JOINT_SCATTER)] * self.flange_per_joint
        )

    @property
    def component_names(self) -> tuple[str, ...]:
        """Components beside the flange's scatter and noise; without a prior of pose errors joints may scatter still."""
        if self.pose_errors is not None:
            return self.pose_errors.names
        return (JOINT_SCATTER,) if self.mixed.further is not None else ()

    def in_blocks(self, columns: Array) -> Array:
        """(B, m, P) columns (n, P) as the variance components take them."""
        return columns.reshape(*self.mixed.z.shape, columns.shape[1])

    @cached_property
    def covariance(self) -> Array:
        """(B, m, m) of the channel under the null."""
        return self.mixed.covariance(self.null.variances)

    @cached_property
    def _whitening(self) -> Array:
        """(B, m, m) inverse Cholesky factors of the null's covariance."""
        return whitener(self.mixed, self.null.variances)

    def whiten(self, columns: Array, blocks: Indices | None = None) -> Array:
        """(n, P) columns of the channel in units of the null's scatter; of some of its blocks alone, if named."""
        own, half = self.in_blocks(columns), self._whitening
        if blocks is not None:
            own, half = own[blocks], half[blocks]
        return np.asarray((half @ own).reshape(-1, columns.shape[1]))

    def without(self, effects: Collection[str]) -> Self:
        """The model in which an arm does not err by some effects of the library, of any size."""
        own = frozenset(effects) & frozenset({} if self.pose_errors is None else self.pose_errors.effects)
        if not own or self.pose_errors is None:
            return self
        if own not in self._reduced:
            errors = self.pose_errors.without(own)
            started = replace(self, mixed=with_pose_errors(self.mixed, errors), pose_errors=errors, full_model=self)
            self._reduced[own] = started.refit()
        return self._reduced[own]

    @cached_property
    def _reduced(self) -> dict[frozenset[str], Self]:
        """What `without` has found already."""
        return {}

    def refit(self) -> Self:
        """The same with the null fitted anew, from every place where its maximum may lie."""
        starts = [other.null for other in self.alternative_starts]
        starts += [at_variances(self.mixed, self.null.variances)] if self.full_model is None else []
        if self.mixed.size > _SINGLE_START_SIZE:
            starts = [min(starts, key=lambda fit: fit.deviance)]
        begun = [fit_variances(self.mixed, start=fit.variances) for fit in starts]
        return replace(self, null=min(begun, key=lambda fit: fit.deviance))

    @cached_property
    def scatter_only(self) -> Self:
        """As if the flange alone erred, anew in every view."""
        if self.mixed.further is None:
            return self
        mixed = replace(self.mixed, components=self.mixed.components[: NOISE + 1], further=None)
        return replace(
            self, mixed=mixed, null=fit_variances(mixed, both_starts=True), pose_errors=None, full_model=None
        )

    @cached_property
    def without_arm(self) -> Self:
        """As if neither joints nor links erred again, from pose to pose."""
        return self if self.pose_errors is None else self._restricted_to(self.pose_errors.without_arm())

    @cached_property
    def independent_only(self) -> Self:
        """As if poses erred anew in every view, by their joints or as a whole."""
        if self.pose_errors is not None:
            return self._restricted_to(self.pose_errors.independent_only())
        if self.offsets is None:
            return self
        components = np.concatenate([self.mixed.components, (self.offsets @ self.offsets.transpose(0, 2, 1))[None]])
        further = FurtherPrior(np.array([USUAL_JOINT_SCATTER]), np.array([ALWAYS_PRESENT]), np.zeros(1, bool))
        mixed = replace(self.mixed, components=components, further=further)
        return replace(self, mixed=mixed, offsets=None, null=fit_variances(mixed, both_starts=True))

    @cached_property
    def without_drift(self) -> Self:
        """As if the flange did not wander in time."""
        return self if self.pose_errors is None else self._restricted_to(self.pose_errors.without_drift())

    def _restricted_to(self, errors: PoseErrors) -> Self:
        """With some of the pose errors alone."""
        assert self.pose_errors is not None
        mixed = with_pose_errors(self.mixed, errors)
        few = np.append(self.scatter_only.null.variances, _NEGLIGIBLE_SHARE * errors.scales**2)
        kept = np.array([name in errors.names for name in self.pose_errors.names], bool)
        same = self.null.variances[np.append(np.ones(NOISE + 1, bool), kept)]
        null = min((fit_variances(mixed, start=start) for start in (few, same)), key=lambda fit: fit.deviance)
        return replace(self, mixed=mixed, null=null, pose_errors=errors, full_model=None)

    @cached_property
    def alternative_starts(self) -> tuple[Self, ...]:
        """The same at other variances than those of the null, where beside a further effect its maximum may lie: where
        there is nothing but scatter, as much as without other errors or as much as beside them, and where the whole of
        the pose errors has them."""
        if self.pose_errors is None:
            return ()
        whole = self.full_model or self
        few = _NEGLIGIBLE_SHARE * self.pose_errors.scales**2
        found = [np.append(null.variances[: NOISE + 1], few) for null in (whole.scatter_only.null, self.null)]
        if self.full_model is not None and self.full_model.pose_errors is not None:
            own = dict(zip(self.full_model.pose_errors.names, self.full_model.null.variances[NOISE + 1 :], strict=True))
            kept = [own[name] for name in self.pose_errors.names]
            found.append(np.append(self.full_model.null.variances[: NOISE + 1], kept))
        return tuple(replace(self, null=at_variances(self.mixed, variances)) for variances in found)
