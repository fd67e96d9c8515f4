"""Base and tool from measured poses: a tracker and its 6D probe, or a camera and its board.

Probe on the flange, sensor in the cell (eye_to_hand):
T_base_flange · T_flange_probe = T_base_sensor · T_sensor_probe
Camera on the flange, board in the cell (eye_in_hand):
T_base_flange · T_flange_camera = T_base_board · T_camera_board⁻¹

Both are A·X = Z·B, solved by nonlinear least squares. The residual of a view is the twist log((A X)⁻¹ Z B) in the
probe's frame; rotations and translations scatter by σ_r and σ_t, both found from the residuals unless given; the
covariance is counted in views.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import mad_sigma
from stitch.numerics.frames import Array
from stitch.numerics.hand_eye import park_martin, shah, weight_roots
from stitch.plugins.metrology.calibrate.hand_eye_report import hand_eye_document, jackknife, weak_components, weak_notes
from stitch.session.reading.target_tables import read_frames
from stitch.session.session import SessionData

_STEPS = 30
# A step below this share of the sigmas changes nothing.
_SMALL = 1e-6
# Beyond this many sigmas a robust fit counts a residual by its size, not its square (Huber).
_HUBER = 2.0
# Numbers of X and Z.
_UNKNOWNS = 12
# Second opinions further off than this many sigmas speak against independent errors.
_SURE = 3.0
# Rotations (rad) that scatter more than this do not belong to one base and tool.
_UNRELATED = 0.3
# Enough places for a spread among them, enough views in each to lose it without loss of rank.
_PLACES = 25
_VIEWS_PER_PLACE = 6


@dataclass(frozen=True)
class AxzbSolution:
    """Both transforms; the covariance is of their right perturbations T·exp(ξ), rotation first."""

    transforms: tuple[Array, Array]  # X and Z, (4, 4) each
    covariance: Array  # (12, 12): X, then Z
    inflation: float  # what leaving views out put on the covariance, ≥ 1
    residual: Array  # (V, 6) twists
    heldout: Array  # (V, 6) the same, each view predicted without itself
    sigma: tuple[float, float]  # of a residual's rotation (rad) and translation


def refine_axzb(
    A: Array,
    B: Array,
    sigma: tuple[float, float] | None = None,
    weights: Array | None = None,
    robust: bool = False,
    groups: Array | None = None,
) -> AxzbSolution:
    """X, Z of A·X = Z·B by Gauss–Newton from Shah's start; every step whitens by the scatter that it starts from.

    Args:
        A, B: (V, 4, 4) poses.
        sigma: scatter of rotation (rad) and translation, if known; their ratio weighs the two.
        weights: (V,) on the squares of each view.
        robust: Huber's loss, and scatters from medians.
        groups: (V,) labels of views that may err together; the covariance then leaves out whole groups.

    Raises:
        NoResultError: poses that cannot show both; names the axis they share.
    """
    X, Z = shah(A, B, weights)
    root = weight_roots(A, weights)[:, None]
    for step in range(_STEPS + 1):
        e, jacobian = _linearise_axzb(A, B, X, Z)
        scatter = np.array(sigma or _residual_scatter(e * root, robust))
        white = root / np.repeat(scatter, 3)
        information, gradient = _normal_equations(jacobian * white[..., None], e * white, robust)
        total = information.sum(axis=0)
        xi = -np.linalg.solve(total, gradient.sum(axis=0))
        if step == _STEPS or np.sqrt(xi @ total @ xi) < _SMALL:
            break
        X, Z = X @ frames.exp(xi[:6]), Z @ frames.exp(xi[6:])
    model = np.linalg.inv(total)
    if sigma is None:
        # Variance of Student's t, each of the two scatters found from half of the free numbers; at most 3.
        half = (e.size - _UNKNOWNS) / 2
        model = model * min(half / max(half - 2, 1e-9), 3.0)
    covariance, inflation, steps = jackknife(information, gradient, model)
    heldout = np.array([e[v] + jacobian[v] @ step for v, step in enumerate(steps)])
    if groups is not None:
        member = groups == np.unique(groups)[:, None]
        covariance, inflation, _ = jackknife(np.tensordot(member, information, 1), member @ gradient, model)
    return AxzbSolution((X, Z), covariance, inflation, e, heldout, (float(scatter[0]), float(scatter[1])))


def _linearise_axzb(A: Array, B: Array, X: Array, Z: Array) -> tuple[Array, Array]:
    """Residual twists (V, 6) and their Jacobian (V, 6, 12) at X and Z.

    With the left and right inverse Jacobians of SE(3) at small twists, to first order (Barfoot 7.84).
    """
    e = frames.log(frames.inverse(A @ X) @ Z @ B)
    half = np.zeros((len(e), 6, 6))
    half[:, :3, :3] = half[:, 3:, 3:] = 0.5 * frames.skew(e[:, :3])
    half[:, 3:, :3] = 0.5 * frames.skew(e[:, 3:])
    by_x, by_z = half - np.eye(6), (np.eye(6) + half) @ frames.adjoint(frames.inverse(B))
    return e, np.concatenate([by_x, by_z], axis=2)


def _normal_equations(jacobian: Array, e: Array, robust: bool) -> tuple[Array, Array]:
    """JᵀWJ and JᵀWe of each view, each coordinate weighted as the loss weighs it."""
    w = 1 / np.maximum(1.0, np.abs(e) / _HUBER) if robust else np.ones_like(e)
    weighted = jacobian * w[..., None]
    information = np.swapaxes(weighted, 1, 2) @ jacobian
    return information, np.einsum("vij,vi->vj", weighted, e)


def _residual_scatter(e: Array, robust: bool) -> tuple[float, float]:
    """σ of rotations and of translations; each half of the residuals pays for half of the unknowns."""
    free = max(1 - _UNKNOWNS / e.size, 1 / e.size)
    rotation = mad_sigma(e[:, :3]) if robust else float(np.sqrt(np.mean(e[:, :3] ** 2)))
    translation = mad_sigma(e[:, 3:]) if robust else float(np.sqrt(np.mean(e[:, 3:] ** 2)))
    # Exact data have no scatter; what rounding leaves of lengths keeps the weights finite.
    return max(rotation / np.sqrt(free), 1e-12), max(translation / np.sqrt(free), 1e-9)


@dataclass(frozen=True)
class TrackerCalibration:
    """X (on the flange), Z (in the base) and what is left."""

    fit: AxzbSolution  # transforms (X, Z)
    views: tuple[str, ...]
    A: Array  # (V, 4, 4)
    B: Array  # (V, 4, 4)
    mount: str

    @property
    def hand_eye(self) -> int:
        """Which of the transforms is the sensor's: 1 (Z) with the sensor in the cell, 0 (X) on the flange."""
        return int(self.mount == "eye_to_hand")

    def covariance_of(self, k: int) -> Array:
        """(6, 6) of the right perturbation of X (0) or Z (1)."""
        return self.fit.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]


