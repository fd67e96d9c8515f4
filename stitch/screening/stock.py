"""Whether a view that stands off is displaced, or shows a surface that stands off: stock, or the scanner's zero.

A wrong pose moves all points of a view by one rigid motion. Stock on a casting, or a scanner whose zero has moved, sets
points off along their own normals, all of them or those of one part of the surface, and leaves the pose alone. A view
is held against the others, matched without it and held by what robot and overlaps say of them, so that nothing of its
stock is in what it is measured by: views that are freed from the robot bend along what their overlaps hardly hold, and
take up much of it. With e the distances of its points from the surface of the others, all poses free under the
scatter that the others show, the hand-eye free too:

    displaced   e = B δ + noise, the view at any pose;
    stock       e = B δ + a·s·cos + noise, its pose as near to the robot's as poses scatter, s = 1 where it has stock.

Where all poses are read late, or an arm is poor, the surface of the others is known no better than their poses scatter:
stock that is thinner than three times that is left to the poses.

Stock has a size and a place: the whole view, or the region in which the median distance about a point is nearer to a
than to none. Points at its edge count for neither side. It is said where it explains distances that no motion does.
The scale of the kernel is halved from that of all that is off to that of noise (graduated non-convexity, Blake and
Zisserman 1987), so that no explanation ends beside its own best one. Neighbouring distances share points, normals and
the scanner's own errors: sums over patches of the surface say how much less they tell than independent ones (a
sandwich, Liang and Zeger 1986, Biometrika 73:13).
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.fusion.correspondence_weights import OffsetSums
from stitch.fusion.register import prior_precision, with_free_mean
from stitch.fusion.support import cell_numbers
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.distributions import mad_sigma, tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import symmetric_inverse
from stitch.numerics.units import length_text
from stitch.observations.pose_errors import usual_twist
from stitch.observations.surfaces.field_error import field_error
from stitch.observations.surfaces.hand_eye_fit import Repeatability, hand_eye_jacobian, repeatability_from
from stitch.observations.surfaces.matching import Match, match_pairs, sample_points
from stitch.observations.surfaces.normal_equations import assemble
from stitch.observations.surfaces.scanner_errors import SCALE_SIGMA
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.screening.hypotheses import problem
from stitch.screening.plausibility import scatters_beyond_effects
from stitch.screening.problems import SessionProblem
from stitch.screening.snooping import Snooping
from stitch.screening.view_model import view_model
from stitch.session.capture import Capture
from stitch.session.measurement import measurement_of
from stitch.session.scan import Scan, Stock
from stitch.session.session import SessionData

# Points of a view that are asked, and the fewest distances that say anything; views that say where it belongs.
_SAMPLES, _FEWEST, _FEWEST_VIEWS, _MOST_VIEWS = 1000, 100, 4, 30
# Distances about a point that say whether it has stock, and those among which a region has no edge.
_NEIGHBOURS, _AROUND, _PURE = 25, 60, 0.02
# Steps of each fit, shares of the kernel's scale and of sigma by which one moves a view before the scale is halved and
# before the fit ends, and patches along a view.
_STEPS, _TORN_STEPS, _NEAR, _CONVERGED, _PATCHES = 40, 20, 0.5, 0.02, 6
# Stock of fewer sigmas of a single distance, of its own uncertainty or of the poses is none; nor on less of a surface.
_LEAST, _SURE, _TIMES_SCATTER, _LEAST_SHARE = 1.5, 5.0, 3.0, 0.05
# Nats by which stock explains more than any motion does, and than none (20,000 to 1), and than a torn scan (150 to 1).
# Share of distances that are of no surface.
_MARGIN, _OVER_TORN, _STRAY = 10.0, 5.0, 0.02
# Eleven views hardly say how poses scatter: by half of what is usual at the least.
_LEAST_SCATTER = 0.5
# Neighbouring distances share points, normals and the scanner's own errors: so many of a region are worth one.
_ALIKE = 3.0
# Of two scales of scanners, in sigmas of one: four of their difference.
_SCALES_APART = 4 * np.sqrt(2)
# Where more of the views stand off, no other says what their surface is.
_MOST_OFF = 1 / 3
# Level at which the scanner's errors, the same in all views, are unusual.
_UNUSUAL = 0.01
# Views that are asked: those whose overlaps keep a shape (in sigma of a distance, and in what
# other views keep), those that an offset of the whole view would help by so many sigmas; no more than so many.
_SHAPE, _TIMES_USUAL, _OFFSET, _MOST_ASKED = 0.5, 2.0, 4.0, 4


def find_stock(session: SessionData, snooping: Snooping) -> Mapping[int, Stock | None]:
    """Return the stock of the view that shows it most clearly, by its number; {} where none does.

    The caller takes it off and asks again. If the scanner has unusual errors over its field, or stock was found on too
    many views, it was no stock: then the result is None for each view from which it was taken, to be given back.
    """
    capture, T_mount = snooping.capture, snooping.T_mount
    unconstrained = snooping.unconstrained
    scatter = repeatability_from(snooping.blunder_search.fit.variances)
    off = sorted({m.view for m in (*snooping.misplaced, *snooping.suspected)})
    most = _MOST_OFF * len(capture.scans)
    few = len(capture.scans) - len(off) <= _FEWEST_VIEWS or len(off) > most
    if capture.none_has_stock or few or scatters_beyond_effects(session, snooping):
        return {}
    taken = [v for v, scan in enumerate(capture.scans) if scan.stock is not None]
    for view in _views_that_may_have_stock(capture, T_mount, unconstrained, scatter):
        rest = [v for v in off if v != view]
        stock = stock_of(capture, T_mount, unconstrained.overlaps.gate, view, rest, usual_twist(session.length_unit))
        if stock is not None and abs(stock.thickness) > _between_scanners(capture, view):
            # Without this stock, so that it does not count as an error of the scanner.
            bare = capture.without_stock({view: stock})
            freed = unconstrained_poses(bare, bare.poses(T_mount), unconstrained.overlaps.gate)
            error = field_error(measurement_of(session, bare), Model(T_mount), freed, _UNUSUAL)
            return dict.fromkeys(taken) if error.rms or len(taken) + 1 > most else {view: stock}
    return {}


def _between_scanners(capture: Capture, view: int) -> float:
    """Return how far scanners of another scale put a surface off, length_unit: no stock is told from that."""
    if capture.scanner is None:
        return 0.0
    return _SCALES_APART * SCALE_SIGMA * float(np.median(np.linalg.norm(capture.scans[view].points, axis=1)))


def stock_problems(session: SessionData, capture: Capture) -> Iterator[SessionProblem]:
    """Yield what to say of every scan from which stock was taken."""
    unit = session.length_unit
    for name, scan in zip(session.names, capture.scans, strict=False):
        if scan.stock is not None:
            everywhere = scan.stock.share > 1 - _LEAST_SHARE
            yield problem(
                "stock",
                [name],
                certain=False,
                view=name,
                where="everywhere" if everywhere else f"on {scan.stock.share:.0%} of it",
                size=length_text(abs(scan.stock.thickness), unit, 3),
                U=length_text(2 * scan.stock.sigma, unit, 2),
                side="outside" if scan.stock.thickness > 0 else "inside",
            )


def locate_stock(
    session: SessionData, capture: Capture, T_mount: Array, gate: float, stock: Mapping[int, Stock]
) -> dict[int, Stock]:
    """Return the stock of some views with the points that have it, found again; thickness and sigma are kept.

    Where it is not found again, all points of the view have it.

    Args:
        T_mount: (4, 4) hand-eye that was fitted.
        gate: largest distance between corresponding points, length_unit.
        stock: by view, with thickness and sigma known, and no points.
    """
    located = dict[int, Stock]()
    for view, known in stock.items():
        later = set(stock) - {view, *located}
        usual = usual_twist(session.length_unit)
        found = stock_of(capture.without_stock(located), T_mount, gate, view, later, usual)
        points = np.ones(len(capture.scans[view].points), bool) if found is None else found.points
        located[view] = replace(known, points=points)
    return located


def _views_that_may_have_stock(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, scatter: Repeatability
) -> list[int]:
    """Return the views that may have stock, the likeliest first, `_MOST_ASKED` at most.

    A view may if its residuals keep a shape, more than in other views, or if an offset of its whole surface is
    significant. Views from which stock was taken already are left out.
    """
    shape = _shape_left(capture, unconstrained)
    offset = _whole_offsets(capture, T_mount, unconstrained, scatter)
    least = max(_SHAPE, _TIMES_USUAL * float(np.median(shape)))
    likely = {v: max(shape[v] / least, offset[v] / _OFFSET) for v in range(len(shape))}
    possible = [v for v in likely if likely[v] > 1 and capture.scans[v].stock is None]
    return sorted(possible, key=lambda v: -likely[v])[:_MOST_ASKED]


def _shape_left(capture: Capture, unconstrained: UnconstrainedPoses) -> Array:
    """Return per view (V,) the rms over patches of its surface of their median residual, in sigma of one residual."""
    # Each match counts for both of its views, with the residual's sign as either sees it.
    sides = list[list[Match]]([] for _ in capture.scans)
    for m in unconstrained.overlaps.matches:
        sides[m.v].append(m)
        sides[m.w].append(m.swapped())
    left = np.zeros(len(sides))
    for v, matches in enumerate(sides):
        if not matches:
            continue
        e = np.concatenate([m.residual for m in matches])
        patch = _patches(capture.scans[v], np.concatenate([m.index_v for m in matches]))
        order = np.argsort(patch, kind="stable")
        parts = np.split(e[order], np.cumsum(np.bincount(patch))[:-1])
        medians = [(len(part), float(np.median(part))) for part in parts if len(part) >= _NEIGHBOURS]
        if medians:
            count, median = np.array(medians).T
            left[v] = np.sqrt(count @ median**2 / count.sum()) / unconstrained.overlaps.gram.scale
    return left


def _whole_offsets(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, scatter: Repeatability
) -> Array:
    """Return per view (V,) by how many sigmas its whole surface is offset along its normals, with all poses free.

    Score test: |c|/√A with c the gradient and A the information of one offset, the twists eliminated. Poses have the
    robot's prior, with the hand-eye free.
    """
    overlaps, g = unconstrained.overlaps, unconstrained.overlaps.gram
    weights = [m.weight * tukey(m.residual, g.scale) for m in overlaps.matches]
    sums = OffsetSums(g, overlaps.matches, weights, capture)
    variance = g.variance * max(scatter.noise_factor, 1.0)
    H, b = assemble(g, ~g.labelled)
    of_hand_eye = hand_eye_jacobian(capture, T_mount, g.centre)
    K = with_free_mean(prior_precision(capture, scatter, g.centre), of_hand_eye)
    H = H / variance + K
    C = sums.coupling.reshape(len(H), -1) / variance
    solved = symmetric_inverse(H) @ np.column_stack([C, b / variance + K @ unconstrained.twists.ravel()])
    A = np.diag(sums.matrix / variance - C.T @ solved[:, :-1])
    c = sums.vector / variance - C.T @ solved[:, -1]
    return np.abs(c) / np.sqrt(np.maximum(A, 1e-9 * A.max()))


def stock_of(
    capture: Capture, T_mount: Array, gate: float, view: int, off: Collection[int], usual: Array
) -> Stock | None:
    """Return the stock that a view shows; None where it shows none.

    It must be thick enough, on enough of the surface, and likelier by `_MARGIN` nats than a displaced view and than
    none, by `_OVER_TORN` than a torn scan.

    Args:
        T_mount: (4, 4) hand-eye to begin with.
        gate: largest distance between corresponding points, length_unit.
        off: views that are off: they are left out.
        usual: (6,) usual rotations (rad) and translations (length_unit) of a flange.
    """
    case = _hold_against_others(capture, T_mount, gate, view, off, usual)
    if case is None:
        return None
    explained = _fit(case, case.held, has_stock=True)
    if explained is None:
        return None
    evidence, stock, over_torn = explained
    if stock.share < _LEAST_SHARE or over_torn < _OVER_TORN:
        return None
    if abs(stock.thickness) < max(_LEAST * case.sigma, _SURE * stock.sigma, _TIMES_SCATTER * case.scatter):
        return None
    rivals = [_fit(case, precision, has_stock=False) for precision in (case.free, case.held)]
    is_clear = evidence > max((fit[0] for fit in rivals if fit is not None), default=-np.inf) + _MARGIN
    return stock if is_clear else None


@dataclass(frozen=True)
class _Case:
    """One of V views, with what the other views and the robot say of where all of them are."""

    capture: Capture
    view: int
    start: Array  # (V, 4, 4) T_reference_scanner: the view by the robot, the others where their overlaps put them
    centre: Array  # (3,) about which twists count, reference frame
    H: Array  # (6V, 6V) of the overlaps of the others, in units of their noise
    b: Array  # (6V,)
    twists: Array  # (6V,) from the robot's poses to `start`
    held: Array  # (6V, 6V) precision of the robot's poses, their mean free
    free: Array  # (6V, 6V) the same, the view itself at any pose
    gate: float  # largest distance between corresponding points, length_unit
    sigma: float  # robust, of a distance, length_unit
    factor: float  # of its variance: distances share points
    scatter: float  # of the robot's poses, length_unit

    def distances(self, x: Array, offset: Array) -> tuple[Indices, Array, Array, Array, Array] | None:
        """Return M distances of the view's points from the surface of the others; None for fewer than `_FEWEST`.

        Args:
            x: (6V,) left twists of the views about `centre` from `start`.
            offset: (N,) shift of the view's points against their normals, length_unit.

        Returns:
            The number of the view's point (M,); its signed distance (M,) along the mean of its normal and the
            surface's, length_unit; the weight (M,) of that; the cosine (M,) between its normal and that mean; the
            change of the distance by twists of all views (M, 6V).
        """
        poses = frames.moved_about(self.centre, x.reshape(-1, 6), self.start)
        scan = self.capture.scans[self.view]
        if offset.any():
            moved = scan.points - offset[:, None] * scan.normals
            scan = replace(scan, points=moved, tree=KDTree(moved, leafsize=16))
        scans = [scan if v == self.view else other for v, other in enumerate(self.capture.scans)]
        samples = [sample_points(other, _SAMPLES) for other in scans]
        pairs = [(self.view, w) for w in range(len(scans)) if w != self.view]
        matches = match_pairs(scans, poses, pairs, self.gate, samples)[0]
        if sum(len(m.residual) for m in matches) < _FEWEST:
            return None
        columns = zip(*(m.columns for m in matches), strict=True)
        midpoint, normal, distance, weight, index, _ = (np.concatenate(column) for column in columns)
        view_rows = frames.plane_rows(midpoint - self.centre, normal)
        partner = np.repeat([m.w for m in matches], [len(m.residual) for m in matches])
        rows = np.zeros((len(distance), len(poses), 6))
        rows[:, self.view] = view_rows
        rows[np.arange(len(distance)), partner] -= view_rows
        cosine = np.einsum("ni,ni->n", frames.rotate(poses[self.view], scan.normals[index]), normal)
        return index, distance, weight, cosine, rows.reshape(len(distance), -1)


def _hold_against_others(
    capture: Capture, T_mount: Array, gate: float, view: int, off: Collection[int], usual: Array
) -> _Case | None:
    """Return the case of one view against the others: their normal equations, the robot's prior, noise and scatter.

    The other views are moved by their overlaps alone, without this view, and their scatter is estimated. The case is
    linear about these poses, and that of the robot for the view; it numbers the views among the nearest `_MOST_VIEWS`,
    which count. In its prior `held` the robot says where all views are, in `free` where the others are. None where
    fewer than `_FEWEST_VIEWS` others are left.

    Args:
        T_mount: (4, 4) hand-eye to begin with.
        gate: largest distance between corresponding points, length_unit.
        off: views that are off: they are left out.
        usual: (6,) usual rotations (rad) and translations (length_unit) of a flange: the scatter is no less than a
            share of it.
    """
    kept = _views_to_compare(capture, T_mount, view, off)
    if len(kept) - 1 < _FEWEST_VIEWS:
        return None
    poses = capture.poses(T_mount)[kept]
    capture = capture.without(np.setdiff1d(np.arange(len(capture.scans)), kept))
    view = int(np.searchsorted(kept, view))
    others = np.delete(np.arange(len(kept)), view)
    rest = capture.without(np.array([view]))
    unconstrained = unconstrained_poses(rest, poses[others], gate)
    g = unconstrained.overlaps.gram
    variances = view_model(rest, T_mount, unconstrained).fit().variances
    rotation, translation = np.maximum(np.sqrt(variances[:2]), _LEAST_SCATTER * usual[[0, 3]]).tolist()
    factor = max(float(variances[2]), 1.0)
    # The others' normal equations among those of all views: the view itself has zeros.
    count = 6 * len(kept)
    rows = (6 * others[:, None] + np.arange(6)).ravel()
    H = np.zeros((count, count))
    b = np.zeros(count)
    twists = np.zeros(count)
    H[np.ix_(rows, rows)], b[rows] = (part / (g.variance * factor) for part in assemble(g))
    twists[rows] = unconstrained.twists.ravel()
    start = np.array(poses)
    start[others] = unconstrained.poses
    # What a correction of the hand-eye does to all views stays free.
    of_hand_eye = hand_eye_jacobian(capture, T_mount, g.centre)
    precision = prior_precision(capture, Repeatability(rotation, translation, factor), g.centre)
    without_view = precision.copy()
    without_view[view] = 0.0
    return _Case(
        capture,
        view,
        start,
        g.centre,
        H,
        b,
        twists,
        held=with_free_mean(precision, of_hand_eye),
        free=with_free_mean(without_view, of_hand_eye),
        gate=unconstrained.overlaps.gate,
        sigma=g.scale,
        factor=factor,
        scatter=translation,
    )


def _views_to_compare(capture: Capture, T_mount: Array, view: int, off: Collection[int]) -> Indices:
    """Return the sorted numbers of a view and of the `_MOST_VIEWS` − 1 views nearest to it, without those that are off.

    Args:
        T_mount: (4, 4) hand-eye that places the scans.
        off: views that are left out; `view` itself stays.
    """
    centroids = np.array([[scan.points.mean(axis=0)] for scan in capture.scans])
    placed = frames.transform(capture.poses(T_mount), centroids)[:, 0]
    nearest = np.argsort(np.linalg.norm(placed - placed[view], axis=1), kind="stable")[:_MOST_VIEWS]
    return np.union1d(np.setdiff1d(nearest, list(off)), [view]).astype(np.int64)


def _fit(case: _Case, precision: Array, has_stock: bool) -> tuple[float, Stock, float] | None:
    """Return one explanation of a view's distances, fitted with all poses; None where too few distances remain.

    Without stock the view is displaced, or stays where the robot has it: `precision` says how the robot holds the
    poses. With stock a thickness on the view, or on a region of it, is fitted too. Each step matches anew, finds the
    region, and takes a Gauss–Newton step of twists and thickness; the scale of the robust weights is halved from that
    of all distances to that of noise.

    Args:
        precision: (6V, 6V) of the poses by the robot, `case.held` or `case.free`.

    Returns:
        The log likelihood of distances and poses, nats; the stock, of thickness 0 without; and the nats by which stock
        on its region is likelier than a motion of that region, infinite without one.
    """
    # The start: minimum of the others' normal equations with the robot's prior.
    x = -symmetric_inverse(case.H + case.held) @ (case.b + case.held @ case.twists)
    thickness, scale = 0.0, np.inf
    scan = case.capture.scans[case.view]
    points = np.zeros(len(scan.points), bool)
    for _ in range(_STEPS):
        observed = case.distances(x, thickness * points)
        if observed is None:
            return None
        index, from_surface, weight, cosine, by_twists = observed
        # Distances of the points where the scan has them, its stock not taken off.
        distance = from_surface + thickness * cosine * points[index]
        member, edge = np.zeros((2, len(distance)), bool)
        if has_stock:
            thickness, member, edge = _region(scan.points[index], distance, thickness, case.sigma)
        if member.any():
            points = member[KDTree(scan.points[index]).query(scan.points)[1]]
        rows = np.column_stack([by_twists, -cosine * member])
        residual = distance + thickness * rows[:, -1]
        scale = max(case.sigma, min(scale, mad_sigma(residual)))
        robust_weight = weight * tukey(residual, scale) * ~edge / (case.sigma**2 * case.factor)
        change, information, gradients = _gauss_newton_step(case, precision, x, rows, residual, robust_weight)
        x = x + change[:-1]
        thickness += float(change[-1])
        largest_change = max(np.abs(change[:-1].reshape(-1, 6)[:, 3:]).max(), abs(change[-1]))
        if scale == case.sigma and largest_change < _CONVERGED * case.sigma:
            break
        if largest_change < _NEAR * scale:
            scale /= 2
    inside = member & ~edge
    if has_stock and not robust_weight[inside].any():
        # No region is left, or robust weights reject all of it.
        return None
    over_torn = np.inf
    if inside.any():
        over_torn = _over_torn(case, rows[inside], distance[inside], residual[inside], weight[inside])
    t = case.twists + x
    pose_cost = 0.5 * float(t @ precision @ t + x @ case.H @ x) + float(case.b @ x)
    sigma = _thickness_sigma(case, precision, information, gradients, index)
    stock = Stock(thickness, sigma, float(scan.area[points].sum() / scan.area.sum()), points)
    return _evidence(case, residual, weight) - pose_cost, stock, over_torn


def _gauss_newton_step(
    case: _Case, precision: Array, x: Array, rows: Array, residual: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Return one Gauss–Newton step (6V + 1,) of the twists and the thickness, with the sums that lead to it.

    The cost is that of the weighted residuals, of the others' overlaps, and of the poses under the robot's prior.

    Args:
        precision: (6V, 6V) of the poses by the robot.
        x: (6V,) twists so far.
        rows: (M, 6V + 1) change of the residuals by twists and thickness.
        residual, weight: (M,) each; weights in 1/length_unit².

    Returns:
        The step; the information (6V + 1, 6V + 1); and the gradient of each residual's share of the cost, (M, 6V + 1).
    """
    information = (rows.T * weight) @ rows
    information[:-1, :-1] += case.H + precision
    gradients = rows * (weight * residual)[:, None]
    gradient = gradients.sum(axis=0)
    gradient[:-1] += case.b + case.H @ x + precision @ (case.twists + x)
    return -symmetric_inverse(information) @ gradient, information, gradients


