"""The field of disagreement: per place of the part, how far each view puts the surface from where the others put it.

The distance of two matched points carries the noise of both. Averaged over a patch (`Patches`) the noise goes and
what repeats stays: the error of the model as it shows on the part.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.sparse import csr_matrix

from stitch.effects.contract import EFFECTS, parameters_in
from stitch.model.forward import corrected_capture, true_geometry
from stitch.model.model import Model, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import Match, signed_distances
from stitch.observations.surfaces.normal_equations import RMS_GATE
from stitch.observations.targets.target_model import rms_of
from stitch.output.remembered import remembered
from stitch.run_data import LedgerStep, RunData
from stitch.session.capture import Sightings
from stitch.session.measurement import Measurement

# A colour bar shows so many steps that people tell apart.
COLOUR_STEPS = 10
# Mean of |x| of a normal x of unit sigma.
_MEAN_OF_NORMAL = float(np.sqrt(2 / np.pi))


@dataclass(frozen=True)
class DisagreementField:
    """Signed distances of V views at K patches, positive outwards; NaN where a view and no other sees the patch."""

    values: Array  # (V, K) length_unit
    sigma: Array  # (V, K) standard errors

    @cached_property
    def overall(self) -> Array:
        """(K,) mean of |value| over the views that see a patch; NaN where they are fewer than two."""
        return _mean_over_views(np.abs(self.values))

    @cached_property
    def by_view(self) -> Array:
        """(V,) mean of |value| over the patches that a view sees; NaN where it sees none with others."""
        seen = np.isfinite(self.values)
        count = seen.sum(axis=1)
        return np.where(count > 0, np.where(seen, np.abs(self.values), 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)

    @property
    def mean_abs(self) -> float:
        """Mean of |value| over the part."""
        return float(np.nanmean(self.overall)) if np.isfinite(self.overall).any() else float("nan")

    @property
    def noise(self) -> float:
        """Return what `mean_abs` would be if noise were all there is."""
        if not np.isfinite(self.sigma).any():
            return float("nan")
        return _MEAN_OF_NORMAL * float(np.nanmean(_mean_over_views(self.sigma)))

    def quantile(self, share: float = 0.95) -> float:
        """The distance that this share of the part keeps."""
        seen = self.overall[np.isfinite(self.overall)]
        return float(np.quantile(seen, share)) if len(seen) else float("nan")


def full_colour_distance(field: DisagreementField) -> float:
    """Distance at which colours are full: no step of them is smaller than the standard error of nearly all patches."""
    return max(field.quantile(), COLOUR_STEPS * largest_standard_error(field.sigma))


def largest_standard_error(sigma: Array) -> float:
    """Return the limit that nearly all standard errors stay below."""
    return float(np.nanquantile(sigma, 0.9))


def _mean_over_views(values: Array) -> Array:
    """(K,) over the views (V, K) that see a patch; NaN where they are fewer than two."""
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    return np.where(count > 1, np.where(seen, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


# Patches of the part on which the field of disagreement is read, as small as the noise allows.
#
# A patch is a Gaussian mean over its neighbourhood on the same side of the part. Its radius is the smallest at which
# the standard error of nearly all patches is below a step of the colours. All states of a model are read by the same
# correspondences on the same patches, so that the difference of two fields is that of the models alone.

# Radii of the patches that are tried, as shares of the part's longest side.
_RADII = (1 / 32, 1 / 24, 1 / 18, 1 / 13, 1 / 10)
# A patch counts its correspondences in cells of this share of its radius; the cells' scatter is its standard error.
_CELL = 0.4
# Fewer cells than this say nothing about their scatter.
_ENOUGH = 5.0
# Patches this much closer than their radius overlap enough to leave no place between them.
_APART = 0.7
# Radii after which the weights end.
_REACH = 2.0
_SAME_SIDE = np.cos(np.radians(60.0))


@dataclass(frozen=True)
class Patches:
    """K patches of the part, and which correspondences belong to them, with which weight."""

    points: Array  # (K, 3) reference frame
    normals: Array  # (K, 3) unit, outwards
    radius: float  # standard deviation of the weights, length_unit
    sigma: Array  # (V, K) standard errors of the means, NaN where nobody can say
    kernel: csr_matrix  # (K, C) weights of cells
    counts: "_Counts"

    def field(self, distances: Array) -> DisagreementField:
        """The field of signed distances (M,) of all correspondences in their order, v less w."""
        with np.errstate(invalid="ignore", divide="ignore"):
            value = self.kernel @ self.counts.differences(distances) / (self.kernel @ self.counts.numbers)
        return DisagreementField(np.where(np.isfinite(self.sigma), value.T, np.nan), self.sigma)


@dataclass(frozen=True)
class _Counts:
    """Both sides of every correspondence that counts, by cell and view."""

    inside: Mask  # (M,) of all correspondences
    view: Indices  # (2R,) first all v, then all w
    cell: Indices  # (R,)
    views: int
    cells: int

    @cached_property
    def _key(self) -> Indices:
        return np.concatenate([self.cell, self.cell]) * self.views + self.view

    @cached_property
    def numbers(self) -> Array:
        """(C, V) how many there are."""
        return np.bincount(self._key, minlength=self.cells * self.views).reshape(self.cells, self.views).astype(float)

    def differences(self, values: Array) -> Array:
        """(C, V) sums of values (M,), those of a w with the other sign."""
        e = values[self.inside]
        sums = np.bincount(self._key, np.concatenate([e, -e]), self.cells * self.views)
        return np.asarray(sums.reshape(self.cells, self.views), float)


def patches_of(matches: Sequence[Match], views: int, scale: float, model_distances: Array) -> Patches:
    """Patches over the surface that the matches cover, as small as the noise allows.

    Args:
        matches: of all overlapping pairs, with the views where they agree best: what scatters there is noise.
        views: their number V.
        scale: robust sigma of the distances; what lies beyond the gate of the rms is an edge.
        model_distances: (M,) distances under the model whose field the colours are to show.
    """
    quiet = np.concatenate([m.residual for m in matches])
    inside = np.abs(quiet) < RMS_GATE * scale
    middle = np.concatenate([m.middle for m in matches]).compress(inside, axis=0)
    normal = np.concatenate([m.normal for m in matches]).compress(inside, axis=0)
    pair = [np.concatenate([np.full(len(m.residual), getattr(m, side)) for m in matches])[inside] for side in "vw"]
    view = np.concatenate(pair).astype(np.int64)
    size = float(np.ptp(np.quantile(middle, [0.005, 0.995], axis=0), axis=0).max())
    for share in _RADII:
        radius = share * size
        cell, centre, facing = _group_points(middle, normal, _CELL * radius)
        counts = _Counts(inside, view, cell, views, len(centre))
        _, place, outwards = _group_points(centre, facing, _APART * radius)
        kernel = _kernel(place, outwards, centre, facing, radius)
        sigma = _standard_errors(kernel, counts, quiet)
        found = Patches(place, outwards, radius=radius, sigma=sigma, kernel=kernel, counts=counts)
        if (
            not np.isfinite(sigma).any()
            or largest_standard_error(sigma) <= found.field(model_distances).quantile() / COLOUR_STEPS
        ):
            break
    return found


def _standard_errors(kernel: csr_matrix, counts: _Counts, quiet: Array) -> Array:
    """(V, K) of the weighted mean of the cells of a patch, by their scatter about it: Σ a²(m − d)², a their weights.

    Neighbouring distances share points and normals; cells are wide enough not to.
    """
    n = counts.numbers
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nan_to_num(counts.differences(quiet) / n)
        total = kernel @ n
        value = kernel @ (n * mean) / total
        square, a2 = kernel.multiply(kernel).tocsr(), n**2
        spread = square @ (a2 * mean**2) - 2 * value * (square @ (a2 * mean)) + value**2 * (square @ a2)
        cells = total**2 / (square @ a2)
        sigma = np.sqrt(np.maximum(spread, 0) * cells / (cells - 1)) / total
    return np.asarray(np.where(cells > _ENOUGH, sigma, np.nan).T)


def _kernel(place: Array, outwards: Array, centre: Array, facing: Array, radius: float) -> csr_matrix:
    """(K, C) Gaussian weights of the cells about every place that face the same way."""
    near = min(len(centre), int(4 * (_REACH / _CELL) ** 2))
    distance, index = KDTree(centre).query(place, k=near, distance_upper_bound=_REACH * radius)
    distance, index = distance.reshape(len(place), -1), index.reshape(len(place), -1)
    found = np.isfinite(distance)
    index = np.where(found, index, 0).astype(np.int64)
    found &= np.einsum("kni,ki->kn", facing.take(index, axis=0), outwards) > _SAME_SIDE
    row = np.broadcast_to(np.arange(len(place))[:, None], index.shape)[found]
    weights = np.exp(-((distance[found] / radius) ** 2) / 2)
    return csr_matrix((weights, (row, index[found])), shape=(len(place), len(centre)))


def _group_points(points: Array, normals: Array, size: float) -> tuple[Indices, Array, Array]:
    """Number of the group of every point, and per group mean point and unit normal; both sides of a sheet differ."""
    side = 2 * np.abs(normals).argmax(axis=1)
    side += np.take_along_axis(normals, (side // 2)[:, None], axis=1)[:, 0] > 0
    index = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    key = np.ravel_multi_index((*index.T, side), (*(index.max(axis=0) + 1), 6))
    # The grid has some eighty cells a side: a table of all takes less than a search for the different ones.
    every = np.bincount(key)
    group, count = (np.cumsum(every > 0) - 1)[key], every[every > 0]
    point, normal = (
        np.stack([np.bincount(group, x, len(count)) for x in values.T], axis=1) / count[:, None]
        for values in (points, normals)
    )
    return group, point, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


# The field of disagreement at every step of a model's history: coarse, corrected, each effect, register.

COARSE, HAND_EYE_ONLY, REGISTER = "coarse", "hand-eye alone", "register"


@dataclass(frozen=True)
class ModelStep:
    """One step of the history: where it puts the views, and how far they disagree there."""

    name: str  # coarse | hand-eye alone | + joint_compliance | register
    poses: Array  # (V, 4, 4) T_reference_scanner
    field: DisagreementField


@dataclass(frozen=True)
class ModelHistory:
    """All steps, judged by the same correspondences on the same patches."""

    patches: Patches
    steps: tuple[ModelStep, ...]

    @property
    def models(self) -> tuple[ModelStep, ...]:
        """The steps between the coarse hand-eye and register: one per model that was fitted."""
        return tuple(step for step in self.steps if step.name not in (COARSE, REGISTER))


@remembered
def model_history(run: RunData) -> ModelHistory | None:
    """Return the field at every step of a run's history; None without clouds.

    Steps whose effects are not known any more are left out.
    """
    if run.registered is None:
        return None
    matches = run.registered.matches
    states = [(name, *true_geometry(run.measurement, model)) for name, model in models_of(run)]
    states.append((REGISTER, run.poses, states[-1][2]))
    apart = [signed_distances(matches, poses, points) for _, poses, points in states]
    patches = patches_of(matches, len(run.poses), run.registered.gram.scale, model_distances=apart[1])
    steps = [ModelStep(name, poses, patches.field(e)) for (name, poses, _), e in zip(states, apart, strict=True)]
    return ModelHistory(patches, tuple(steps))


def effect_changes(ledger: Sequence[LedgerStep], i: int) -> str:
    """Return what step i added or dropped: + joint_compliance."""
    if i == 0:
        return ", ".join(ledger[0].effects) or HAND_EYE_ONLY
    new = [f"+ {e}" for e in ledger[i].effects if e not in ledger[i - 1].effects]
    gone = [f"− {e}" for e in ledger[i - 1].effects if e not in ledger[i].effects]
    return ", ".join([*new, *gone]) or "fitted again"


def models_of(run: RunData) -> list[tuple[str, Model]]:
    """Name of the step and model: coarse, each line of the ledger, the present one as the last."""
    out = [(COARSE, Model(run.T_mount_coarse))]
    for i, step in enumerate(run.ledger[:-1]):
        model = _model_of(step, run.measurement)
        if model is not None:
            out.append((effect_changes(run.ledger, i), model))
    last = effect_changes(run.ledger, len(run.ledger) - 1) if run.ledger else ", ".join(run.effects) or HAND_EYE_ONLY
    return [*out, (last, run.model)]


def _model_of(step: LedgerStep, measurement: Measurement) -> Model | None:
    if any(name not in EFFECTS or name not in step.values for name in step.effects):
        return None
    terms = []
    for name in step.effects:
        own = parameters_in(measurement, EFFECTS[name])
        terms.append(Term(EFFECTS[name], own).at(np.array([step.values[name].get(p.name, 0.0) for p in own])))
    return Model(step.T_mount, tuple(terms))


# How far the targets lie off their place at every step of a model's history.


@dataclass(frozen=True)
class TargetStep:
    """One step of the history, V views with S slots for targets."""

    name: str  # coarse | hand-eye alone | + joint_compliance | register
    distances: Array  # (V, S) 3D, of every target from its place; NaN where none was seen; length_unit
    rms: float  # over all of them, as the ledger has it


def target_history(run: RunData) -> tuple[TargetStep, ...]:
    """All steps on the same sightings, those that count now; empty where no targets were seen.

    The model in use is the last but one. Steps whose effects are not known any more are left out.
    """
    s = run.measurement.capture.sightings
    if run.targets is None or s is None:
        return ()
    models = models_of(run)
    steps = []
    for name, model in models[:-1]:
        own = corrected_capture(run.measurement, model)
        assert own.sightings is not None
        steps.append(_target_step(name, s, frames.transform(own.poses(model.T_mount), own.sightings.points)))
    rows = run.targets.rows
    steps.append(TargetStep(models[-1][0], rows.distances(rows.residual), run.targets.rms))
    return (*steps, _target_step(REGISTER, s, frames.transform(run.poses, rows.sightings.points)))


def _target_step(name: str, s: Sightings, placed: Array) -> TargetStep:
    """Return one step: targets (V, S, 3) as the views place them, each about the middle of all views."""
    own = np.full(s.used.shape, np.nan)
    for k in range(len(s.targets)):
        here = s.used & (s.target == k)
        if here.any():
            own[here] = np.linalg.norm(placed[here] - placed[here].mean(axis=0), axis=1)
    return TargetStep(name, own, rms_of(own))