def calibrate_tracker(session: SessionData) -> TrackerCalibration:
    """Base and tool of a frames session.

    Raises:
        InputError: frames.csv missing or broken.
        NoResultError: poses that cannot show both, or poses and frames that belong to different motions.
    """
    sightings = read_frames(session.path / "frames.csv", session.names)
    flange = {view.name: view.T_base_flange for view in session.views}
    A = np.array([flange[name] for name in sightings])
    T_sensor_probe = np.array(
        [frames.make(s.rotation, s.points[0]) for s in sightings.values() if s.rotation is not None]
    )
    sigma = np.array([s.sigma[0] for s in sightings.values()])
    eye_to_hand = session.mount == "eye_to_hand"
    B = T_sensor_probe if eye_to_hand else frames.inverse(T_sensor_probe)
    weights = None if np.isnan(sigma).any() else (np.median(sigma) / sigma) ** 2
    # Places in the workspace: what base and tool do not explain errs alike in one place.
    enough = len(A) >= _VIEWS_PER_PLACE * _PLACES
    groups = kmeans2(A[:, :3, 3], _PLACES, minit="++", rng=0)[1] if enough else None
    fit = refine_axzb(A, B, weights=weights, robust=True, groups=groups)
    if fit.sigma[0] > _UNRELATED:
        raise NoResultError(
            f"flange poses and frames.csv do not fit together (rotations scatter by {np.degrees(fit.sigma[0]):.0f}°); "
            f"check the mount ({session.mount}), the order of the views, and the quaternions"
        )
    return TrackerCalibration(fit, tuple(sightings), A, B, session.mount)


