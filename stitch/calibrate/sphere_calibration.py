"""Hand-eye from scans of one known sphere: fit each scan, find a start, refine all together, say what is weak."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.calibrate.sphere_fit import SphereFit, fit_sphere
from stitch.calibrate.sphere_start import SphereStart, global_start, refine_start, solve_decoupled
from stitch.calibrate.sphere_views import SphereView, centres, sphere_view
from stitch.closed_form.relative_motions import motions_from_first, require_motion
from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.measurement.session import Session

# Answers whose fits differ by less than this factor cannot be told apart.
_CLEAR = 1.3
# Fewer views do not show the radius beside the rest.
_VIEWS_FOR_RADIUS = 6
# A radius that is off by more, and by more sigmas, is another one; scanners and coatings are off by less.
_OTHER_RADIUS, _RADIUS_SIGMAS = 0.02, 4.0
# Column of views.csv: the side of the laser plane, along the arc's normal, on which the centre lies.
SIDE_COLUMN = "sphere_side"


@dataclass(frozen=True)
class SphereCalibration:
    """The answer and everything it was judged by."""

    fit: SphereFit  # the answer
    free: SphereFit | None  # the same with a free radius, for comparison; None where too few views are there
    by_views: SphereFit  # the same with views weighed by their scatter, for comparison
    views: tuple[SphereView, ...]
    G: Array  # (V, 4, 4) T_reference_mount
    signs: Array  # (V,) side of the centre
    T_decoupled: Array | None  # (4, 4), where the poses allow it
    start: str  # how the first hand-eye was found
    sides_found: bool  # the sides come from the consistency of the poses
    runner_up: float  # how many times worse the next best answer fits the centres; inf if none was found
    nominal: float  # radius given


def calibrate_sphere(session: Session, radius_free: bool = False) -> SphereCalibration:
    """Hand-eye of a session whose clouds all show one sphere, on either mount.

    Raises:
        InputError: no radius, a view without a cloud, a circle larger than the sphere.
        NoResultError: poses that cannot show the hand-eye, or that fit two of them.
    """
    radius = session.sphere_radius
    if radius is None:
        raise InputError(f"{session.path / 'session.toml'}: no [sphere]; write [sphere] and radius = … there")
    T = np.array([view.T_base_flange for view in session.views])
    G = T if session.mount == "eye_in_hand" else frames.inverse(T)
    views = tuple(_fit_view(session, k, radius) for k in range(len(session.views)))
    own = [v.measured[-1] for v in views if not v.is_line]
    _require_radius(session, np.median(own) if own else radius, float(np.std(own)) if own else 0.0)
    require_motion(motions_from_first(G))
    start, how = find_sphere_start(G, views, session.scanner.T_mount)
    if start.runner_up < _CLEAR * start.rms:
        raise NoResultError(
            f"two hand-eyes fit these scans alike (rms {start.rms:.3g}, {start.runner_up:.3g} {session.length_unit}); "
            f"give scanner.pose in session.toml or the column {SIDE_COLUMN} in views.csv, or turn the wrist more"
        )
    fit = fit_sphere(G, views, start.T_mount, radius, radius_free)
    enough = len(views) >= _VIEWS_FOR_RADIUS
    free = fit if radius_free else (fit_sphere(G, views, start.T_mount, radius, True) if enough else None)
    if free is not None and not radius_free:
        _require_radius(session, free.radius, float(np.sqrt(free.covariance[9, 9])))
    return SphereCalibration(
        fit=fit,
        free=free,
        by_views=fit_sphere(G, views, start.T_mount, radius, radius_free, by_views=True),
        views=views,
        G=G,
        signs=start.signs,
        T_decoupled=solve_decoupled(G, centres(views, start.signs)),
        start=how,
        sides_found=bool(open_sides(views).any()),
        runner_up=start.runner_up / max(start.rms, 1e-12),
        nominal=radius,
    )


def _require_radius(session: Session, fitted_radius: float, sigma: float) -> None:
    """Refuse a radius that the scans contradict: a hand-eye from it would be off by many times the difference.

    Raises:
        InputError: names the radius found.
    """
    stated = session.sphere_radius or fitted_radius
    if abs(fitted_radius - stated) > max(_OTHER_RADIUS * stated, _RADIUS_SIGMAS * sigma):
        raise InputError(
            f"{session.path / 'session.toml'}: sphere.radius is {stated:.4g}, the scans show {fitted_radius:.4g} ± {sigma:.2g} "
            f"{session.length_unit}; to fix: correct it, or cloud_unit"
        )


def _fit_view(session: Session, k: int, radius: float) -> SphereView:
    view = session.views[k]
    if view.cloud is None:
        raise InputError(
            f"{session.path / 'views.csv'}: view {view.name} has no cloud; a sphere needs one in every view"
        )
    side = view.covariates.get(SIDE_COLUMN, 0.0)
    if side not in (-1.0, 0.0, 1.0):
        raise InputError(f"{session.path / 'views.csv'}: view {view.name}: {SIDE_COLUMN} is {side:g}; use -1, 0 or +1")
    try:
        return sphere_view(view.name, view.cloud.points, radius, side)
    except InputError as error:
        raise InputError(f"{session.path}: {error}") from None


def open_sides(views: tuple[SphereView, ...]) -> Array:
    """(V,) bool: laser lines whose side the session does not say."""
    return np.array([v.is_line and v.side == 0 for v in views])


def find_sphere_start(G: Array, views: tuple[SphereView, ...], coarse: Array | None) -> tuple[SphereStart, str]:
    """Decoupled where sides are known and the poses allow it, else from many rotations."""
    if not open_sides(views).any():
        said = np.array([v.side for v in views])
        T = solve_decoupled(G, centres(views, said))
        if T is not None:
            first = refine_start(G, views, SphereStart(T, said, np.inf, np.inf))
            return first, "decoupled: rotation from equal orientations, translation from different ones"
    return global_start(G, views, coarse), "global: the best of many rotations"
