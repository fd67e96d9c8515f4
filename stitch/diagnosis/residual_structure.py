"""What a model leaves: on what it depends, from which sources it comes, what a candidate would leave of it.

`variance_budget` shares out what the poses leave by source: effects in use, what is named, an unmodelled trend,
smooth errors, wandering, white scatter, noise. `predicted_distances` says correspondence by correspondence what a
candidate effect would leave between the surfaces.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.smooth_processes import FittedProcess
from stitch.diagnosis.thresholds import ALPHA_UNKNOWN, ODDS
from stitch.diagnosis.unmodelled_time_effects import RepeatingError
from stitch.effects.empirical import FIELD
from stitch.model.forward import moves_points, scan_correction
from stitch.model.model import Term
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import column_space, project_out
from stitch.numerics.reml import fit_variances
from stitch.numerics.variance_posterior import mean_variances
from stitch.observations.linear_model import WHITE_COMPONENTS, LinearModel
from stitch.observations.pose_errors import DRIFT_MEMORY, JOINT_SCATTER
from stitch.observations.surfaces.matching import Match, signed_distances
from stitch.observations.surfaces.scanner_errors import field_scatter
from stitch.observations.surfaces.surface_model import surfaces_of

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
    linear: LinearModel, named: Sequence[Score] = (), trend: FittedProcess | None = None
) -> tuple[BudgetLine, ...]:
    """Return the sources of the views' pose errors with their shares of the variance, largest first.

    Sources are the effects in the model, those named as missing, a trend in time, and the components of what remains.
    The share of a source is that of its sum of squares in the reduced observations, less what the hand-eye can imitate.
    () where pose errors have no prior (many views, labelled points).

    Args:
        named: candidates that are said to be missing.
        trend: of the flange in time, where one is reported; None: none is.
    """
    if linear.pose_errors is None:
        return ()
    surfaces = surfaces_of(linear)
    if linear.mixed.fixed is not None and surfaces is not None:
        # The model holds the scanner's smooth errors at a cautious size; here they have that which the overlaps show.
        field = linear.reduce(field_scatter(surfaces.scanner_errors, surfaces.unconstrained, share=None))
        linear = replace(linear, mixed=replace(linear.mixed, fixed=(field @ field.T)[None]))
    hand_eye = linear.reduce(linear.design[:, :6])
    terms = [term for term in linear.model.terms if not term.is_geometry]
    explained = {
        term.name: linear.reduce(response.columns) @ term.values
        for term, response in zip(terms, linear.responses(terms), strict=True)
    }
    explained |= {scored.name: scored.form.columns @ scored.values for scored in named}
    columns = [scored.form.columns for scored in named]
    if trend is not None:
        explained["one course of time"] = trend.explained
        columns.append(trend.columns)
    squares = {name: float(np.sum(project_out(hand_eye, part[:, None]) ** 2)) for name, part in explained.items()}
    for name, square in _remaining_squares(linear, columns):
        squares[name] = squares.get(name, 0.0) + square
    total = sum(squares.values())
    unit, n = linear.measurement.length_unit, linear.mixed.size
    lines = [
        BudgetLine(source, square / max(total, 1e-300), float(np.sqrt(max(square, 0.0) / n)), unit)
        for source, square in squares.items()
    ]
    return tuple(sorted(lines, key=lambda line: -line.variance_share))


def _remaining_squares(linear: LinearModel, explained: Sequence[Array]) -> list[tuple[str, float]]:
    """Return pairs (source, expected sum of squares) of the variance components in the residual of a fit.

    For a component of variance σ² and covariance C it is σ² tr((I − U Uᵀ) C), U an orthonormal basis of all that is
    fitted: the columns of the model and of `explained`.

    Args:
        explained: matrices (n, p) of the reduced observations that other sources explain.
    """
    errors = linear.pose_errors
    assert errors is not None
    U = column_space(np.hstack([linear.reduce(linear.design), *explained]))
    mixed = replace(linear.mixed, A=U[None])
    sizes = mean_variances(mixed, fit_variances(mixed, both_starts=True))
    of_every_joint = {component for component, _ in errors.effects.values()}
    names = _SOURCE_NAMES | {component: f"{component} of every joint" for component in of_every_joint}
    squares = [
        (names.get(name, name), float(size * (np.trace(C) - np.sum(U * (C @ U)))))
        for name, size, C in zip((*WHITE_COMPONENTS, *errors.names), sizes, mixed.components[:, 0], strict=True)
    ]
    if linear.mixed.fixed is not None:
        C = linear.mixed.fixed[0]
        squares.append(("scanner field", float(np.trace(C) - np.sum(U * (C @ U)))))
    return squares


def follows_field(empirical: Sequence[Ranked], repeating: Sequence[RepeatingError]) -> bool:
    """Return whether an unnamed error over the scanner's field explains the views best, by 20 to 1.

    It must be the first of the empirical shapes, significant, and 20 to 1 likelier than no error, than the next shape
    and than every repeating error of the poses. Such an error is the same in every view, such as axes of unequal scale:
    overlaps show it, and joints, mount or time only seem to cause it.

    Args:
        empirical: shapes without a cause, best first.
        repeating: repeating errors of poses without a name; Bayes factors of both are over the same null model.
    """
    best = next(iter(empirical), None)
    if best is None or best.name.partition("@")[0] != FIELD or best.adjusted >= ALPHA_UNKNOWN:
        return False
    others = [r.score.log_bayes_factor for r in empirical[1:2]] + [error.log_bayes_factor for error in repeating]
    return bool(best.score.log_bayes_factor > max([0.0, *others]) + ODDS)


def predicted_distances(
    linear: LinearModel, scored: Score | None = None, matches: Sequence[Match] | None = None
) -> Array | None:
    """Return signed distances (M,) of all correspondences as predicted with a candidate in the model, length_unit.

    Hand-eye, effects in use and the candidate are fitted together in the linear model, with poses that scatter
    independently, as `add` fits them. The candidate is scored again for that fit: another of its forms may be the best
    there than beside random effects of the arm. None without clouds.

    Args:
        scored: the candidate; None: the model alone.
        matches: correspondences of the same views, whose order is that of the result. None: those of the network of
            overlaps that moved the views without the robot.
    """
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return None
    # Without random effects of the arm: poses scatter independently.
    fitted = linear.restricted(())
    poses = surfaces.capture.poses(fitted.model.T_mount)
    points = [scan.points for scan in surfaces.capture.scans]
    if scored is None:
        twists = fitted.design @ fitted.baseline_trial.solve()
    else:
        scored = scored if fitted is linear else score(fitted, scored.candidate)
        twists, term = _fit_beside_model(fitted, scored)
        if moves_points([term]):
            corrections = (scan_correction(fitted.measurement, [term], v, T, slice(None)) for v, T in enumerate(poses))
            points = [p + correction for p, correction in zip(points, corrections, strict=True)]
    overlaps = surfaces.unconstrained.overlaps
    matches = overlaps.matches if matches is None else matches
    centre, of_views = overlaps.gram.centre, twists.reshape(-1, 6)
    # Distances change by B (δ_v − δ_w), B the rows of the plane distances, δ the twists of the views. The views
    # themselves are not moved: where hand-eye and links imitate each other, both move far, beyond what is linear.
    along = [frames.plane_rows(m.middle - centre, m.normal) @ (of_views[m.v] - of_views[m.w]) for m in matches]
    return signed_distances(matches, poses, points) + np.concatenate(along)


def _fit_beside_model(linear: LinearModel, scored: Score) -> tuple[Array, Term]:
    """Return the twists (6V,) of the views by a fit of hand-eye, effects in use and a candidate, and the fitted effect.

    The twists are left ones about the part's centre, reference frame. Where the candidate moves points of a scan, it
    moves no view as a whole: then they are those by hand-eye and effects in use.
    """
    columns = np.hstack([linear.design, scored.form.response])
    # Sums over the points that the candidate's free parameters move.
    points = scored.candidate.points
    sums = None if points is None else points.select(scored.form.keep)
    solution = linear.trial(columns, sums).solve()
    k = scored.form.response.shape[1]
    term = scored.form.at(solution[-k:])
    if moves_points([term]):
        return columns[:, :-k] @ solution[:-k], term
    return columns @ solution, term
