"""What these views can show of an effect: what could do the same, the smallest size that shows, what it does unseen.

Candidates are aliases where what they do correlates, hand-eye and model projected out (`alias_matrix`). An effect that
is too small to be seen would push the hand-eye by what its sigma does not hold (`omitted_effect_bias`), and bend the
scanned surface by what all scans share of it (`unseen_shape_error`).

The smallest size that shows is the one at which both tests in use pass with 80 % probability. An effect of true
parameters θ shifts the squared length of its whitened columns' projection by λ = θᵀIθ. The scatter is known to ν
degrees of freedom only, and takes its share of what the effect does: the test statistic q is non-central F, and the log
evidence ½ ν log(1 + q/ν) in place of ½ q. For one parameter, known scatter and the p-value alone this is |θ| =
(z_{1−α/2K} + z_{power})/√I.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import brentq

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import Score, form_weights
from stitch.model.forward import PointSlopes, moves_points
from stitch.numerics import frames
from stitch.numerics.distributions import f_limit, noncentral_f_tail
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import column_space
from stitch.observations.linear_model import LinearModel
from stitch.session.scan import even_indices

# Views and points of each that show how an effect bends the scans (time).
_SHAPE_VIEWS, _SHAPE_POINTS = 5, 300


def alias_matrix(linear: LinearModel, scores: Sequence[Score]) -> Array:
    """Return the alias matrix (K, K) of K effects: correlation, 0 … 1, of row k's pattern with the column's best one.

    The pattern is that of the fitted effect in the whitened observations, hand-eye and model projected out. The other
    effect imitates it with all its parameters, none beyond ten times its plausible size.
    """
    patterns = []
    for scored in scores:
        white = linear.residual(scored.form.columns)
        if np.any(scored.values):
            patterns.append(white @ scored.values)
        else:
            # Nothing fitted: the most visible combination of plausible size.
            U, s, _ = np.linalg.svd(white * scored.form.sizes, full_matrices=False)
            patterns.append(U[:, 0] * s[0])
    whites = [linear.residual(s.candidate.forms[0].columns) for s in scores]
    matrix = np.eye(len(scores))
    for i, pattern in enumerate(patterns):
        for j, (white, scored) in enumerate(zip(whites, scores, strict=True)):
            if i != j:
                matrix[i, j] = imitated_share(pattern, white * scored.candidate.forms[0].sizes)
    return matrix


def aliases_of(k: int, matrix: Array, scores: Sequence[Score]) -> dict[str, float]:
    """Return up to five effects that look most like candidate k, with their correlation, largest first.

    Args:
        matrix: (K, K) alias matrix (`alias_matrix`).
        scores: of the K candidates, in its order.
    """
    alike = [j for j in np.argsort(-matrix[k]) if j != k and matrix[k, j] > limits.LISTED_ALIAS_CORRELATION]
    return {scores[j].name: float(matrix[k, j]) for j in alike[:5]}


def imitated_share(y: Array, X: Array) -> float:
    """Return the correlation, 0 … 1, of a pattern y (n,) with its best imitation by columns X (n, p).

    The imitation is X (XᵀX + 0.01 I)⁻¹ Xᵀ y, columns scaled to plausible sizes: the ridge keeps coefficients below ten.
    0 for a pattern of zeros, and where there are no columns.
    """
    length = float(np.linalg.norm(y))
    if length == 0 or not X.size:
        return 0.0
    # Ridge at ten plausible sizes: what is invisible cannot be blown up to imitate anything.
    M = X.T @ X + 0.01 * np.eye(X.shape[1])
    fitted = X @ np.linalg.solve(M, X.T @ y)
    fitted_length = float(np.linalg.norm(fitted))
    return float(np.clip(fitted / fitted_length @ (y / length), 0.0, 1.0)) if fitted_length > 0 else 0.0


def hand_eye_response(linear: LinearModel) -> Array:
    """Return a matrix (3, n): whitened observations (n,) to the displacement that they cause by the fitted hand-eye.

    The displacement is that of the middle of what the scanner sees, scanner frame, length_unit. With the whitened
    design X it is [−skew(middle), I] times the first six rows of X⁺.
    """
    middle = np.mean([points.mean(axis=0) for points in linear.measurement.capture.point_sets], axis=0)
    lever = np.hstack([-frames.skew(middle), np.eye(3)])
    # Columns of unit length: the pseudoinverse's threshold then treats all parameters alike.
    length = np.linalg.norm(linear.white_design, axis=0)
    scale = np.where(length > 0, length, 1.0)
    return lever @ (np.linalg.pinv(linear.white_design / scale, rcond=1e-10) / scale[:, None])[:6]


def omitted_effect_bias(
    linear: LinearModel, response: Array, candidate: Candidate, detectable: dict[str, float]
) -> float | None:
    """Return how far an effect that is left out of the model could displace the scanned points, length_unit.

    Each parameter in turn is assumed at its smallest detectable size, but at most at its plausible one, and the
    hand-eye takes up of it what generalised least squares gives. The largest displacement of the middle of the
    scanner's field counts. None if these views cannot detect any parameter.

    Args:
        response: (3, n) of the same linear model (`hand_eye_response`).
        detectable: smallest detectable size by parameter (`detectable_sizes`).
    """
    displacements = []
    for form in candidate.forms:
        for p, moved in zip(form.free, (response @ linear.whiten(form.columns)).T, strict=True):
            if np.isfinite(detectable.get(p.name, np.inf)):
                displacements.append(min(detectable[p.name], p.typical) * float(np.linalg.norm(moved)))
    return max(displacements, default=None)


def unseen_shape_error(linear: LinearModel, candidate: Candidate, detectable: dict[str, float]) -> float | None:
    """Return how far an effect of the points may bend the scanned surface without showing: rms along normals.

    Scans with the same error agree, and the error becomes the surface. A rigid motion of each view is no bend, and is
    projected out. The result, length_unit, is that of the parameter that bends most. None for effects of poses, for
    empirical shapes, and without clouds.

    Args:
        detectable: smallest detectable size by parameter; where there is none, the plausible size stands in.
    """
    measurement = linear.measurement
    term = candidate.forms[0].term
    if candidate.empirical or not moves_points([term]) or not measurement.capture.scans:
        return None
    slopes = PointSlopes(measurement, [term], linear.model)
    poses = measurement.capture.poses(linear.model.T_mount)
    squares = []
    for v in even_indices(len(poses), _SHAPE_VIEWS):
        scan = measurement.capture.scans[v]
        index = even_indices(len(scan.points), _SHAPE_POINTS)
        points, normals = scan.points[index], scan.normals[index]
        along = slopes.along(v, poses[v], index, normals).T
        moves = column_space(np.hstack([np.cross(points, normals), normals]))
        squares.append(np.mean((along - moves @ (moves.T @ along)) ** 2, axis=0))
    sizes = [size if np.isfinite(size := detectable.get(p.name, np.inf)) else p.typical for p in term.parameters]
    return float(np.max(np.sqrt(np.mean(squares, axis=0)) * sizes))


def least_noncentrality(
    white: Array, weight: float, tests: int, degrees_of_freedom: float, scales: Mapping[float, float]
) -> float:
    """Return the least noncentrality λ = θᵀIθ at which an effect is detected with probability `POWER`.

    θ are the true parameters, I their information. The F statistic has to pass a limit: that of the p-value or that of
    the Bayes factor, whichever is larger. inf where the columns show nothing, or where the limit is out of reach.

    Args:
        white: (n, p) whitened columns at their plausible sizes.
        weight: share of the candidate's prior that this form has.
        tests: number of candidates.
        degrees_of_freedom: of the scatter along the columns.
        scales: multiples of the plausible sizes that the prior allows, with their shares.
    """
    information = np.linalg.eigvalsh(white.T @ white)
    rank = int((information > 1e-2).sum())
    if rank == 0:
        return float("inf")
    by_p = rank * f_limit(limits.ALPHA_NAME * weight / max(tests, 1), rank, max(degrees_of_freedom, 1.0))
    factor = limits.LOG_BAYES_FACTOR - float(np.log(weight))
    by_factor = [
        _squares_for(factor - float(np.log(share)), scale**2 * information.clip(0), degrees_of_freedom)
        for scale, share in scales.items()
    ]
    needed = max(by_p, min(by_factor))
    if needed > limits.UNDETECTABLE_SQUARE:
        return float("inf")

    def excess_power(noncentrality: float) -> float:
        """Return the power of the test less the one that is asked for."""
        return noncentral_f_tail(needed / rank, rank, degrees_of_freedom, noncentrality) - limits.POWER

    # From below: the series of the distribution fails far beyond what is needed.
    enough = needed + 10.0
    while excess_power(enough) < 0:
        enough *= 1.5
    return float(brentq(excess_power, 1e-9, enough))


def _squares_for(factor: float, information: Array, degrees_of_freedom: float) -> float:
    """Return the squared length q of the whitened projection at which a form reaches a log Bayes factor.

    With information k_i, log BF = s · ½ ν log(1 + q/ν) − ½ Σ log(1 + k_i), which is solved for q. The prior shrinks the
    fit: s (`kept`) is the share that is left, the mean of k_i / (1 + k_i) weighted by k_i.

    Args:
        factor: log Bayes factor.
        information: (p,) eigenvalues, parameters in units of their prior's sigma.
        degrees_of_freedom: ν of the scatter.
    """
    kept = float(np.sum(information**2 / (1 + information)) / max(float(information.sum()), 1e-300))
    charged = (factor + 0.5 * float(np.log1p(information).sum())) / max(kept, 1e-3)
    return degrees_of_freedom * float(np.expm1(min(2 * charged / degrees_of_freedom, 500.0)))


def detectable_sizes(linear: LinearModel, candidate: Candidate, tests: int) -> dict[str, float]:
    """Return the smallest detectable size by parameter of a candidate, if that parameter alone is not zero.

    It is √(λ/I), with the least noncentrality λ and the parameter's information I. Of several forms the one counts that
    shows it best. The candidate's own random effects are taken out of the model first.

    Args:
        tests: number of candidates among which one would be named.
    """
    linear = linear.without([candidate.name])
    scatter, scales = linear.satterthwaite, regime_of(linear).scales
    has_singles = any(form.keep.sum() == 1 for form in candidate.forms)
    weights = iter(form_weights(candidate).tolist())
    # By parameter, and by the parameters that a form has free, the sizes in each such form.
    sizes: dict[str, dict[tuple[str, ...], list[float]]] = {}
    for of_term in candidate.forms_by_term:
        # All columns of the term, whitened, and the degrees of freedom of the scatter along each.
        whole = linear.residual(of_term[0].reduced)
        degrees_alone = scatter.of_each(linear.in_blocks(whole)) if has_singles else None
        for form in of_term:
            white = whole[:, form.keep]
            if degrees_alone is not None and form.keep.sum() == 1:
                degrees = float(degrees_alone[form.keep][0])
            else:
                degrees = scatter.degrees_of_freedom(linear.in_blocks(white))
            least = least_noncentrality(white * form.sizes, next(weights), tests, degrees, scales)
            names = tuple(p.name for p in form.free)
            for name, length in zip(names, np.linalg.norm(white, axis=0), strict=True):
                size = float(np.sqrt(least) / length) if length > 0 else float("inf")
                sizes.setdefault(name, {}).setdefault(names, []).append(size)
    # Forms of the same parameters differ in when something happened: any of them could be true.
    return {name: min(float(np.median(of_form)) for of_form in forms.values()) for name, forms in sizes.items()}
