"""What a model leaves: on what it depends, from which sources it comes, what a candidate would leave of it.

`dependences` says of every covariate how much of the views' unexplained scatter follows it, with the shape as binned
means. `variance_budget` shares out what the poses leave by source: effects in use, what is named, an unmodelled trend,
smooth errors, wandering, white scatter, noise. `predicted_distances` says correspondence by correspondence what a
candidate effect would leave between the surfaces.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.ranking import Ranked, rank_all
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.smooth_processes import FittedProcess
from stitch.diagnosis.thresholds import ALPHA_UNKNOWN, DEPENDENCE_BINS, ODDS
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
from stitch.observations.surfaces.matching import signed_distances
from stitch.observations.surfaces.scanner_errors import field_scatter
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.session.measurement import Views

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
    if best is None or best.name != FIELD or best.adjusted >= ALPHA_UNKNOWN:
        return False
    others = [r.score.log_bayes_factor for r in empirical[1:2]] + [error.log_bayes_factor for error in repeating]
    return bool(best.score.log_bayes_factor > max([0.0, *others]) + ODDS)


@dataclass(frozen=True)
class Dependence:
    """One covariate; bins, mean and sigma show the shape along the direction that follows it most."""

    covariate: str
    score: float  # share of the views' unexplained scatter that follows it, 0 … 1
    p_value: float  # family-wise over all covariates and shapes
    bins: Array  # (B,) middle of each bin
    mean: Array  # (B,) displacement at the part, length_unit
    sigma: Array  # (B,)
    shape: str  # the empirical form that fits best, in words
    at: Array  # (V,) the covariate of every view
    moved: Array  # (V,) displacement of every view along that direction, length_unit


def dependences(linear: LinearModel, empirical: Sequence[Ranked]) -> list[Dependence]:
    """Return the best empirical form of every covariate, clearest first.

    Over scatter alone: what follows a covariate may also be an error of the poses that repeats; this says where it is.
    """
    if linear.pose_errors is not None:
        linear = linear.restricted(())
        empirical = rank_all(linear, [r.score.candidate for r in empirical])[1]
    views = linear.measurement.views
    best: dict[str, Ranked] = {}
    for r in empirical:
        group = r.score.candidate.effect.group
        if group not in best or r.score.log_bayes_factor > best[group].score.log_bayes_factor:
            best[group] = r
    shown = [
        _dependence(linear, r, values)
        for name, r in best.items()
        if (values := covariate_values(views, name)) is not None
    ]
    return sorted(shown, key=lambda d: (d.p_value, -d.score))


def covariate_values(views: Views, name: str) -> Array | None:
    """Return (V,) values of a covariate, a joint angle in degrees, the time, or the order of the views for an event."""
    if name == "time_s":
        return views.time
    if name == "an event":
        return np.arange(views.count, dtype=float)
    if joint := re.fullmatch(r"j(\d+)_deg", name):
        return np.degrees(views.joints[:, int(joint[1]) - 1])
    return views.covariates.get(name)


def _dependence(linear: LinearModel, ranked: Ranked, values: Array) -> Dependence:
    """Return how the views' displacements follow values (V,) of a covariate."""
    scored = ranked.score
    basis, s, _ = np.linalg.svd(linear.residual(scored.form.columns), full_matrices=False)
    basis = basis[:, s > 1e-9 * max(float(s[0]), 1e-300)]
    white = linear.white_residual
    share = float(np.sum((basis.T @ white) ** 2) / max(float(np.sum(white**2)), 1e-300))
    displacement = linear.view_displacements()
    # The direction in which the displacements follow the fitted shape most.
    fitted = linear.observation.part_displacements(scored.form.columns @ scored.values)
    direction = np.linalg.svd(fitted, full_matrices=False)[2][0]
    # Towards where the views lie off most: one step points the same way along everything that it follows.
    main = np.linalg.svd(displacement, full_matrices=False)[2][0]
    main *= 1.0 if (displacement @ main)[len(displacement) // 2 :].sum() >= 0 else -1.0
    direction *= 1.0 if direction @ main >= 0 else -1.0
    moved = displacement @ direction
    centres, mean, sigma = bin_means(values, moved)
    effect = scored.candidate.effect
    return Dependence(
        covariate=effect.group if effect.group != "an event" else "view order",
        score=share,
        p_value=ranked.adjusted,
        bins=centres,
        mean=mean,
        sigma=sigma,
        shape=effect.formula,
        at=values,
        moved=moved,
    )


def bin_means(x: Array, y: Array, bins: int = DEPENDENCE_BINS) -> tuple[Array, Array, Array]:
    """Return middle, mean and standard error of y in bins of x with equal counts; views are the samples."""
    order = np.argsort(x, kind="stable")
    parts = [p for p in np.array_split(order, min(bins, max(len(x) // 2, 1))) if len(p)]
    spread = float(np.std(y, ddof=1)) if len(y) > 1 else 0.0
    middle = np.array([x[p].mean() for p in parts])
    mean = np.array([y[p].mean() for p in parts])
    sigma = np.array([(np.std(y[p], ddof=1) if len(p) > 2 else spread) / np.sqrt(len(p)) for p in parts])
    return middle, mean, sigma


def predicted_distances(linear: LinearModel, scored: Score | None = None) -> Array | None:
    """Return (M,) signed distances of all correspondences under the model, and the best form of a candidate with it.

    In the linear approximation, hand-eye and effects in use fitted anew beside the candidate, as `add` fits them: poses
    scatter independently. Beside all that an arm may do the hand-eye may lie far off, and what the arm then does is in
    no prediction. The candidate is scored anew for that: another of its forms may explain most where poses scatter
    independently than beside all that an arm may do, and that one `add` reaches.

    In the order of the matches of the free network. None without clouds.
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
    matches, centre, of_views = overlaps.matches, overlaps.gram.centre, twists.reshape(-1, 6)
    # B(δ_v − δ_w) of the normal equations, not by moving the views: where hand-eye and links can stand in for one
    # another, both move far and their common motion alone counts.
    along = [frames.plane_rows(m.middle - centre, m.normal) @ (of_views[m.v] - of_views[m.w]) for m in matches]
    return signed_distances(matches, poses, points) + np.concatenate(along)
