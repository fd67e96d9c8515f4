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
    """Return shares of what effects in use took away and of what remains, largest first; () where poses have no prior.

    Args:
        named: candidates that are said to be missing: what they explain is theirs.
        trend: of the flange in time, where one is said to be there.
    """
    if linear.pose_errors is None:
        return ()
    surfaces = surfaces_of(linear)
    if linear.mixed.fixed is not None and surfaces is not None:
        # Smooth errors of the scanner as the overlaps show them; an alarm allows for larger ones.
        field = linear.reduce(field_scatter(linear.measurement, surfaces.unconstrained, share=None))
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
        explained["one course of time"] = trend.numbers
        columns.append(trend.columns)
    # Of what no hand-eye explains.
    squares = {name: float(np.sum(project_out(hand_eye, numbers[:, None]) ** 2)) for name, numbers in explained.items()}
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
    """Return sums of squares that each component leaves beside the model and what columns explain."""
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
    """Return whether the scanner's field is the likeliest of all shapes without a cause, 20 to 1 over errors of poses
    that repeat.

    A scanner whose axes are of unequal scale or not at right angles, or with a plane of focus that is bent to one side,
    errs by where in its field a point is seen, by no law of the library: the same in every view, so that overlaps show
    it, and joints, mount or time only seem to have a part in it.

    Args:
        empirical: best first.
        repeating: what poses do again without a name; both are over scatter and what an arm usually errs by.
    """
    best = next(iter(empirical), None)
    if best is None or best.name.partition("@")[0] != FIELD or best.adjusted >= ALPHA_UNKNOWN:
        return False
    others = [r.score.log_bayes_factor for r in empirical[1:2]] + [error.log_bayes_factor for error in repeating]
    return bool(best.score.log_bayes_factor > max([0.0, *others]) + ODDS)


def predicted_distances(
    linear: LinearModel, scored: Score | None = None, matches: Sequence[Match] | None = None
) -> Array | None:
    """Return (M,) signed distances of all correspondences under the model, and the best form of a candidate with it.

    In the linear approximation, hand-eye and effects in use fitted anew beside the candidate, as `add` fits them: poses
    scatter independently. Beside all that an arm may do the hand-eye may lie far off, and what the arm then does is in
    no prediction. The candidate is scored anew for that: another of its forms may explain most where poses scatter
    independently than beside all that an arm may do, and that one `add` reaches.

    In the order of the matches. None without clouds.

    Args:
        matches: of the same views; None: of the free network.
    """
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return None
    fitted = linear.restricted(())
    if scored is not None and fitted is not linear:
        scored = score(fitted, scored.candidate)
    poses = surfaces.capture.poses(fitted.model.T_mount)
    points = [scan.points for scan in surfaces.capture.scans]
    twists = fitted.design @ fitted.baseline_trial.solve()
    if scored is not None:
        X, sums = np.hstack([fitted.design, scored.form.response]), scored.candidate.points
        solution = fitted.trial(X, None if sums is None else sums.select(scored.form.keep)).solve()
        k = scored.form.response.shape[1]
        term = scored.form.at(solution[-k:])
        if moves_points([term]):
            # Such an effect changes the points, and the views only as hand-eye and the others follow.
            twists = X[:, :-k] @ solution[:-k]
            corrections = (scan_correction(fitted.measurement, [term], v, T, slice(None)) for v, T in enumerate(poses))
            points = [p + correction for p, correction in zip(points, corrections, strict=True)]
        else:
            twists = X @ solution
    overlaps = surfaces.unconstrained.overlaps
    matches = overlaps.matches if matches is None else matches
    centre, of_views = overlaps.gram.centre, twists.reshape(-1, 6)
    # B(δ_v − δ_w) of the normal equations, not by moving the views: where hand-eye and links can stand in for one
    # another, both move far and their common motion alone counts.
    along = [frames.plane_rows(m.middle - centre, m.normal) @ (of_views[m.v] - of_views[m.w]) for m in matches]
    return signed_distances(matches, poses, points) + np.concatenate(along)
