"""What the poses leave, by source: named effects, a course of time, smooth errors, wandering, white scatter, noise."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.score import Score
from stitch.diagnosis.unknown.process_size import FittedProcess
from stitch.frames import Array
from stitch.observations.arm_errors import JOINT_SCATTER
from stitch.observations.error_model import WHITE_COMPONENTS
from stitch.observations.flange_errors import DRIFT_MEMORY
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.scanner_field import field_scatter
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.statistics.identifiability import project_out
from stitch.statistics.least_squares import column_space
from stitch.statistics.variance_components import fit_variances
from stitch.statistics.variance_posterior import mean_variances

# Sources that are new in every view, or no error of the poses.
NOT_REPEATING = ("sensor noise", "white repeatability", "scanner field")
# Components as people call them; the arm's own keep the name of their effects.
_SOURCE_NAMES = {
    "sensor noise": "sensor noise",
    "white rotation": "white repeatability",
    "white translation": "white repeatability",
    JOINT_SCATTER: "white repeatability",
    "smooth": "smooth, unnamed",
    **dict.fromkeys(DRIFT_MEMORY, "wandering in time"),
    "stop rotation": "shared by the scans of a stop",
    "stop translation": "shared by the scans of a stop",
}


@dataclass(frozen=True)
class BudgetLine:
    """One source of what the poses leave."""

    source: str
    variance_share: float  # of all sources; they add up to 1
    sigma: float  # rms over the directions that are seen
    unit: str


def variance_budget(
    linear: LinearModel, named: Sequence[Score] = (), course: FittedProcess | None = None
) -> tuple[BudgetLine, ...]:
    """Shares of what effects in use took away and of what remains, largest first; () where poses have no prior.

    Args:
        named: candidates that are said to be missing: what they explain is theirs.
        course: of the flange in time, where one is said to be there.
    """
    if (errors := linear.pose_errors) is None:
        return ()
    linear = _with_observed_field(linear)
    hand_eye = linear.reduce(linear.design[:, :6])
    squares: dict[str, float] = {}
    for term, response in zip(linear.model.terms, linear.responses(linear.model.terms), strict=True):
        squares[term.name] = _unexplained_square(hand_eye, linear.reduce(response.columns) @ term.values)
    for score in named:
        squares[score.name] = _unexplained_square(hand_eye, score.form.columns @ score.values)
    explained = [s.form.columns for s in named]
    if course is not None:
        squares["one course of time"] = _unexplained_square(hand_eye, course.numbers)
        explained.append(course.columns)
    for name, square in _remaining_squares(linear, errors, explained):
        squares[name] = squares.get(name, 0.0) + square
    total, unit, n = sum(squares.values()), linear.measurement.length_unit, linear.mixed.size
    lines = [BudgetLine(s, x / max(total, 1e-300), float(np.sqrt(max(x, 0.0) / n)), unit) for s, x in squares.items()]
    return tuple(sorted(lines, key=lambda line: -line.variance_share))


def _with_observed_field(linear: LinearModel) -> LinearModel:
    """With smooth errors of the scanner as large as the overlaps show them; an alarm allows for larger ones."""
    seen = linear.observation
    if linear.mixed.fixed is None or not isinstance(seen, SurfaceObservation):
        return linear
    field = linear.reduce(field_scatter(linear.measurement, seen.unconstrained, share=None))
    return replace(linear, mixed=replace(linear.mixed, fixed=(field @ field.T)[None]))


def _remaining_squares(linear: LinearModel, errors: PoseErrors, named: Sequence[Array]) -> Iterator[tuple[str, float]]:
    """Sums of squares that each component leaves beside the model and what is named."""
    U = column_space(np.hstack([linear.reduce(linear.design), *named]))
    mixed = replace(linear.mixed, A=U[None])
    sizes = mean_variances(mixed, fit_variances(mixed, both_starts=True))
    of_every_joint = {component for component, _ in errors.effects.values()}
    called = _SOURCE_NAMES | {component: f"{component} of every joint" for component in of_every_joint}
    for name, size, C in zip((*WHITE_COMPONENTS, *errors.names), sizes, mixed.components[:, 0], strict=True):
        yield called.get(name, name), float(size * (np.trace(C) - np.sum(U * (C @ U))))
    if linear.mixed.fixed is not None:
        C = linear.mixed.fixed[0]
        yield "scanner field", float(np.trace(C) - np.sum(U * (C @ U)))


def _unexplained_square(base: Array, numbers: Array) -> float:
    """What no hand-eye explains of numbers (n,), squared."""
    return float(np.sum(project_out(base, numbers[:, None]) ** 2))
