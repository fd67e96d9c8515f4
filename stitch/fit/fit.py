"""The one fit of hand-eye, effects and whatever else is unknown: linearise, choose what is fitted, solve, repeat.

What was observed says how: overlapping surfaces of all sessions of a rig (`surface_fit.py`), or labelled points
(`target_fit.py`).
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np

from stitch.effects.contract import one_by_one
from stitch.model.model import Model, Term, sizes_of
from stitch.numerics.frames import Mask
from stitch.numerics.least_squares import independent
from stitch.numerics.parameter_selection import UNSEEN, WhitenedData, select_supported

# Iterations in which it is still open what is fitted.
_CHOICE_STEPS = 2
# The prior of a fitted parameter about zero, in plausible sizes: it keeps the unseen finite, moves nothing else.
WEAK = 10.0


class FitStep(Protocol):
    """One step of a fit."""

    @property
    def model(self) -> Model:
        """The model after the step."""
        ...

    @property
    def moved(self) -> float:
        """The largest move of an unknown in its sigmas."""
        ...

    @property
    def rms(self) -> float:
        """What remained before the step, length_unit."""
        ...


StepT = TypeVar("StepT", bound=FitStep)
StepT_co = TypeVar("StepT_co", bound=FitStep, covariant=True)


class LinearisedFit(Protocol[StepT_co]):
    """What was observed, linearised about a model."""

    def choose(self, before: Any) -> Any:
        """What is fitted, given what was so far: None at first."""
        ...

    def solve(self, choice: Any) -> StepT_co:
        """The step of all unknowns."""
        ...


class FitProblem(Protocol[StepT]):
    """What was observed, ready to be linearised about any model."""

    @property
    def maximum_iterations(self) -> int: ...
    @property
    def converged(self) -> float:
        """Moves below so many sigmas end the fit."""
        ...

    def linearise(self, model: Model, previous: StepT | None) -> LinearisedFit[StepT]:
        """About a model, with what the step before knows beside it."""
        ...


def iterate(
    problem: FitProblem[StepT], model: Model, watch: Callable[[int, StepT], None] | None = None
) -> tuple[StepT, list[float]]:
    """The last step from a model that is near, converged or the last allowed, and the rms before every step.

    Args:
        watch: told of every step, with its number from 0.

    Raises:
        NoResultError: no two views overlap.
    """
    step: StepT | None = None
    choice: Any = None
    history: list[float] = []
    while step is None or (len(history) < problem.maximum_iterations and step.moved >= problem.converged):
        linearised = problem.linearise(model, step)
        if choice is None or len(history) < _CHOICE_STEPS:
            choice = linearised.choose(choice)
        step = linearised.solve(choice)
        model = step.model
        if watch is not None:
            watch(len(history), step)
        history.append(step.rms)
    return step, history


def fitted_parameters(terms: Sequence[Term], before: Mask, whitened: Callable[[Mask], WhitenedData]) -> Mask:
    """(P,) parameters that the views support and can tell apart.

    Args:
        before: (P,) what explained scatter so far; never what another run's arm brought.
        whitened: the observation in units of the scatter that is left when some parameters explain theirs.
    """
    sizes = sizes_of(terms)
    groups, effects, at = list[list[int]](), list[int](), 0
    for number, term in enumerate(terms):
        kept = any(p.kept for p in term.parameters)
        own = [] if kept else one_by_one(term.effect, term.parameters)
        groups += [[at + i for i in group] for group in own]
        effects += [number] * len(own)
        at += len(term.parameters)
    if not groups:
        return before
    free, seen = before, whitened(before)
    for _ in range(_CHOICE_STEPS):
        # What is found explains scatter, and less scatter shows more.
        found = select_supported(seen, sizes, groups, effects)
        if (found == free).all():
            break
        free, seen = found, whitened(found)
    return np.logical_and(free, independent(seen.base, seen.further * free, sizes, 1 / UNSEEN))
