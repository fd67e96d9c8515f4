"""What a sphere calibration says: sentences for people, a document for programs."""

from typing import Any

import numpy as np

from stitch import frames
from stitch.calibrate.hand_eye_report import hand_eye_document, weak_components, weak_notes
from stitch.calibrate.sphere_calibration import SphereCalibration
from stitch.calibrate.sphere_views import SphereView
from stitch.measurement.session import Session

# A view's points are off by more than their noise beyond this ratio.
_BEYOND_NOISE = 3.0
_FREE_RADIUS_SIGMAS = 3.0
# A view that counts less than this is named.
_DOUBTED = 0.5


def sphere_weak_components(result: SphereCalibration, unit: str) -> list[str]:
    """Weak components of the hand-eye, a phrase each."""
    seen = frames.transform(frames.inverse(result.G @ result.fit.T_mount), result.fit.centre[None])[:, 0]
    lever = float(np.median(np.linalg.norm(seen, axis=1)))
    return weak_components(result.fit.covariance[:6, :6], result.fit.rms, lever, unit)


def sphere_notes(result: SphereCalibration, unit: str) -> list[str]:
    """Sentences: sides, wrist, weak components, noise against poses, the free radius, odd views."""
    fit, notes = result.fit, list[str]()
    if result.sides_found:
        plus = int((result.signs > 0).sum())
        notes.append(
            "The session does not say on which side of the laser plane the sphere lies; the consistency of all poses "
            f"decided: {plus} views along the arc's normal, {len(result.signs) - plus} against it; the next best "
            f"answer fits {_ratio_text(result.runner_up)} worse"
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
    fit, notes = result.fit, []
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


def _ratio_text(ratio: float) -> str:
    return f"{ratio:.0f} times" if np.isfinite(ratio) and ratio >= 10 else f"{ratio:.1f} times"


def _radius_note(result: SphereCalibration, unit: str) -> list[str]:
    if result.free is None:
        return []
    off, sigma = result.free.radius - result.nominal, float(np.sqrt(result.free.covariance[9, 9]))
    found = f"Free, the radius becomes {result.free.radius:.4g} ± {sigma:.2g} {unit}"
    if abs(off) <= _FREE_RADIUS_SIGMAS * sigma:
        return [
            f"{found}: the {result.nominal:g} given agrees ({abs(off) / sigma:.1f} sigma), nothing else is revealed"
        ]
    return [
        f"{found}, {abs(off) / sigma:.1f} sigma from the {result.nominal:g} given: the sphere's radius, the scanner's "
        f"scale ({off / result.nominal:+.2%}) or a coating is not what the session says"
    ]


def sphere_document(result: SphereCalibration, session: Session) -> dict[str, Any]:
    """The JSON document."""
    fit, unit, free = result.fit, session.length_unit, result.free
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
        "views": [_view_row(*row) for row in zip(result.views, fit.view_rms, result.signs, strict=True)],
    }


def _view_row(view: SphereView, rms: float, sign: float) -> dict[str, Any]:
    return {
        "view": view.name,
        "points": len(view.points),
        "dropped": view.dropped,
        "rms": float(rms),
        "side": int(sign) if view.is_line else None,
    }