def _thickness_sigma(case: _Case, precision: Array, information: Array, gradients: Array, index: Indices) -> float:
    """Return the standard error of a fitted thickness: of a sandwich, but no less than by the normal equations.

    Distances within a patch err together: the thickness varies by the summed gradient of each patch.

    Args:
        precision: (6V, 6V) of the poses by the robot.
        information: (6V + 1, 6V + 1) of twists and thickness, the last.
        gradients: (M, 6V + 1) of each distance's share of the cost.
        index: (M,) number of the view's point of each distance.
    """
    of_patches = np.zeros_like(gradients)
    np.add.at(of_patches, _patches(case.capture.scans[case.view], index), gradients)
    gain = symmetric_inverse(information)[-1]
    variance = gain[:-1] @ (case.H + precision) @ gain[:-1] + np.sum((of_patches @ gain) ** 2)
    return float(np.sqrt(max(variance, gain[-1])))


def _evidence(case: _Case, left: Array, weight: Array) -> float:
    """Return the log likelihood (nats) of residuals (M,), as normal errors with a share of strays, over strays alone.

    Strays are uniform within the gate; `factor` counts correlated distances as fewer.

    Args:
        left: (M,) residual distances, length_unit.
        weight: (M,) of these.
    """
    normal = np.exp(-0.5 * (left / case.sigma) ** 2) / (np.sqrt(2 * np.pi) * case.sigma)
    likelier = np.log1p((1 - _STRAY) / _STRAY * 2 * case.gate * normal)
    return float(likelier @ weight / weight.mean() / case.factor)


