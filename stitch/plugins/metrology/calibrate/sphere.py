"""Hand-eye from scans of one known sphere: fit each scan, find a start, refine all together, say what is weak."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.hand_eye import motions_from_first, require_motion
from stitch.plugins.metrology.calibrate.hand_eye_report import hand_eye_document, weak_components, weak_notes
from stitch.plugins.metrology.calibrate.sphere_fit import (
    SphereFit,
    SphereStart,
    SphereView,
    centres,
    fit_sphere,
    global_start,
    refine_start,
    solve_decoupled,
    sphere_view,
)
from stitch.session.session import SessionData

# Answers whose fits differ by less than this factor cannot be told apart.
_CLEAR = 1.3
# Fewer views do not show the radius beside the rest.
_VIEWS_FOR_RADIUS = 6
# A radius that is off by more, and by more sigmas, is another one; scanners and coatings are off by less.
_OTHER_RADIUS = 0.02
_RADIUS_SIGMAS = 4.0
# Column of views.csv: the side of the laser plane, along the arc's normal, on which the centre lies.
SIDE_COLUMN = "sphere_side"
# A view's points are off by more than their noise beyond this ratio.
_BEYOND_NOISE = 3.0
_FREE_RADIUS_SIGMAS = 3.0
# A view that counts less than this is named.
_DOUBTED = 0.5


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


def calibrate_sphere(session: SessionData, radius_free: bool = False) -> SphereCalibration:
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
    of_areas = [v.measured[-1] for v in views if not v.is_line]
    if of_areas:
        _require_radius(session, np.median(of_areas), float(np.std(of_areas)))
    require_motion(motions_from_first(G))
    start, how = find_sphere_start(G, views, session.scanner.T_mount)
    enough = len(views) >= _VIEWS_FOR_RADIUS
    free = fit_sphere(G, views, start.T_mount, radius, True) if radius_free or enough else None
    # A wrong radius may be what makes two hand-eyes fit alike.
    if free is not None and not radius_free:
        _require_radius(session, free.radius, float(np.sqrt(free.covariance[9, 9])))
    if start.runner_up < _CLEAR * start.rms:
        raise NoResultError(
            f"two hand-eyes fit these scans alike (rms {start.rms:.3g}, {start.runner_up:.3g} {session.length_unit}); "
            f"to fix: give scanner.pose in session.toml, the column {SIDE_COLUMN} in views.csv, or turn the wrist more"
        )
    fit = free if radius_free and free is not None else fit_sphere(G, views, start.T_mount, radius)
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


def _require_radius(session: SessionData, fitted_radius: float, sigma: float) -> None:
    """Refuse a radius that the scans contradict: a hand-eye from it would be off by many times the difference.

    Raises:
        InputError: names the radius found.
    """
    stated = session.sphere_radius or fitted_radius
    if abs(fitted_radius - stated) > max(_OTHER_RADIUS * stated, _RADIUS_SIGMAS * sigma):
        raise InputError(
            f"{session.path / 'session.toml'}: sphere.radius is {stated:.4g}, the scans show {fitted_radius:.4g} "
            f"± {sigma:.2g} {session.length_unit}; to fix: correct it, or cloud_unit"
        )


def _fit_view(session: SessionData, k: int, radius: float) -> SphereView:
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
        sides = np.array([v.side for v in views])
        T = solve_decoupled(G, centres(views, sides))
        if T is not None:
            first = refine_start(G, views, SphereStart(T, sides, np.inf, np.inf))
            return first, "decoupled: rotation from equal orientations, translation from different ones"
    return global_start(G, views, coarse), "global: the best of many rotations"


def sphere_weak_components(result: SphereCalibration, unit: str) -> list[str]:
    """Weak components of the hand-eye, a phrase each."""
    seen = frames.transform(frames.inverse(result.G @ result.fit.T_mount), result.fit.centre[None])[:, 0]
    lever = float(np.median(np.linalg.norm(seen, axis=1)))
    return weak_components(result.fit.covariance[:6, :6], result.fit.rms, lever, unit)


def sphere_notes(result: SphereCalibration, unit: str) -> list[str]:
    """Sentences: sides, wrist, weak components, noise against poses, the free radius, odd views."""
    fit = result.fit
    notes = list[str]()
    if result.sides_found:
        plus = int((result.signs > 0).sum())
        ratio = f"{result.runner_up:.0f}" if 10 <= result.runner_up < np.inf else f"{result.runner_up:.1f}"
        notes.append(
            "The session does not say on which side of the laser plane the sphere lies; the consistency of all poses "
            f"decided: {plus} views along the arc's normal, {len(result.signs) - plus} against it; the next best "
            f"answer fits {ratio} times worse"
        )
    notes += weak_notes(result.G, sphere_weak_components(result, unit))
    if np.median(fit.view_rms) > _BEYOND_NOISE * fit.point_sigma:
        low, high = np.percentile(fit.view_rms, [10, 90])
        noise = "profile noise" if any(v.is_line for v in result.views) else "the scanner's noise"
        notes.append(
            f"{low:#.2g} to {high:#.2g} {unit} per pose (at most {fit.view_rms.max():#.2g}) cannot be {noise} "
            f"({fit.point_sigma:#.2g} {unit}): it comes once per pose, from the robot's poses or the scanner's "
            "calibration, and more points per scan will not reduce it"
        )
    notes += _radius_note(result, unit)
    return notes + _view_notes(result, unit)


def _view_notes(result: SphereCalibration, unit: str) -> list[str]:
    """Views that contradict the others or carry the answer alone."""
    fit = result.fit
    notes = []
    sigma = np.sqrt(np.diag(fit.covariance))
    for view, step, share, rms in zip(result.views, fit.left_out, fit.shares, fit.view_rms, strict=True):
        if share < _DOUBTED:
            notes.append(
                f"View {view.name} contradicts the others ({rms:#.2g} {unit} from the sphere) and counts {share:.2g}; "
                "check its pose, or scan it again"
            )
        elif np.abs(step[:6] / sigma[:6]).max() > _FREE_RADIUS_SIGMAS:
            notes.append(
                f"View {view.name} alone moves the answer by more than {_FREE_RADIUS_SIGMAS:g} sigma; scan it again"
            )
    return notes


def _radius_note(result: SphereCalibration, unit: str) -> list[str]:
    if result.free is None:
        return []
    off = result.free.radius - result.nominal
    sigma = float(np.sqrt(result.free.covariance[9, 9]))
    fitted = f"Free, the radius becomes {result.free.radius:.4g} ± {sigma:.2g} {unit}"
    if abs(off) <= _FREE_RADIUS_SIGMAS * sigma:
        return [
            f"{fitted}: the {result.nominal:g} given agrees ({abs(off) / sigma:.1f} sigma), nothing else is revealed"
        ]
    return [
        f"{fitted}, {abs(off) / sigma:.1f} sigma from the {result.nominal:g} given: the sphere's radius, the scanner's "
        f"scale ({off / result.nominal:+.2%}) or a coating is not what the session says"
    ]


def sphere_document(result: SphereCalibration, session: SessionData) -> dict[str, Any]:
    """The JSON document."""
    fit = result.fit
    free = result.free
    unit = session.length_unit
    return {
        **hand_eye_document("sphere", session, fit.T_mount, fit.covariance[:6, :6], fit.inflation, result.G),
        "centre": fit.centre.tolist(),
        "centre_sigma": np.sqrt(np.diag(fit.covariance))[6:9].tolist(),
        "radius": {
            "given": result.nominal,
            "used": fit.radius,
            "free": free.radius if free else None,
            "free_sigma": float(np.sqrt(free.covariance[9, 9])) if free else None,
        },
        "rms": fit.rms,
        "point_sigma": fit.point_sigma,
        "scatter_of_views": dict(zip(("shift", "apparent_radius", "common"), fit.scatter.tolist(), strict=True)),
        "start": result.start,
        "sides_from_consistency": result.sides_found,
        "runner_up_ratio": result.runner_up if np.isfinite(result.runner_up) else None,
        "decoupled": None if result.T_decoupled is None else result.T_decoupled.tolist(),
        "weighed_by_views": {
            "hand_eye": result.by_views.T_mount.tolist(),
            "hand_eye_sigma": np.sqrt(np.diag(result.by_views.covariance))[:6].tolist(),
            "rms": result.by_views.rms,
        },
        "weak": sphere_weak_components(result, unit),
        "notes": sphere_notes(result, unit),
        "views": [
            {
                "view": view.name,
                "points": len(view.points),
                "dropped": view.dropped,
                "rms": float(rms),
                "side": int(sign) if view.is_line else None,
            }
            for view, rms, sign in zip(result.views, fit.view_rms, result.signs, strict=True)
        ],
    }
