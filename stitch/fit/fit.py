"""The one fit of hand-eye, effects and whatever else is unknown: linearise, choose what is fitted, solve, repeat.

What was observed says how: overlapping surfaces of all sessions of a rig (`surface_fit.py`), or labelled points
(`target_fit.py`). About either goes a second loop: labelled points that contradict the rest are taken out, and what is
left is fitted again.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from stitch.effects.contract import separable_groups
from stitch.errors import NoResultError
from stitch.fit.coarse import CoarseHandEye
from stitch.fit.correct import Correction
from stitch.model.model import Model, Term, sizes_of
from stitch.model.model_toml import ModelFile
from stitch.numerics.frames import Mask
from stitch.numerics.least_squares import independent
from stitch.numerics.parameter_selection import UNSEEN, WhitenedData, select_supported
from stitch.observations.targets.outliers import Outlier, find_mislabelled, find_outliers, mask_outliers
from stitch.observations.targets.target_model import TargetModelFit
from stitch.session.capture import Capture, Sightings
from stitch.session.measurement import Measurement

# Iterations in which it is still open what is fitted.
_CHOICE_STEPS = 2
# The prior of a fitted parameter about zero, in plausible sizes: it keeps the unseen finite, moves nothing else.
WEAK = 10.0
# More outliers than this share of what was seen, and it is the rest that is wrong.
_MOST_OUTLIERS = 1 / 3

# From a measurement, its model and the gate to the model that the fit of effects begins with.
InitialModel = Callable[[Measurement, Model, float], Model]
FitResult = TypeVar("FitResult")
LinearisedT = TypeVar("LinearisedT", bound="Linearised")
SolutionT = TypeVar("SolutionT")


@dataclass(frozen=True)
class FitStart:
    """From what a fit begins: coarse hand-eyes, a model that was fitted before, or one that stays as it is."""

    hand_eyes: Sequence[CoarseHandEye]  # of every session
    effects: InitialModel | None = None  # effects that are fitted with the hand-eye
    model: Model | None = None  # fitted before: the fit goes on from there
    gate: float = float("nan")  # of that model: largest distance between partners, length_unit
    given: ModelFile | None = None  # of another run: neither hand-eye nor effects are fitted


@dataclass(frozen=True)
class FittedSession:
    """One session after the fit, as far as its labelled points are concerned."""

    measurement: Measurement  # with the sightings that count
    targets: TargetModelFit | None  # None without labelled points
    outliers: tuple[Outlier, ...]


@dataclass(frozen=True)
class FittedRig:
    """The common model of a rig, and its sessions as they count."""

    sessions: list[FittedSession]
    correction: Correction | None = None  # of surfaces; None where there are labelled points alone

    @property
    def captures(self) -> list[Capture]:
        """Captures of the sessions, without the effects in use."""
        if self.correction is not None:
            return list(self.correction.captures)
        return [session.targets.rows.capture for session in self.sessions if session.targets is not None]

    def model_of(self, index: int) -> Model:
        """Return the model of session `index`.

        From surfaces all sessions share one model; from labelled points each session has its own hand-eye.
        """
        if self.correction is not None:
            return self.correction.model
        targets = self.sessions[index].targets
        assert targets is not None
        return targets.model

    def heldout_rms(self, index: int) -> float:
        """Return the rms residual of session `index` on views that were left out of the fit, length_unit."""
        if self.correction is not None:
            return self.correction.overlaps[index].gram.rms * self.correction.hand_eye.heldout_ratio
        targets = self.sessions[index].targets
        assert targets is not None
        return targets.heldout_rms

    def heldout_or_fit_rms(self, index: int) -> float:
        """Return the rms of session `index` on views left out, length_unit; that of the fit where it is unknown."""
        heldout = self.heldout_rms(index)
        if np.isfinite(heldout):
            return heldout
        if self.correction is not None:
            return self.correction.overlaps[index].gram.rms
        targets = self.sessions[index].targets
        assert targets is not None
        return targets.rms


class Linearised(Protocol):
    """What was observed, linearised about a model."""

    def choose(self, before: Any) -> Any:
        """Return what is to be fitted, given what was so far; None at first."""
        ...

    def solve(self, choice: Any) -> Any:
        """Return the `Step` of all unknowns, with what `choose` returned fitted."""
        ...


@dataclass(frozen=True)
class Step(Generic[LinearisedT, SolutionT]):
    """One step of a fit: from where it was taken, and where it led."""

    linearised: LinearisedT  # about the model before the step
    choice: Any  # what was fitted, as `linearised.choose` returned it
    solution: SolutionT  # of the linear problem
    model: Model  # after the step; of the first session, where each has its own hand-eye
    moved: float  # the largest move of an unknown, in its sigmas
    rms: float  # what remained before the step, length_unit


def iterate(
    linearise: Callable[[Step[LinearisedT, SolutionT] | None], LinearisedT], *, at_most: int, converged: float
) -> Iterator[Step[LinearisedT, SolutionT]]:
    """Yield the steps of a fit, each: linearise, choose the parameters to fit, solve.

    The choice is fixed after `_CHOICE_STEPS` steps. The last step is the first that moves no unknown by `converged`
    sigmas, or step `at_most`; a fit that has not converged by then raises nothing.

    Args:
        linearise: returns the problem about the model after the step given; None: about the first model.

    Raises:
        NoResultError: no two views overlap.
    """
    step: Step[LinearisedT, SolutionT] | None = None
    choice: Any = None
    for index in range(at_most):
        linearised = linearise(step)
        if index < _CHOICE_STEPS:
            choice = linearised.choose(choice)
        step = linearised.solve(choice)
        yield step
        if step.moved < converged:
            return


def fitted_parameters(terms: Sequence[Term], before: Mask, whitened: Callable[[Mask], WhitenedData]) -> Mask:
    """Return a mask (P,) of the parameters that the views support and can tell apart; the others are to stay at zero.

    Parameters that place axes (`Term.is_geometry`) are chosen first: all that the views show. Those of effects are
    chosen with these free (`_supported_parameters`), since the place of an axis is unknown like the hand-eye.

    Args:
        before: (P,) mask of the parameters fitted so far; none of another run's arm (`kept`) is among them.
        whitened: returns the observations whitened by the scatter that remains when the parameters of a mask are free.
    """
    may_be_fitted = np.array([term.is_geometry and not p.held for term in terms for p in term.parameters], bool)
    if not may_be_fitted.any():
        return _supported_parameters(terms, before, whitened)
    data = whitened(before | may_be_fitted)
    fitted = may_be_fitted & independent(data.base, data.further * may_be_fitted, sizes_of(terms), 1 / UNSEEN)
    effects = [term for term in terms if not term.is_geometry]
    if effects:
        of_effects = np.array([not term.is_geometry for term in terms for _ in term.parameters], bool)
        beside_axes = partial(_effects_beside_axes, whitened, fitted.copy(), of_effects)
        fitted[of_effects] = _supported_parameters(effects, before[of_effects], beside_axes)
    return fitted


def _effects_beside_axes(
    whitened: Callable[[Mask], WhitenedData], axes: Mask, of_effects: Mask, free: Mask
) -> WhitenedData:
    """Return the whitened data with the columns of effects as `further`, those of the fitted axes in `base`.

    Args:
        whitened: returns the whitened data of all P parameters, as in `fitted_parameters`.
        axes: (P,) mask of the parameters of axes that are fitted.
        of_effects: (P,) mask of the E parameters of effects.
        free: (E,) mask of the parameters of effects that are free while the scatter is estimated.
    """
    all_free = axes.copy()
    all_free[of_effects] = free
    data = whitened(all_free)
    return WhitenedData(np.hstack([data.base, data.further[:, axes]]), data.further[:, of_effects], data.z)


def _supported_parameters(terms: Sequence[Term], before: Mask, whitened: Callable[[Mask], WhitenedData]) -> Mask:
    """Return a mask (P,) of parameters to fit: groups selected by evidence, less what cannot be told apart.

    The selection (`select_supported`) is made again with what it fits free, at most `_CHOICE_STEPS` times: what is
    fitted explains scatter, and less scatter shows more. Effects of another run's arm (`kept`) are not selected.

    Args:
        before: (P,) mask of the parameters fitted so far.
        whitened: as in `fitted_parameters`.
    """
    sizes = sizes_of(terms)
    # Groups of parameters that can be true alone, and the number of the effect of each.
    groups, effects, first = list[list[int]](), list[int](), 0
    for number, term in enumerate(terms):
        if not any(p.kept for p in term.parameters):
            of_term = separable_groups(term.effect, term.parameters)
            groups += [[first + i for i in group] for group in of_term]
            effects += [number] * len(of_term)
        first += len(term.parameters)
    if not groups:
        return before
    free, data = before, whitened(before)
    for _ in range(_CHOICE_STEPS):
        supported = select_supported(data, sizes, groups, effects)
        if (supported == free).all():
            break
        free, data = supported, whitened(supported)
    return np.logical_and(free, independent(data.base, data.further * free, sizes, 1 / UNSEEN))


def fit_without_outliers(
    measurements: Sequence[Measurement],
    fit: Callable[[Sequence[Measurement], FitResult | None], FitResult],
    targets_of: Callable[[Sequence[Measurement], FitResult], Sequence[TargetModelFit | None]],
) -> tuple[FitResult, list[FittedSession]]:
    """Return a fit and its sessions without outliers, labelled points that contradict the rest.

    Fitting and removing outliers (`find_outliers`) alternate until none is found. Mislabelled targets are removed
    before the first fit, since they would pull it.

    Args:
        fit: returns the fit of measurements; its second argument is the fit of the round before, None in the first.
        targets_of: returns the labelled points of every session under a fit, None for a session without any.

    Raises:
        NoResultError: more than a third of the labelled points of a session would have to go.
    """
    # Outliers that an earlier fit has removed count again: they are sought anew.
    all_points = [_with_sightings(m, s.with_outliers) if (s := m.capture.sightings) else m for m in measurements]
    removed = [[m.outlier for m in find_mislabelled(s)] if (s := a.capture.sightings) else [] for a in all_points]
    measurements = [_remove_points(m, outliers) for m, outliers in zip(all_points, removed, strict=True)]
    result: FitResult | None = None
    while True:
        result = fit(measurements, result)
        targets = targets_of(measurements, result)
        found = [find_outliers(t.rows, t.variances) if t else [] for t in targets]
        if not any(found):
            sessions = zip(measurements, targets, removed, strict=True)
            return result, [FittedSession(m, t, tuple(outliers)) for m, t, outliers in sessions]
        measurements = [_remove_points(m, outliers) for m, outliers in zip(measurements, found, strict=True)]
        removed = [[*before, *outliers] for before, outliers in zip(removed, found, strict=True)]


def _remove_points(measurement: Measurement, outliers: Sequence[Outlier]) -> Measurement:
    """Return the measurement without some of its labelled points.

    Raises:
        NoResultError: more than a third of all its labelled points would be left out by now.
    """
    sightings = measurement.capture.sightings
    if not outliers or sightings is None:
        return measurement
    used = mask_outliers(sightings.used, outliers, sightings.targets, sightings.target)
    if used.sum() < (1 - _MOST_OUTLIERS) * sightings.with_outliers.used.sum():
        raise NoResultError(
            f"{measurement.capture.name}: more than a third of the labelled points contradict the rest; check the "
            "names of the targets, the order of the views, mount and pose convention"
        )
    return _with_sightings(measurement, replace(sightings, used=used))


def _with_sightings(measurement: Measurement, sightings: Sightings) -> Measurement:
    """Return the measurement with other labelled points."""
    return replace(measurement, capture=replace(measurement.capture, sightings=sightings))