def tracker_document(result: TrackerCalibration, session: SessionData) -> dict[str, Any]:
    """The JSON document."""
    fit = result.fit
    h = result.hand_eye
    sigma = np.sqrt(np.diag(result.covariance_of(1 - h)))
    other = {
        "name": ("T_base_board", "T_flange_probe")[h],
        "transform": fit.transforms[1 - h].tolist(),
        "sigma": sigma.tolist(),
    }
    return {
        **hand_eye_document("tracker", session, fit.transforms[h], result.covariance_of(h), fit.inflation, result.A),
        "other": other,
        "views": len(result.views),
        "position_error": _error_sizes(fit.residual[:, 3:]),
        "rotation_error_deg": _error_sizes(np.degrees(fit.residual[:, :3])),
        "heldout_position_error": _error_sizes(fit.heldout[:, 3:]),
        "heldout_rotation_error_deg": _error_sizes(np.degrees(fit.heldout[:, :3])),
        "scatter": {"rotation": fit.sigma[0], "translation": fit.sigma[1]},
        "closed_forms": compare_closed_forms(result),
        "weak": _weak_phrases(result, session.length_unit),
        "notes": tracker_notes(result, session),
    }


def _error_sizes(errors: Array) -> dict[str, float]:
    length = np.linalg.norm(errors, axis=1)
    return {"mean": float(length.mean()), "rms": float(np.sqrt(np.mean(length**2))), "max": float(length.max())}


def _weak_phrases(result: TrackerCalibration, unit: str) -> list[str]:
    lever = float(np.median(np.linalg.norm(result.B[:, :3, 3], axis=1)))
    return weak_components(result.covariance_of(result.hand_eye), result.fit.sigma[1], lever, unit)


def compare_closed_forms(result: TrackerCalibration) -> dict[str, dict[str, float]]:
    """How far X of the closed forms is from the refined one: second opinions of other errors."""
    half = len(result.A) // 2
    A = frames.inverse(result.A[:half]) @ result.A[half : 2 * half]
    B = frames.inverse(result.B[:half]) @ result.B[half : 2 * half]
    differences = {}
    for name, X in (("Shah (A·X = Z·B)", shah(result.A, result.B)[0]), ("Park-Martin (A·X = X·B)", park_martin(A, B))):
        off = frames.log(frames.inverse(result.fit.transforms[0]) @ X)
        size = np.linalg.norm(off.reshape(2, 3), axis=1)
        differences[name] = {"rotation_deg": float(np.degrees(size[0])), "translation": float(size[1])}
    return differences


def tracker_notes(result: TrackerCalibration, session: SessionData) -> list[str]:
    """Sentences about the wrist, weak components, and errors that base and tool do not explain."""
    fit = result.fit
    unit = session.length_unit
    notes = weak_notes(result.A, _weak_phrases(result, unit))
    position = _error_sizes(fit.heldout[:, 3:])["mean"]
    noise = session.scanner.noise
    if noise is not None and position > _SURE * np.sqrt(3) * noise:
        notes.append(
            f"Base and tool alone leave {position:#.3g} {unit} in the position of views left out (mean), "
            f"{position / noise:.0f} times the sensor's noise of {noise:g}: the rest is the robot's own"
        )
    if fit.inflation > 2:
        notes.append(
            f"Views near each other err alike: the covariance, counted in places, is {fit.inflation:.0f} times that of "
            "independent views"
        )
    return notes
