"""Hand-eye, centre and radius of one sphere together, from all points of all views; covariance counted in views.

Each scan is fitted on its own first. A laser line on the sphere is a circle of radius ρ; the centre lies √(R² − ρ²) off
the laser plane, to one side or the other. The sense of the arc gives the plane's normal a sign that a person can name:
the cross product of the vectors through its upper, middle and lower points in the order of the file, the same for every
line of one scanner. It cannot say on which side of the plane the sphere lies.

A first hand-eye comes from the centres: decoupled where the poses allow it, else from many rotations. G (V, 4, 4) is
T_reference_mount: T_base_flange with the scanner on the robot, T_flange_base with the sphere on it. The centre is fixed
in the reference frame: c = G_v X q_v for the centres q_v of the views.

Then all views are fitted together. A pose error shifts the whole sphere in its view, and turning it about its centre
changes nothing: all that a view's points say is the circle or sphere that they lie on. So the sum over the points of a
view is carried by their robust circle (centre in the laser plane, radius) or sphere (centre, radius) with the normal
matrix of its own fit, and nothing is lost. What the views then scatter by no number of points averages out: a shift σ_p
per axis of the sphere (the robot), an error σ_ρ of its apparent radius and an error of the points σ_c that is one over
the view (both the scanner). Near the equator of the sphere a radius off by σ_ρ puts the centre ρ/h·σ_ρ off, h its
distance from the laser plane. All three are found by restricted maximum likelihood (Patterson & Thompson 1971).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.intake.detection.balls import fit_ball
from stitch.plugins.metrology.calibrate.hand_eye_report import jackknife

# Points whose rms distance from a plane is below this share of their extent are a laser line.
_FLAT = 1e-3
# A circle may come out larger than the sphere by noise, not by this share.
_TOO_LARGE = 0.05
_FEWEST = 20
# A surface whose own radius is this much off the sphere's is something else.
_OTHER = 0.2
# Mean square over the numbers of a view, in sigmas: beyond it a view counts less (a view in 150 by chance).
_OUTLYING = 4.0
# Views whose 21 numbers leave as many as the fit has unknowns, and a few more.
_FEWEST_TRUSTED = 7
# Recorded "equal" orientations differ by up to 0.08° in real logs.
_EQUAL = np.radians(0.1)
_ROTATIONS = 600
_REFINED = 24
# Two hand-eyes further apart than this (rad) are two answers.
_DISTINCT = 0.2
# Singular values below this share of the first give no direction.
_RANK = 0.02
_ROUNDS = 20
# Numbers that the views must leave over for their scatter.
_FREE = 6
# Relative change of the scatters that ends the search.
_SMALL = 0.01


@dataclass(frozen=True)
class SphereView:
    """One scan; lengths in length_unit, all in the scanner frame."""

    name: str
    points: Array  # (N, 3) of the sphere, outliers taken out
    dropped: int  # points taken out
    foot: Array  # (3,) centre of the sphere (area scan) or of the circle (laser line)
    normal: Array  # (3,) of the laser plane; zero for an area scan
    offset: float  # distance of the centre from the laser plane; zero for an area scan
    sigma: float  # robust sigma of the points about the circle or the sphere, free in this view
    side: float  # +1, -1: the session says where along the normal; 0: it does not
    directions: Array  # (k, 3) in which the centre is measured: in the laser plane (k = 2) or all (k = 3)
    measured: Array  # (k + 1,) centre along these directions, and radius of the circle or sphere, all free
    covariance: Array  # (k + 1, k + 1) of `measured` from the points' sigma

    @property
    def is_line(self) -> bool:
        """True for a laser line, False for an area scan."""
        return bool(self.normal.any())


def sphere_view(name: str, points: Array, radius: float, side: float = 0.0) -> SphereView:
    """Fit one scan (N, 3).

    Raises:
        InputError: too few points, or a circle larger than the sphere.
    """
    if len(points) < _FEWEST:
        raise InputError(f"view {name}: {len(points)} points on the sphere are too few; leave the view out")
    middle = points.mean(axis=0)
    _U, s, Vt = np.linalg.svd(points - middle, full_matrices=False)
    is_line = s[2] <= _FLAT * s[0]
    axes = Vt[:2] if is_line else np.eye(3)
    # Of an area scan the centre with the known radius starts the search; what is measured has a free one.
    first = fit_ball((points - middle) @ axes.T, radius, known=not is_line)
    kept = points[first.keep]
    free = first if is_line or len(kept) < _FEWEST else fit_ball((kept - middle) @ axes.T, radius)
    if is_line and first.radius > (1 + _TOO_LARGE) * radius:
        raise InputError(
            f"view {name}: the line is a circle of radius {first.radius:.4g}, larger than the sphere's {radius:.4g}; "
            "check sphere.radius in session.toml and cloud_unit"
        )
    if not is_line and (len(kept) < _FEWEST or not 1 - _OTHER < free.radius / radius < 1 + _OTHER):
        raise InputError(
            f"view {name}: no sphere of radius {radius:.4g} among its points (the best has {free.radius:.4g}); check "
            "sphere.radius in session.toml and cloud_unit, or leave the view out"
        )
    return SphereView(
        name=name,
        points=kept,
        dropped=int((~first.keep).sum()),
        foot=middle + first.centre @ axes,
        normal=arc_normal(kept, Vt[2]) if is_line else np.zeros(3),
        offset=float(np.sqrt(max(radius**2 - first.radius**2, 0.0))) if is_line else 0.0,
        sigma=free.sigma,
        side=float(np.sign(side)) if is_line else 0.0,
        directions=axes,
        measured=np.append(free.centre + axes @ middle, free.radius),
        covariance=free.covariance,
    )


def arc_normal(arc: Array, normal: Array) -> Array:
    """The plane's unit normal (3,), signed by the sense in which the arc (N, 3) is run through."""
    third = max(1, len(arc) // 3)
    upper, middle, lower = arc[:third].mean(axis=0), arc[third:-third].mean(axis=0), arc[-third:].mean(axis=0)
    return normal * (np.sign(np.cross(middle - upper, lower - middle) @ normal) or 1.0)


def centres(views: Sequence[SphereView], signs: Array) -> Array:
    """Centres (V, 3) of the sphere in the scanner frame for one choice of sides (V,)."""
    return np.array([v.foot + s * v.offset * v.normal for v, s in zip(views, signs, strict=True)])


@dataclass(frozen=True)
class SphereState:
    """The unknowns: hand-eye T_mount_scanner (4, 4), centre (3,) in the reference frame, radius."""

    T_mount: Array
    centre: Array
    radius: float

    def moved(self, x: Array) -> "SphereState":
        """The state after a step (9,) or, with the radius, (10,): twist of the hand-eye, centre."""
        radius = self.radius + (x[9] if len(x) > 9 else 0.0)
        return SphereState(self.T_mount @ frames.exp(x[:6]), self.centre + x[6:9], radius)


def linearise_sphere(
    G: Array, views: Sequence[SphereView], state: SphereState, n: int
) -> tuple[list[Array], list[Array], list[Array]]:
    """Predicted less measured circle or sphere of each view, (k + 1,), and its response to a step of the state, (k + 1,
    n), and to a shift of the sphere, (k + 1, 3)."""
    back = frames.inverse(G @ state.T_mount)
    seen = frames.transform(back, state.centre[None])[:, 0]
    out, jacobian, response = [], [], []
    for view, q, R in zip(views, seen, back[:, :3, :3], strict=True):
        height = float((q - view.foot) @ view.normal)
        rho = np.sqrt(max(state.radius**2 - height**2, 1e-4 * state.radius**2))
        shift = np.vstack([view.directions, -height / rho * view.normal])
        out.append(np.append(view.directions @ q, rho) - view.measured)
        step = np.hstack([shift @ np.hstack([frames.skew(q), -np.eye(3), R]), np.zeros((len(shift), 1))])
        step[-1, 9] = state.radius / rho
        jacobian.append(step[:, :n])
        response.append(shift)
    return out, jacobian, response


def solve_sphere(
    G: Array, views: Sequence[SphereView], state: SphereState, weights: Sequence[Array], n: int
) -> SphereState:
    """Weighted least squares over the circles and spheres of the views, weights (k + 1, k + 1) each."""
    W = [np.linalg.cholesky(w).T for w in weights]

    def residual(x: Array) -> Array:
        return np.concatenate([w @ r for w, r in zip(W, linearise_sphere(G, views, state.moved(x), n)[0], strict=True)])

    return state.moved(least_squares(residual, np.zeros(n), "3-point", x_scale="jac").x)


def view_covariances(
    views: Sequence[SphereView], response: Sequence[Array], scatter: Array, shares: Array
) -> list[Array]:
    """Covariance of each view's circle or sphere: common error of the points, shift, apparent radius.

    Args:
        response: (k + 1, 3) of each view to a shift of the sphere.
        shares: (V,) from 0 to 1, how much of a view counts.
    """
    out = []
    for view, S, share in zip(views, response, shares, strict=True):
        covariance = view.covariance * (1 + (scatter[2] / view.sigma) ** 2) + scatter[0] ** 2 * S @ S.T
        covariance[-1, -1] += scatter[1] ** 2
        out.append(covariance / share)
    return out


def find_shares(e: Sequence[Array], whole: Sequence[Array]) -> Array:
    """Shares (V,) that views with residuals e (k + 1,) may have, `whole` their covariances at share 1.

    Two thirds of the views count in full, however far off they are: where more seem wrong, the state is.
    """
    square = np.array([r @ np.linalg.solve(V, r) / len(r) for r, V in zip(e, whole, strict=True)])
    limit = max(_OUTLYING, np.sort(square)[trusted_views(len(square)) - 1])
    return np.minimum(1.0, limit / np.maximum(square, 1e-12)) ** 2


def trusted_views(views: int) -> int:
    """Return how many of the views are taken to be right: two thirds, and no fewer than fix a hand-eye clearly."""
    return max(min(views, _FEWEST_TRUSTED), -(-2 * views // 3))


def find_scatter(
    views: Sequence[SphereView],
    e: Sequence[Array],
    jacobian: Sequence[Array],
    response: Sequence[Array],
    *,
    last: Array,
    shares: Array,
) -> Array:
    """(σ_p, σ_ρ, σ_c) of the largest restricted likelihood of the linear model."""

    def cost(log_scatter: Array) -> float:
        W = [
            np.linalg.inv(np.linalg.cholesky(V)) for V in view_covariances(views, response, np.exp(log_scatter), shares)
        ]
        J = np.concatenate([w @ j for w, j in zip(W, jacobian, strict=True)])
        r = np.concatenate([w @ x for w, x in zip(W, e, strict=True)])
        R, Q = np.linalg.qr(J)[::-1]
        spread = -sum(np.log(np.diag(w)).sum() for w in W)
        return float(2 * spread + 2 * np.log(np.abs(np.diag(R))).sum() + r @ r - np.sum((Q.T @ r) ** 2))

    start = np.log(last)
    # Below a thousandth of the points' sigma a scatter is none.
    floor = np.log(1e-3 * np.median([v.sigma for v in views]))
    bounds = [(max(x - 2, floor), max(x + 2, floor + 1)) for x in start]
    return np.exp(minimize(cost, np.maximum(start, floor), method="L-BFGS-B", bounds=bounds).x)


@dataclass(frozen=True)
class SphereStart:
    """A first hand-eye."""

    T_mount: Array  # (4, 4) T_mount_scanner
    signs: Array  # (V,) side of the laser plane on which the centre lies
    rms: float  # of the centres about their common place
    runner_up: float  # rms of the best clearly different answer; inf if none was found


def solve_decoupled(G: Array, q: Array) -> Array | None:
    """Rotation from pairs of equal orientation, then translation from clearly different ones.

    R_v R_X (q_1 − q_2) = p_2 − p_1 within a group of equal orientations R_v; then
    (R_i − R_j) t_X = x_j − x_i with x the groups' centres assembled with t_X = 0.

    Args:
        q: (V, 3) centres in the scanner frame.

    Returns:
        (4, 4) hand-eye, or None where the poses do not allow it.
    """
    groups = equal_orientations(G)
    seen, moved = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for group in groups:
        i, j = np.triu_indices(len(group), 1)
        a, b = group[i], group[j]
        seen.append(q[a] - q[b])
        moved.append((G[b, :3, 3] - G[a, :3, 3]) @ G[group[0], :3, :3])
    correlation = np.concatenate(moved).T @ np.concatenate(seen)
    values = np.linalg.svd(correlation, compute_uv=False)
    if values[1] <= _RANK**2 * values[0]:
        return None
    R = frames.nearest_rotation(correlation)
    turns = np.array([G[group[0], :3, :3] for group in groups])
    placed = [(q[g] @ (G[g[0], :3, :3] @ R).T + G[g, :3, 3]).mean(axis=0) for g in groups]
    i, j = np.triu_indices(len(groups), 1)
    left = (turns[i] - turns[j]).reshape(-1, 3)
    if not len(left) or np.linalg.svd(left, compute_uv=False)[-1] < _RANK:
        return None
    right = (np.array(placed)[j] - np.array(placed)[i]).reshape(-1)
    return frames.make(R, np.linalg.lstsq(left, right, rcond=None)[0])


def equal_orientations(G: Array) -> list[Array]:
    """Indices (n,) of views in groups of one orientation."""
    left, groups = np.arange(len(G)), []
    while len(left):
        same = frames.angle_between(np.broadcast_to(G[left[0]], G[left].shape), G[left]) < _EQUAL
        groups.append(left[same])
        left = left[~same]
    return groups


def global_start(G: Array, views: Sequence[SphereView], coarse: Array | None = None) -> SphereStart:
    """Best of many rotations; for each the sides of the laser planes that agree best.

    Args:
        coarse: (4, 4) hand-eye of the session, tried first.
    """
    rotations = Rotation.random(_ROTATIONS, rng=np.random.default_rng(0)).as_matrix()
    if coarse is not None:
        rotations = np.concatenate([coarse[None, :3, :3], rotations])
    tried = sorted((_solve_sides(G, views, R) for R in rotations), key=lambda start: start.rms)
    best: list[SphereStart] = []
    for start in tried[:_REFINED]:
        for _ in range(6):
            moved = refine_start(G, views, start)
            same = np.array_equal(moved.signs, start.signs)
            start = moved
            if same:
                break
        best.append(start)
    best.sort(key=lambda start: start.rms)
    others = [b.rms for b in best if frames.angle_between(b.T_mount, best[0].T_mount) > _DISTINCT]
    return SphereStart(best[0].T_mount, best[0].signs, best[0].rms, min(others, default=float("inf")))


def _solve_sides(G: Array, views: Sequence[SphereView], R: Array) -> SphereStart:
    """Translation and centre by linear least squares, then the sides, a few times, for one rotation.

    The views that fit best are fitted again each time: least trimmed squares by concentration steps (Rousseeuw & Van
    Driessen 2006, Data Min. Knowl. Discov. 12:29).
    """
    signs = np.array([v.side for v in views])
    trusted = trusted_views(len(views))
    design = np.concatenate([-G[:, :3, :3], np.broadcast_to(np.eye(3), (len(G), 3, 3))], axis=2)
    T = np.eye(4)
    rms = np.inf
    best = np.arange(len(views))
    for _ in range(4):
        y = (G[:, :3, :3] @ (centres(views, signs) @ R.T)[..., None])[..., 0] + G[:, :3, 3]
        x = np.linalg.pinv(design[best].reshape(-1, 6), rcond=1e-6) @ y[best].ravel()
        square = np.mean((y - design @ x) ** 2, axis=1)
        best = np.argsort(square, kind="stable")[:trusted]
        rms = float(np.sqrt(np.mean(square[best])))
        T = frames.make(R, x[:3])
        signs = choose_sides(G, views, T, x[3:])
    return SphereStart(T, signs, rms, np.inf)


def choose_sides(G: Array, views: Sequence[SphereView], T_mount: Array, centre: Array) -> Array:
    """Sides (V,) on which the centre (3,) of the reference frame lies; those that the session says stay."""
    seen = frames.transform(frames.inverse(G @ T_mount), centre[None])[:, 0]
    computed = np.array([1.0 if (q - v.foot) @ v.normal >= 0 else -1.0 for q, v in zip(seen, views, strict=True)])
    stated = np.array([v.side for v in views])
    return np.where(stated != 0, stated, computed)


def refine_start(G: Array, views: Sequence[SphereView], start: SphereStart) -> SphereStart:
    """Hand-eye and centre together from the centres with the sides as they stand, then the sides anew.

    Only the views that fit best so far are asked.
    """
    q = centres(views, start.signs)
    trusted = trusted_views(len(views))
    soft = np.array([np.eye(3) - (1 - _offset_weight(v)) * np.outer(v.normal, v.normal) for v in views])

    def off(x: Array) -> Array:
        T = G @ start.T_mount @ frames.exp(x[:6])
        return (soft @ (q - frames.transform(frames.inverse(T), x[None, 6:])[:, 0])[..., None])[..., 0]

    place = np.median(frames.transform(G @ start.T_mount, q[:, None])[:, 0], axis=0)
    begin = np.concatenate([np.zeros(6), place])
    best = np.argsort(np.sum(off(begin) ** 2, axis=1), kind="stable")[:trusted]
    fit = least_squares(lambda x: off(x)[best].ravel(), begin, x_scale="jac", max_nfev=30)
    T = start.T_mount @ frames.exp(fit.x[:6])
    signs = choose_sides(G, views, T, fit.x[6:])
    return SphereStart(T, signs, float(np.sqrt(np.mean(np.sort(np.mean(off(fit.x) ** 2, axis=1))[:trusted]))), np.inf)


def _offset_weight(view: SphereView) -> float:
    """Weight of the offset √(R² − ρ²): its sigma is ρ/√(R² − ρ²) times that of the radius ρ found."""
    if not view.is_line:
        return 1.0
    radius = float(np.linalg.norm(view.points - view.foot, axis=1).mean())
    return min(1.0, view.offset / radius)


@dataclass(frozen=True)
class SphereFit:
    """Parameters in the order: hand-eye twist (right, rotation first), centre, radius if free."""

    T_mount: Array  # (4, 4) T_mount_scanner
    centre: Array  # (3,) in the reference frame
    radius: float
    covariance: Array  # (9, 9) or (10, 10), counted in views
    inflation: float  # what leaving views out put on it, ≥ 1
    scatter: Array  # (σ_p, σ_ρ, σ_c) of the views
    point_sigma: float  # median over the views of the points' sigma about their own circle or sphere
    rms: float  # of all points' distances from the one sphere
    view_rms: Array  # (V,) the same by view
    left_out: Array  # (V, 9 or 10) change of the parameters without each view
    shares: Array  # (V,) how much each view counts: below 1 where it contradicts the others


@dataclass(frozen=True)
class _LinearisedSphere:
    """Residuals, Jacobians and responses to a shift by view, at a state; the weights and scatters that go with it."""

    state: SphereState
    e: list[Array]  # (k + 1,) predicted less measured circle or sphere
    jacobian: list[Array]  # (k + 1, n)
    response: list[Array]  # (k + 1, 3)
    weights: list[Array]  # (k + 1, k + 1)
    scatter: Array  # (σ_p, σ_ρ, σ_c)
    shares: Array  # (V,)


def fit_sphere(
    G: Array,
    views: Sequence[SphereView],
    T_mount: Array,
    radius: float,
    radius_free: bool = False,
    by_views: bool = False,
) -> SphereFit:
    """Refine from a start that has every laser line on the right side of the centre.

    Args:
        G: (V, 4, 4) T_reference_mount.
        T_mount: (4, 4) first hand-eye.
        by_views: weigh the views by the scatter found (generalised least squares); else every point counts
            the same, which minimises the rms distance of the points from the sphere.

    Raises:
        NoResultError: too few views.
    """
    n = 10 if radius_free else 9
    free = 3 * len(views) - n
    if free < _FREE:
        needed = -(-(n + _FREE) // 3)
        raise NoResultError(f"{len(views)} views for {n} unknowns; to fix: scan the sphere from {needed} or more poses")
    feet = np.array([v.foot for v in views])
    start = SphereState(T_mount, np.median(frames.transform(G @ T_mount, feet[:, None])[:, 0], axis=0), radius)
    scatter = np.array([0.005 * radius, 0.002 * radius, 2 * np.median([v.sigma for v in views])])
    linear = linearise_sphere(G, views, start, n)
    # The points' own sum has side minima for laser lines; the views' leads to the right one.
    fit = _reweight(G, views, _LinearisedSphere(start, *linear, [], scatter, np.ones(len(views))))
    if not by_views:
        # Every point counts the same: distances from a circle of radius ρ are R/ρ times those from the sphere.
        weights = [np.linalg.inv(v.covariance) * (v.sigma * min(v.measured[-1] / radius, 1.0)) ** 2 for v in views]
        fit = _reweight(G, views, fit, weights)
    state = fit.state
    covariance, inflation, steps = _statistics(fit, views, free)
    arms = [frames.transform(T, v.points) - state.centre for T, v in zip(G @ state.T_mount, views, strict=True)]
    off = [np.linalg.norm(arm, axis=1) - state.radius for arm in arms]
    return SphereFit(
        T_mount=state.T_mount,
        centre=state.centre,
        radius=state.radius,
        covariance=covariance,
        inflation=inflation,
        scatter=fit.scatter,
        point_sigma=float(np.median([v.sigma for v in views])),
        rms=float(np.sqrt(np.mean(np.concatenate(off) ** 2))),
        view_rms=np.array([np.sqrt(np.mean(d**2)) for d in off]),
        left_out=steps,
        shares=fit.shares,
    )


def _reweight(
    G: Array, views: Sequence[SphereView], linearised: _LinearisedSphere, by_points: Sequence[Array] | None = None
) -> _LinearisedSphere:
    """Fit and scatters in turn until the scatters stand; weights of the points, or else from the scatters."""
    for _ in range(_ROUNDS):
        if by_points is None:
            spread = view_covariances(views, linearised.response, linearised.scatter, linearised.shares)
            weights = [np.asarray(np.linalg.inv(V)) for V in spread]
        else:
            weights = [w * share for w, share in zip(by_points, linearised.shares, strict=True)]
        n = linearised.jacobian[0].shape[1]
        state = solve_sphere(G, views, linearised.state, weights, n)
        e, jacobian, response = linearise_sphere(G, views, state, n)
        shares = linearised.shares
        if by_points is None:
            shares = find_shares(e, view_covariances(views, response, linearised.scatter, np.ones(len(views))))
        scatter = find_scatter(views, e, jacobian, response, last=linearised.scatter, shares=shares)
        change = float(np.abs(np.log(scatter / linearised.scatter)).max())
        linearised = _LinearisedSphere(state, e, jacobian, response, weights=weights, scatter=scatter, shares=shares)
        if change < _SMALL:
            break
    return linearised


def _statistics(linearised: _LinearisedSphere, views: Sequence[SphereView], free: int) -> tuple[Array, float, Array]:
    """Sandwich of the weights and of the covariances that the scatter gives, and the jackknife over it.

    A scatter found from `free` numbers is itself uncertain: the error over it is Student's, not normal.
    """
    spread = view_covariances(views, linearised.response, linearised.scatter, linearised.shares)
    left = [J.T @ w for J, w in zip(linearised.jacobian, linearised.weights, strict=True)]
    information = np.array([a @ J for a, J in zip(left, linearised.jacobian, strict=True)])
    gradient = np.array([a @ r for a, r in zip(left, linearised.e, strict=True)])
    middle = np.sum([a @ V @ a.T for a, V in zip(left, spread, strict=True)], axis=0)
    bread = np.linalg.inv(information.sum(axis=0))
    return jackknife(information, gradient, bread @ middle @ bread * free / (free - 2))
