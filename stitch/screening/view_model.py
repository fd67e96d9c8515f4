"""What overlaps and targets say about the pose of every view, as one linear model of visible directions, and its tests.

A view's own displacement, or a block's, is tested under the scatter of the other poses. The evidence is linear:
z = X ξ + Σ L_v δ_v + ε, with ξ the hand-eye, δ_v a displacement of view v (left twist in the reference frame) and
cov(ε) of pose scatter and sensor noise. With P = C⁻¹ − C⁻¹X(XᵀC⁻¹X)⁻¹XᵀC⁻¹, the statistic of an alternative with
columns G is T = uᵀN⁻¹u, u = GᵀPz, N = GᵀPG: χ² with rank(N) degrees of freedom, with non-centrality δᵀNδ where a
blunder δ is present (Baarda 1968; Teunissen, Testing Theory, 2000).

What only a weak direction seems to show is no size of a displacement: a scan that slides along the part, or that few
holes keep from turning, comes to rest millimetres from where it belongs, and where all scans slid together each stands
off from its pose by that. The estimate of the test knows both: what the views have in common, and how well each
direction is held.

A view that stands out from white scatter may do so by a blunder, or because the arm bends as arms do. The second is a
random effect (Searle, Casella and McCulloch 1992): every parameter of every effect is zero give or take its size, and
the views scatter accordingly, together and not one by one (`UsualEffects`).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from stitch.effects.contract import EFFECTS, EVERY_VIEW, missing_need, of_each_scanner
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.numerics.distributions import f_limit, f_tail
from stitch.numerics.frames import Array
from stitch.numerics.kernels import process_covariance
from stitch.numerics.least_squares import column_space, equilibrated, invert_covariance
from stitch.numerics.reml import MixedModel, VarianceFit, fit_variances
from stitch.observations.linear_model import with_pose_errors
from stitch.observations.pose_errors import DRIFT_MEMORY, PoseErrors, drift_kernel, prior_pose_errors, usual_twist
from stitch.observations.surfaces.effect_columns import view_responses
from stitch.observations.surfaces.hand_eye_fit import (
    ReducedPoses,
    hand_eye_jacobian,
    reduce_poses,
)
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement

# Combinations of parameters weaker than this share of the strongest are not seen.
SEEN = 1e-6
# A direction of one view's displacement is held if surfaces see this share of it. Where a scan slides along the others
# it is 0.001 and less, and what little is seen is their noise; elsewhere 0.9.
_HELD_SHARE = 0.1
# Chance that the evidence tells the least displacement that is likely from the right one.
_CHANCE = 0.01
# Standard deviation of a parameter, in usual sizes: effects of up to four times the usual size are not rare then.
_TIMES_USUAL = 2.0
# Correspondences that tell what an effect does to the views where its size is free.
_MAX_CORRESPONDENCES = 20_000


@dataclass(frozen=True)
class ViewModel:
    """What overlaps and targets say about the poses of V views: the n visible directions that diagnosis reads too."""

    reduced: ReducedPoses
    mount_jacobians: Array  # (V, 6, 6) left twist of a view about `centre` that a correction of its hand-eye makes
    centre: Array  # (3,) reference frame
    lever: float  # length_unit: rotations about `centre` count as displacements at this distance
    usual: Array | None = None  # (n, n) covariance of what effects of the library may do
    errors: PoseErrors | None = None  # of the n numbers, beside white scatter, in sizes that the views show
    # What was fitted, by the bytes of the further columns: tests ask for the same means again and again.
    _fits: dict[bytes, VarianceFit] = field(default_factory=dict, init=False, repr=False, compare=False)

    def with_usual(self, twists: Array) -> "ViewModel":
        """Return the model of an arm that may have effects: twists (6V, P) of the views, rad and length_unit."""
        columns = self.reduced.reduction @ twists
        return replace(self, usual=columns @ columns.T)

    @property
    def z(self) -> Array:
        """(n,) what was seen."""
        return self.reduced.z

    @property
    def hand_eye(self) -> Array:
        """(n, 6) response to a common correction of the hand-eye."""
        return self.reduced.hand_eye

    @property
    def count(self) -> int:
        """Number of views."""
        return len(self.mount_jacobians)

    @property
    def unit(self) -> Array:
        """(6,) by which twists with rotations in 1/lever become such with rotations in rad."""
        return np.array([1 / self.lever] * 3 + [1.0] * 3)

    @cached_property
    def views(self) -> Array:
        """(V, n, 6) response to a left twist of one view, rotations in 1/lever."""
        return self._by_view * self.unit

    @cached_property
    def mounts(self) -> Array:
        """(V, n, 6) response of one view to a correction of its own hand-eye, rad and length_unit."""
        return self._by_view @ self.mount_jacobians

    @cached_property
    def steps(self) -> dict[str, Array]:
        """By the body that moves, part or scanner, (V, n, 6) response of the evidence to a step at each view.

        A step displaces that view and all after it alike: as `views` does of the part, `mounts` of the scanner.
        """
        return {
            moved: np.cumsum(of_views[::-1], axis=0)[::-1]
            for moved, of_views in (("part", self.views), ("scanner", self.mounts))
        }

    @cached_property
    def _by_view(self) -> Array:
        """(V, n, 6) response to a left twist of one view, rad and length_unit."""
        return self.reduced.reduction.reshape(-1, self.count, 6).transpose(1, 0, 2)

    @cached_property
    def mount_twists(self) -> Array:
        """(V, 6, 6) the twist of a view that a correction of its hand-eye makes, rotations in 1/lever."""
        return self.mount_jacobians / self.unit[:, None]

    @cached_property
    def held_responses(self) -> Array:
        """(V, n, 6) as `views`, with the directions projected out in which surfaces hardly hold a single view.

        They are right singular vectors of the view's columns whose squared singular value is below `_HELD_SHARE`.
        """
        _, values, vectors = np.linalg.svd(self.views, full_matrices=False)
        held = vectors * (values**2 > _HELD_SHARE)[:, :, None]
        return self.views @ held.transpose(0, 2, 1) @ vectors

    def columns(self, free_views: Sequence[int]) -> Array | None:
        """(n, 6k) that let some views stand anywhere."""
        return np.concatenate([self.views[v] for v in free_views], axis=1) if len(free_views) else None

    def mixed(self, further: Array | None = None) -> MixedModel:
        """Return the model with further columns (n, K) in its mean, ready for restricted maximum likelihood."""
        mean = column_space(hstack_columns(self.hand_eye, further), SEEN)
        usual = None if self.usual is None else self.usual[None]
        mixed = MixedModel(self.z[None], mean[None], self.reduced.components[:, None], usual)
        return mixed if self.errors is None else with_pose_errors(mixed, self.errors)

    def fit(self, further: Array | None = None) -> VarianceFit:
        """Return the variances of the poses' scatter with further columns (n, K) free in the mean; each fit is cached.

        They are rotation (rad²), translation (length_unit²), noise factor. One view more in the mean changes them
        little: a search begins where the last one ended.
        """
        key = b"" if further is None else further.tobytes()
        if key not in self._fits:
            last = list(self._fits.values())[-1].variances if self._fits else None
            self._fits[key] = fit_variances(self.mixed(further), start=last, both_starts=self.errors is not None)
        return self._fits[key]

    def deviance(self, further: Array | None = None) -> float:
        """Return −2 log likelihood of z with further columns (n, K) free in the mean.

        The full likelihood, not the restricted one, so that different means can be compared.
        """
        fit = self.fit(further)
        C = self.mixed(further).covariance(fit.variances)[0]
        return float(np.linalg.slogdet(C)[1] + self.z @ projector(self, fit, further).projected)


def view_model(capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses) -> ViewModel:
    """Return the linear model of what the overlaps say about the poses of all views.

    Args:
        T_mount: (4, 4) hand-eye of the model's poses, from which the twists of `unconstrained` are counted.
        unconstrained: the views moved by the overlaps alone.
    """
    gram = unconstrained.overlaps.gram
    return ViewModel(
        reduced=reduce_poses(capture, gram, unconstrained.twists, T_mount),
        mount_jacobians=hand_eye_jacobian(capture, T_mount, gram.centre).reshape(-1, 6, 6),
        centre=gram.centre,
        lever=max(gram.lever, 1e-300),
    )


@dataclass(frozen=True)
class Projector:
    """P of one null hypothesis: a fitted covariance and a free mean."""

    P: Array  # (n, n)
    projected: Array  # (n,) P z
    degrees: int  # n less the columns of the mean


def projector(model: ViewModel, fit: VarianceFit, further: Array | None = None) -> Projector:
    """Return P = C⁻¹ − C⁻¹A(AᵀC⁻¹A)⁻¹AᵀC⁻¹ with C the covariance at fitted variances, and A the columns of the mean.

    Args:
        further: (n, K) columns of the mean beside the hand-eye; None: none.
    """
    mixed = model.mixed(further)
    A = mixed.A[0]
    inverse = invert_covariance(mixed.covariance(fit.variances)).matrix[0]
    CA = inverse @ A
    P = inverse - CA @ np.linalg.solve(A.T @ CA, CA.T)
    return Projector(P, P @ model.z, len(P) - A.shape[1])


@dataclass(frozen=True)
class AlternativeTest:
    """One alternative, tested."""

    statistic: float  # T
    degrees: int
    p_value: float  # under F, the scatter being estimated from the same data
    estimate: Array  # (6,) displacement, rotations in 1/lever
    normal: Array  # (6, 6) N: non-centrality of a displacement δ is δᵀNδ

    @property
    def rank(self) -> tuple[float, float]:
        """The less, the likelier it is: by chance, and where that is too small to be told, by the statistic."""
        return self.p_value, -self.statistic


def hstack_columns(*columns: Array | None) -> Array:
    """(n, ·) those columns that there are, side by side."""
    return np.hstack([block for block in columns if block is not None])


def test_alternatives(under: Projector, alternatives: Sequence[Array]) -> list[AlternativeTest]:
    """Return the test of each alternative, columns (n, k) in the mean, under a null hypothesis.

    P is multiplied by the columns of all alternatives in one product, since that takes most of the time.
    """
    if not alternatives:
        return []
    bounds = np.cumsum([columns.shape[1] for columns in alternatives])[:-1]
    weighted = np.split(under.P @ np.hstack(alternatives), bounds, axis=1)
    return [_tested(under, columns, held) for columns, held in zip(alternatives, weighted, strict=True)]


def test_alternative(under: Projector, columns: Array) -> AlternativeTest:
    """Test the alternative with `columns` (n, k) under a null hypothesis."""
    return test_alternatives(under, [columns])[0]


def _tested(under: Projector, columns: Array, weighted: Array) -> AlternativeTest:
    """Return the test of further columns (n, k) in the mean: their F statistic, p-value, estimates and information.

    Args:
        under: the null hypothesis.
        weighted: (n, k) the columns times the null's projector.
    """
    N = columns.T @ weighted
    u = columns.T @ under.projected
    # Units of the columns may differ.
    same_units, unit = equilibrated(N)
    values, vectors = np.linalg.eigh(same_units)
    keep = values > SEEN * max(values[-1], 1e-300)
    scaled = vectors[:, keep] * unit[:, None]
    inverse = (scaled / values[keep]) @ scaled.T
    degrees = int(keep.sum())
    statistic = float(u @ inverse @ u)
    nu = under.degrees - degrees
    if degrees == 0 or nu < 1:
        return AlternativeTest(0.0, degrees, 1.0, np.zeros(len(N)), N)
    # The scatter is estimated with the view in it: T/ν is a beta variable, told as the F of the left-out estimate.
    rest = max(under.degrees - statistic, 1e-9 * under.degrees)
    p = f_tail(statistic / degrees / (rest / nu), degrees, nu)
    return AlternativeTest(statistic, degrees, p, inverse @ u, N)


def left_out_test(
    model: ViewModel, columns: Array | None, alternative: Array, held: Array
) -> tuple[AlternativeTest, float]:
    """Return the test of an alternative under the scatter estimated with it free, and the p-value of that.

    A view that is off inflates the scatter, and with few views hides in it: so it is free while the scatter is
    estimated. For that p-value half of the degrees of freedom count, since rotations and translations share them.

    Args:
        columns: (n, K) of all else in the mean; None: none.
        alternative: (n, k) columns that are free for the scatter.
        held: (n, k) columns that are tested: those of the alternative without directions that nothing holds.
    """
    under = projector(model, model.fit(hstack_columns(columns, alternative)), columns)
    tested = test_alternative(under, held)
    free = max((under.degrees - tested.degrees) // 2, 1)
    degrees = max(tested.degrees, 1)
    return tested, f_tail(tested.statistic / degrees, degrees, free)


def leave_one_out_p_value(model: ViewModel, columns: Array | None, view: int) -> float:
    """Return the p-value of a displacement of one view, under the scatter that all others have without it.

    Directions in which its scan slides along the others are free, and not tested.

    Args:
        columns: (n, K) of all else in the mean; None: none.
    """
    return left_out_test(model, columns, model.views[view], model.held_responses[view])[1]


def displacement_lower_bound(tested: AlternativeTest, degrees: int) -> Array:
    """Return the smallest displacement (6,) in the 99 % confidence region of a test's estimate.

    Rotations count in 1/lever, as displacements at the lever.

    Args:
        degrees: degrees of freedom of the null hypothesis.
    """
    return _shortest_within_limit(tested.normal, tested.estimate, _confidence_limit(tested, degrees))


def rotation_shift_lower_bounds(tested: AlternativeTest, degrees: int, carried: Array) -> tuple[float, float]:
    """Return the smallest rotation (in 1/lever) and the smallest shift (length_unit) in the 99 % confidence region.

    Each is the smallest whatever the other one is.

    Args:
        degrees: degrees of freedom of the null hypothesis.
        carried: (6, 6) maps displacements as tested to those of the point whose shift counts.
    """
    back = np.linalg.inv(carried)
    N = back.T @ tested.normal @ back
    estimate = carried @ tested.estimate
    limit = _confidence_limit(tested, degrees)
    bounds = []
    for part, other in ((slice(0, 3), slice(3, 6)), (slice(3, 6), slice(0, 3))):
        inverse = np.linalg.pinv(N[other, other], rcond=1e-9, hermitian=True)
        left = N[part, part] - N[part, other] @ inverse @ N[other, part]
        bounds.append(float(np.linalg.norm(_shortest_within_limit(left, estimate[part], limit))))
    return bounds[0], bounds[1]


def _confidence_limit(tested: AlternativeTest, degrees: int) -> float:
    return tested.degrees * f_limit(_CHANCE, max(tested.degrees, 1), max(degrees - tested.degrees, 1))


def _shortest_within_limit(normal: Array, estimate: Array, limit: float) -> Array:
    """Return the shortest displacement x (k,) with (x − estimate)ᵀ N (x − estimate) ≤ limit; zero if that is allowed.

    Ridge regression: x = (N + pI)⁻¹ N · estimate, with p such that the limit is reached.

    Args:
        normal: N (k, k).
        estimate: (k,).
    """
    eigenvalues, axes = np.linalg.eigh(normal)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    along_axes = axes.T @ estimate
    if eigenvalues @ along_axes**2 <= limit:
        return np.zeros(len(along_axes))

    def excess(log_penalty: float) -> float:
        """Return by how much the quadratic form exceeds the limit under a penalty p, given as its logarithm."""
        penalty = np.exp(log_penalty)
        return float(eigenvalues @ (penalty / (eigenvalues + penalty) * along_axes) ** 2 - limit)

    strongest = np.log(eigenvalues[-1])
    penalty = np.exp(brentq(excess, strongest - 60, strongest + 60))
    return axes @ (eigenvalues / (eigenvalues + penalty) * along_axes)


@dataclass(frozen=True)
class UsualEffects:
    """What may happen to the views of a good session."""

    measurement: Measurement
    model: Model

    def twists(self, unconstrained: UnconstrainedPoses) -> Array:
        """Return what effects do to the views: left twists (6V, P), a column for each parameter at its usual deviation.

        About the centre of the correspondences; reference frame, rad and length_unit.
        """
        return _TIMES_USUAL * np.hstack(list(self.by_place(unconstrained).values()))

    def errors(self, unconstrained: UnconstrainedPoses) -> PoseErrors:
        """Return the pose errors of a good session as components of a covariance, whose sizes are fitted later.

        They are the prior of the arm's errors, slow wandering of mount and part (warming, creep), and per place of the
        chain (robot, mount, part, …) the effects of the library.

        Args:
            unconstrained: the views moved by the overlaps alone.
        """
        capture = self.measurement.capture
        centre = unconstrained.overlaps.gram.centre
        errors = prior_pose_errors([self.measurement], self.model, [centre])
        alike = drift_kernel([self.measurement], max(DRIFT_MEMORY.values()))
        unit = usual_twist(self.measurement.length_unit)
        of_mount = frames.adjoint_about(centre, capture.hand_eye_frames(self.model.T_mount))
        of_part = np.tile(np.eye(6), (len(unconstrained.poses), 1, 1))
        for name, moved in (("wandering mount", of_mount), ("wandering part", of_part)):
            errors = errors.with_component(name, process_covariance((moved * unit).reshape(-1, 6), alike), 1.0)
        covariances = dict[str, Array]()
        for place, columns in self.by_place(thin_correspondences(unconstrained)).items():
            # A base that tilts follows the arm's pose as its joints do: one size for both.
            cause = "robot" if place == "base" else place
            covariances[cause] = covariances.get(cause, 0.0) + columns @ columns.T
        for cause, covariance in covariances.items():
            errors = errors.with_component(cause, covariance, 1.0)
        return errors

    def by_place(self, unconstrained: UnconstrainedPoses, without: Collection[str] = ()) -> dict[str, Array]:
        """Return by place of the chain (robot, mount, part, …) what its effects do to the views.

        Args:
            without: names of effects that do not count.

        Returns:
            Left twists (6V, P) about the centre of the correspondences, a column for each parameter of plausible size;
            reference frame, rad and length_unit.
        """
        # Steps between two views are tested as blocks of views.
        possible = [
            effect
            for effect in of_each_scanner(self.measurement.views, EFFECTS.values())
            if effect.tier == "physical"
            and effect.name not in without
            and all(spec.grid != EVERY_VIEW for spec in effect.specs.values())
            and not missing_need(self.measurement, effect)
        ]
        terms = [term_of(self.measurement, effect) for effect in possible]
        columns = dict[str, list[Array]]()
        responses = view_responses(self.measurement, self.model, terms, unconstrained)
        for term, response in zip(terms, responses, strict=True):
            usual = response.columns[:, ~term.gridded] * term.typical[~term.gridded]
            columns.setdefault(term.effect.place, []).append(usual)
        return {place: np.hstack(blocks) for place, blocks in columns.items()}


def thin_correspondences(unconstrained: UnconstrainedPoses) -> UnconstrainedPoses:
    """Return the views with every k-th correspondence only, k times its weight: `_MAX_CORRESPONDENCES` at most.

    For rough estimates of what effects do to poses, which need no more.
    """
    # Rounded up.
    every = -(-sum(len(m.residual) for m in unconstrained.overlaps.matches) // _MAX_CORRESPONDENCES) or 1
    some = [m.subset(slice(None, None, every)) for m in unconstrained.overlaps.matches]
    thinned = [replace(m, weight=every * m.weight) for m in some]
    return replace(unconstrained, overlaps=replace(unconstrained.overlaps, matches=thinned))
