"""Whether a view that stands off is displaced, or shows a surface that stands off: stock, or the scanner's zero.

A wrong pose moves all points of a view by one rigid motion. Stock on a casting, or a scanner whose zero has moved, sets
points off along their own normals, all of them or those of one part of the surface, and leaves the pose alone. A view
is held against the others, matched without it and held by what robot and overlaps say of them, so that nothing of its
stock is in what it is measured by: views that are freed from the robot bend along what their overlaps hardly hold, and
take up much of it. With e the distances of its points from the surface of the others, all poses free under the
scatter that the others show, the hand-eye free too:

    displaced   e = B δ + noise, the view at any pose;
    stock       e = B δ + a·s·cos + noise, its pose as near to the robot's as poses scatter, s = 1 where it has stock.

Stock has a size and a place: the whole view, or the region in which the median distance about a point is nearer to a
than to none. Points at its edge count for neither side. It is said where it explains distances that no motion does.
Neighbouring distances share points, normals and the scanner's own errors: sums over patches of the surface say how much
less they tell than independent ones (a sandwich, Liang and Zeger 1986, Biometrika 73:13).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.fusion.correspondence_weights import OffsetSums
from stitch.fusion.register import prior_precision
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.distributions import tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.units import length_text
from stitch.observations.pose_errors import usual_twist
from stitch.observations.surfaces.field_error import field_error
from stitch.observations.surfaces.hand_eye_fit import Repeatability, hand_eye_jacobian, repeatability_from
from stitch.observations.surfaces.matching import Match, match_pairs, sample_points
from stitch.observations.surfaces.normal_equations import assemble
from stitch.observations.surfaces.scanner_errors import SCALE_SIGMA
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.screening.hypotheses import problem
from stitch.screening.problems import SessionProblem
from stitch.screening.snooping import Snooping
from stitch.screening.view_model import view_model
from stitch.session.capture import Capture
from stitch.session.measurement import measurement_of
from stitch.session.scan import Scan, Stock
from stitch.session.session import SessionData

# Points of a view that are asked, and the fewest distances that say anything; views that say where it belongs.
_SAMPLES, _FEWEST, _FEWEST_VIEWS, _MOST_VIEWS = 1000, 100, 4, 60
# Distances about a point that say whether it has stock, and those among which a region has no edge.
_NEIGHBOURS, _AROUND, _PURE = 25, 60, 0.02
# Steps of each fit, the share of sigma by which the last one moves a view, and patches along a view.
_STEPS, _CONVERGED, _PATCHES = 20, 0.02, 6
# Stock of fewer sigmas of a single distance, or of its own uncertainty, is none; nor on less of a view's surface.
_LEAST, _SURE, _LEAST_SHARE = 1.5, 5.0, 0.05
# Nats by which stock explains more than any motion does, and than none (20,000 to 1); by which stock on a region is
# likelier than on the whole view, or than a torn scan (150 to 1). Share of distances that are of no surface.
_MARGIN, _REGION, _STRAY = 10.0, 5.0, 0.02
# Eleven views hardly say how poses scatter: by half of what is usual at the least.
_LEAST_SCATTER = 0.5
# Of two scales of scanners, in sigmas of one: four of their difference.
_SCALES_APART = 4 * np.sqrt(2)
# Where more of the views stand off, no other says what their surface is.
_MOST_OFF = 1 / 3
# Level at which the scanner's errors, the same in all views, are unusual.
_UNUSUAL = 0.01
# Views that are asked: those that stand off, those whose overlaps keep a shape (in sigma of a distance, and in what
# other views keep), those that an offset of the whole view would help by so many sigmas; no more than so many.
_SHAPE, _TIMES_USUAL, _OFFSET, _MOST_ASKED = 0.5, 2.0, 4.0, 4


def find_stock(
    session: SessionData, capture: Capture, T_mount: Array, snooping: Snooping
) -> Mapping[int, Stock | None]:
    """Return the stock of the view that shows it most clearly; {} where none does.

    Where the scanner errs over its field in all views, or too many show it one after the other, it is none: None for
    each from which it was taken.

    Args:
        T_mount: (4, 4) hand-eye under which `snooping` was made.
    """
    unconstrained = snooping.unconstrained
    scatter = repeatability_from(snooping.blunder_search.fit.variances)
    off = sorted({m.view for m in (*snooping.misplaced, *snooping.suspected)})
    most = _MOST_OFF * len(capture.scans)
    if capture.none_has_stock or len(capture.scans) - len(off) <= _FEWEST_VIEWS or len(off) > most:
        return {}
    taken = [v for v, scan in enumerate(capture.scans) if scan.stock is not None]
    for view in _asked(capture, T_mount, unconstrained, scatter, off):
        rest = [v for v in off if v != view]
        stock = stock_of(capture, T_mount, unconstrained.overlaps.gate, view, rest, usual_twist(session.length_unit))
        if stock is not None and abs(stock.thickness) > _between_scanners(capture, view):
            error = field_error(measurement_of(session, capture), Model(T_mount), unconstrained, _UNUSUAL)
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
    """Return the stock of some views, all but its place known, with its points.

    Args:
        T_mount: (4, 4) hand-eye that was fitted.
        gate: distance between partners, length_unit.
    """
    located = dict[int, Stock]()
    for view, known in stock.items():
        later = set(stock) - {view, *located}
        usual = usual_twist(session.length_unit)
        found = stock_of(capture.without_stock(located), T_mount, gate, view, later, usual)
        points = np.ones(len(capture.scans[view].points), bool) if found is None else found.points
        located[view] = replace(known, points=points)
    return located


def _asked(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, scatter: Repeatability, off: Collection[int]
) -> list[int]:
    """Return the views that may have stock, the likeliest first."""
    shape = _shape_left(capture, unconstrained)
    offset = _whole_offsets(capture, T_mount, unconstrained, scatter)
    least = max(_SHAPE, _TIMES_USUAL * float(np.median(shape)))
    likely = {v: max(shape[v] / least, offset[v] / _OFFSET) for v in range(len(shape))}
    asked = [v for v in likely if (likely[v] > 1 or v in off) and capture.scans[v].stock is None]
    return sorted(asked, key=lambda v: -likely[v])[:_MOST_ASKED]


def _shape_left(capture: Capture, unconstrained: UnconstrainedPoses) -> Array:
    """Return (V,) rms over patches of each view of the median distance that is left, in sigma of a single one."""
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
        shown = [(len(part), float(np.median(part))) for part in parts if len(part) >= _NEIGHBOURS]
        if shown:
            count, middle = np.array(shown).T
            left[v] = np.sqrt(count @ middle**2 / count.sum()) / unconstrained.overlaps.gram.scale
    return left


def _whole_offsets(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, scatter: Repeatability
) -> Array:
    """Return (V,) by how many sigmas each view lies off as a whole, the poses free under their prior."""
    overlaps, g = unconstrained.overlaps, unconstrained.overlaps.gram
    weights = [m.weight * tukey(m.residual, g.scale) for m in overlaps.matches]
    sums = OffsetSums(g, overlaps.matches, weights, capture)
    variance = g.variance * max(scatter.noise_factor, 1.0)
    H, b = assemble(g, ~g.labelled)
    jacobian = hand_eye_jacobian(capture.hand_eye_frames(T_mount), g.centre)
    K = with_free_hand_eye(prior_precision(capture, scatter, g.centre), jacobian)
    H = H / variance + K
    C = sums.coupling.reshape(len(H), -1) / variance
    solved = _solve(H, np.column_stack([C, b / variance + K @ unconstrained.twists.ravel()]))
    A = np.diag(sums.matrix / variance - C.T @ solved[:, :-1])
    c = sums.vector / variance - C.T @ solved[:, -1]
    return np.abs(c) / np.sqrt(np.maximum(A, 1e-9 * A.max()))


def stock_of(
    capture: Capture, T_mount: Array, gate: float, view: int, off: Collection[int], usual: Array
) -> Stock | None:
    """Return the stock that a view shows, None where it shows none or where a displacement explains as much.

    Args:
        T_mount: (4, 4) hand-eye to begin with.
        gate: distance between partners, length_unit.
        off: views that stand off: they take no part.
        usual: (6,) by which a flange usually turns and moves.
    """
    case = _hold_against_others(capture, T_mount, gate, view, off, usual)
    if case is None:
        return None
    fits = {kind: _fit(case, kind) for kind in ("whole", "region")}
    whole, region = fits["whole"], fits["region"]
    if whole is None or region is None:
        return None
    best = region if region.log_likelihood > whole.log_likelihood + _REGION else whole
    clear = abs(best.thickness) > max(_LEAST * case.sigma, _SURE * best.sigma) and best.share > _LEAST_SHARE
    if not clear:
        return None
    rivals = [_fit(case, "moved"), _fit(case, "still")]
    shared = max(case.factor, best.shared)
    others = [r.log_likelihood for r in rivals if r is not None]
    gains = [(best.log_likelihood - r) * case.factor / shared for r in others]
    if min(gains, default=np.inf) < _MARGIN or best.over_torn < _REGION:
        return None
    return Stock(best.thickness, best.sigma, best.share, best.points)


@dataclass(frozen=True)
class _Case:
    """One view, and what the others and the robot say of where all of them are."""

    capture: Capture
    view: int
    partners: list[int]  # the other views
    start: Array  # (V, 4, 4) T_reference_scanner
    centre: Array  # (3,) about which twists count, reference frame
    H: Array  # (6V, 6V) of the overlaps of the others, in units of their noise
    b: Array  # (6V,)
    twists: Array  # (6V,) from the robot's poses to `start`
    precision: Array  # (V, 6, 6) of the robot's poses
    jacobian: Array  # (6V, 6) of the hand-eye
    gate: float
    sigma: float  # robust, of a distance
    factor: float  # of its variance: distances share points

    def prior(self, is_free: bool) -> Array:
        """(6V, 6V) precision of the poses, the hand-eye free; of the view itself none where it is free."""
        precision = self.precision.copy()
        if is_free:
            precision[self.view] = 0.0
        return with_free_hand_eye(precision, self.jacobian)


def _hold_against_others(
    capture: Capture, T_mount: Array, gate: float, view: int, off: Collection[int], usual: Array
) -> _Case | None:
    """Free the other views, those near it where there are many, and say what they show of the robot's poses."""
    model_poses = capture.poses(T_mount)
    middles = frames.transform(model_poses, np.array([[scan.points.mean(axis=0)] for scan in capture.scans]))[:, 0]
    near = np.argsort(np.linalg.norm(middles - middles[view], axis=1), kind="stable")
    far = near[_MOST_VIEWS:]
    gone = np.array(sorted({*off, *far.tolist()} - {view}), np.int64)
    kept = np.setdiff1d(np.arange(len(model_poses)), gone)
    capture, model_poses, view = capture.without(gone), model_poses[kept], int(np.searchsorted(kept, view))
    partners = [v for v in range(len(kept)) if v != view]
    if len(partners) < _FEWEST_VIEWS:
        return None
    rest = capture.without(np.array([view]))
    free = unconstrained_poses(rest, model_poses[partners], gate)
    g = free.overlaps.gram
    variances = view_model(rest, T_mount, free).fit().variances
    rotation, translation = np.maximum(np.sqrt(variances[:2]), _LEAST_SCATTER * usual[[0, 3]]).tolist()
    factor = max(float(variances[2]), 1.0)
    at = (6 * np.array(partners)[:, None] + np.arange(6)).ravel()
    H, b, twists = np.zeros((6 * len(kept), 6 * len(kept))), np.zeros(6 * len(kept)), np.zeros(6 * len(kept))
    H[np.ix_(at, at)], b[at] = (part / (g.variance * factor) for part in assemble(g))
    twists[at] = free.twists.ravel()
    start = np.array(model_poses)
    start[partners] = free.poses
    precision = prior_precision(capture, Repeatability(rotation, translation, factor), g.centre)
    jacobian = hand_eye_jacobian(capture.hand_eye_frames(T_mount), g.centre)
    return _Case(
        *(capture, view, partners, start, g.centre, H, b, twists, precision, jacobian),
        *(free.overlaps.gate, g.scale, factor),
    )