def _over_torn(case: _Case, rows: Array, e: Array, left: Array, weight: Array) -> float:
    """Return the log evidence (nats) of stock on a region over a rigid motion of that region alone, as in a torn scan.

    It is the gain in log likelihood plus (6 − 1)/2 · log n, for the five parameters that a motion has more (Schwarz
    1978, Ann. Stat. 6:461). n counts correlated distances as fewer.

    Args:
        rows: (M, 6V + 1) change of the region's distances by twists of the views and the thickness.
        e: (M,) its distances from the other views, length_unit.
        left: (M,) residuals of these with stock.
        weight: (M,) of these.
    """
    rows = rows[:, 6 * case.view : 6 * case.view + 6]
    # Residuals with a motion: robust least squares, reweighted from those with stock.
    moved = left
    for _ in range(_TORN_STEPS):
        weighted = rows.T * (weight * tukey(moved, case.sigma))
        moved = e - rows @ symmetric_inverse(weighted @ rows) @ (weighted @ e)
    gain = (_evidence(case, left, weight) - _evidence(case, moved, weight)) * case.factor / _ALIKE
    return gain + (6 - 1) / 2 * float(np.log(max(len(e) / _ALIKE, 1.0)))


def _region(places: Array, e: Array, thickness: float, sigma: float) -> tuple[float, Mask, Mask]:
    """Return the thickness of stock, and two masks (M,): distances in the region that has it, and those at its edge.

    In the region the median distance of the neighbours is nearer to the thickness than to zero; two rounds of majority
    among neighbours smooth it. At the edge neighbours are mixed.

    Args:
        places: (M, 3) of the view's points.
        e: (M,) signed distances from the others, length_unit.
        thickness: from the last step; 0: not known yet, then it is the median of the smoothed distances beyond 2 sigma.
        sigma: robust, of one distance, length_unit.
    """
    around = KDTree(places).query(places, k=min(_AROUND, len(places)))[1].astype(np.int64)
    smooth = np.median(e[around[:, :_NEIGHBOURS]], axis=1)
    if not thickness:
        off = smooth[np.abs(smooth) > 2 * sigma]
        thickness = float(np.median(off)) if len(off) > _LEAST_SHARE * len(e) else 0.0
    member = smooth * np.sign(thickness) > abs(thickness) / 2 if thickness else np.zeros(len(e), bool)
    for _ in range(2):
        member = member[around].mean(axis=1) > 0.5
    mixed = member[around].mean(axis=1)
    return thickness, member, (mixed > _PURE) & (mixed < 1 - _PURE)


def _patches(scan: Scan, index: Indices) -> Indices:
    """Return (M,) numbers of the patches of a scan in which some of its points lie."""
    edge = float(np.ptp(scan.box, axis=0).max()) / _PATCHES
    return np.unique(cell_numbers(scan.points.take(index, axis=0) - scan.box[0], edge), return_inverse=True)[1]