def with_free_hand_eye(precision: Array, jacobian: Array) -> Array:
    """Return (6V, 6V) K = Λ − ΛJ(JᵀΛJ)⁻¹JᵀΛ of precisions Λ (V, 6, 6) of the views' twists."""
    count = len(precision)
    blocks = np.zeros((count, 6, count, 6))
    blocks[np.arange(count), :, np.arange(count)] = precision
    L = blocks.reshape(6 * count, -1)
    LJ = L @ jacobian
    return L - LJ @ _solve(jacobian.T @ LJ, LJ.T)


def _solve(matrix: Array, vectors: Array) -> Array:
    """Return the solution of a symmetric system in equilibrated unknowns; what nothing holds stays where it is."""
    diagonal = np.diag(matrix)
    unit = np.where(diagonal > 1e-300, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = matrix * unit[:, None] * unit + 1e-10 * np.eye(len(matrix))
    return (unit * np.linalg.solve(scaled, (vectors.T * unit).T).T).T


@dataclass(frozen=True)
class _Fit:
    """What one explanation leaves of a view's distances."""

    thickness: float
    sigma: float
    points: Mask  # (N,) of the view, that have stock
    share: float
    log_likelihood: float  # of distances and poses
    shared: float  # variance of sums of distances over that of independent ones
    over_torn: float  # log likelihood over a motion of the region; infinite for none


@dataclass(frozen=True)
class _Distances:
    """Distances of one view's points from the others' surfaces, M of them."""

    matches: Sequence[Match]
    e: Array  # (M,)
    weight: Array  # (M,)
    index: Indices  # (M,) of the view's points
    cosine: Array  # (M,) between its normal and the mean one
    rows: Array  # (M, 6) by a twist of the view


def _fit(case: _Case, kind: str) -> _Fit | None:
    """Fit all poses to one explanation: `still`, `moved`, or stock on the `whole` view or on a `region` of it."""
    K = case.prior(kind == "moved")
    # Each view begins where robot and hand-eye expect it.
    expected = case.prior(False)
    x = -_solve(case.H + expected, case.b + expected @ case.twists)
    scan = case.capture.scans[case.view]
    thickness = 0.0
    points = np.zeros(len(scan.points), bool)
    for step in range(_STEPS):
        d = _distances(case, frames.moved_about(case.centre, x.reshape(-1, 6), case.start), thickness * points)
        if d is None:
            return None
        e = d.e + thickness * d.cosine * points[d.index]
        member = np.full(len(e), kind == "whole")
        edge = np.zeros(len(e), bool)
        if kind == "whole" and step == 0:
            thickness = float(np.median(e))
        elif kind == "region":
            thickness, member, edge = _region(scan.points[d.index], e, thickness, case.sigma)
        if member.any():
            points = member[KDTree(scan.points[d.index]).query(scan.points)[1]]
        column = -d.cosine * member
        left = e + thickness * column
        weight = d.weight * tukey(left, case.sigma) * ~edge / (case.sigma**2 * case.factor)
        H, pulls = _normal_equations(case, d, column, weight * left, weight)
        prior = case.H + K
        H[:-1, :-1] += prior
        gradient = pulls.sum(axis=0)
        gradient[:-1] += case.b + case.H @ x + K @ (case.twists + x)
        change = -_solve(H, gradient)
        x = x + change[:-1]
        thickness += float(change[-1])
        if max(np.abs(change[:-1].reshape(-1, 6)[:, 3:]).max(), abs(change[-1])) < _CONVERGED * case.sigma:
            break
    assert d is not None
    t = case.twists + x
    held = 0.5 * float(t @ K @ t + x @ case.H @ x) + float(case.b @ x)
    own = slice(6 * case.view, 6 * case.view + 6)
    independent = (d.rows**2).T @ (weight * left) ** 2
    return _Fit(
        thickness,
        _thickness_sigma(H, prior, pulls),
        points,
        float(scan.area[points].sum() / scan.area.sum()),
        _log_density(case, left) @ d.weight / d.weight.mean() / case.factor - held,
        float(np.median((pulls[:, own] ** 2).sum(axis=0) / np.maximum(independent, 1e-300))),
        _gain_over_torn(case, d, e, left, member & ~edge) if kind == "region" and member.any() else np.inf,
    )


def _gain_over_torn(case: _Case, d: _Distances, e: Array, left: Array, member: Mask) -> float:
    """Return the log evidence of stock on a region over any motion of the region by itself, as of a torn scan.

    A motion has six numbers where stock has one, and distances show each of them (Schwarz 1978, Ann. Stat. 6:461).

    Args:
        e: (M,) distances, with the stock.
        left: (M,) what it leaves of them.
        member: (M,) which are of the region.
    """
    rows, off, weight = d.rows[member], e[member], d.weight[member]
    still = left[member]
    for _ in range(_STEPS):
        w = weight * tukey(still, case.sigma)
        motion = _solve((rows * w[:, None]).T @ rows, (rows * w[:, None]).T @ off)
        still = off - rows @ motion
    difference = _log_density(case, left[member]) - _log_density(case, still)
    gain = float(weight @ difference / d.weight.mean() / case.factor)
    return gain + (6 - 1) / 2 * float(np.log(max(len(off) / case.factor, 1.0)))


def _thickness_sigma(H: Array, prior: Array, pulls: Array) -> float:
    """Return the sigma of the last unknown, from what patches pull (P, n), or of independent distances if that is more.

    Args:
        H: (n, n) information of all unknowns.
        prior: (n − 1, n − 1) the part of it that no distance of the view adds.
    """
    gain = _solve(H, np.eye(len(H))[-1])
    scattered = gain[:-1] @ prior @ gain[:-1] + np.sum((pulls @ gain) ** 2)
    return float(np.sqrt(max(scattered, gain[-1])))


def _log_density(case: _Case, left: Array) -> Array:
    """Return (M,) log densities of what is left of distances."""
    normal = np.exp(-0.5 * (left / case.sigma) ** 2) / (np.sqrt(2 * np.pi) * case.sigma)
    return np.log((1 - _STRAY) * normal + _STRAY / (2 * case.gate))


def _distances(case: _Case, poses: Array, offset: Array) -> _Distances | None:
    """Return the view's distances from the others, its points taken back along their normals by an offset (N,); None
    for too few."""
    scan = case.capture.scans[case.view]
    if offset.any():
        moved = scan.points - offset[:, None] * scan.normals
        scan = replace(scan, points=moved, tree=KDTree(moved, leafsize=16))
    scans = [scan if v == case.view else other for v, other in enumerate(case.capture.scans)]
    samples = [sample_points(other, _SAMPLES) for other in scans]
    matches = match_pairs(scans, poses, [(case.view, w) for w in case.partners], case.gate, samples)[0]
    if sum(len(m.residual) for m in matches) < _FEWEST:
        return None
    index = np.concatenate([m.index_v for m in matches])
    normal = np.concatenate([m.normal for m in matches])
    middle = np.concatenate([m.middle for m in matches])
    cosine = np.einsum("ni,ni->n", frames.rotate(poses[case.view], scan.normals[index]), normal)
    e = np.concatenate([m.residual for m in matches])
    weight = np.concatenate([m.weight for m in matches])
    return _Distances(matches, e, weight, index, cosine, frames.plane_rows(middle - case.centre, normal))


def _region(places: Array, e: Array, thickness: float, sigma: float) -> tuple[float, Mask, Mask]:
    """Return the thickness, which distances (M,) are of the region that has it, and which lie at its edge.

    Args:
        places: (M, 3) of the view's points.
        thickness: 0 at first: then the median of all that lies off.
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


def _normal_equations(case: _Case, d: _Distances, column: Array, pull: Array, weight: Array) -> tuple[Array, Array]:
    """Return H (6V + 1, 6V + 1), and the parts of its gradient by patches (P, 6V + 1), of a view's distances.

    Args:
        column: (M,) change of a distance by a unit of stock.
        pull: (M,) what is left of the distances, times their weight.
        weight: (M,) inverse variances.
    """
    size = case.H.shape[0] + 1
    H = np.zeros((size, size))
    patch = _patches(case.capture.scans[case.view], d.index)
    sums = np.zeros((int(patch.max()) + 1, size))
    own = slice(6 * case.view, 6 * case.view + 6)
    ends = np.cumsum([len(m.residual) for m in d.matches])
    for m, end in zip(d.matches, ends, strict=True):
        part = slice(end - len(m.residual), end)
        B, w, s = d.rows[part], weight[part], column[part]
        other = slice(6 * m.w, 6 * m.w + 6)
        square = (B * w[:, None]).T @ B
        mixed = B.T @ (w * s)
        H[own, own] += square
        H[other, other] += square
        H[own, other] -= square
        H[other, own] -= square
        H[own, -1] += mixed
        H[other, -1] -= mixed
        H[-1, -1] += float(w @ s**2)
        pulls = B * pull[part, None]
        np.add.at(sums[:, own], patch[part], pulls)
        np.subtract.at(sums[:, other], patch[part], pulls)
        np.add.at(sums[:, -1], patch[part], s * pull[part])
    H[-1, :-1] = H[:-1, -1]
    return H, sums


def _patches(scan: Scan, index: Indices) -> Indices:
    """Return (M,) numbers of the patches of a scan in which some of its points lie."""
    edge = float(np.ptp(scan.box, axis=0).max()) / _PATCHES
    cells = np.floor((scan.points[index] - scan.box[0]) / edge).astype(np.int64)
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
