"""The camera beyond one plane: a 3x4 projection near the work plane, with radial distortion and a plate height error.

On one plane all three are hidden: a homography takes up a wrong height completely, and distortion partly. A hole
seen at many places and heights, which robot and rangers measure, shows them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from stitch.cells.drilling.homography import normaliser
from stitch.errors import NoResultError
from stitch.frames import Array

# Effects by the names that a report uses.
CAMERA_EFFECTS = ("k1", "plate_height")
_UNDISTORT_STEPS = 20


@dataclass(frozen=True)
class HoleObservations:
    """Holes seen by the camera."""

    xyz: Array  # (N, 3) in the flange frame, length unit
    uv: Array  # (N, 2) pixels
    on_plate: NDArray[np.bool_]  # (N,): hole of the calibration plate, whose z is the plate's stated height
    image_size: tuple[float, float]  # width, height in pixels


@dataclass(frozen=True)
class CameraFit:
    """A camera and how well it explains the observations."""

    P: Array  # (3, 4) flange to ideal image
    k1: float  # relative radial shift at the image corner
    plate_height: float  # true minus stated height of the plate
    centre: Array  # (2,) of the distortion: middle of the image
    corner: float  # pixels from there to the corner
    effects: tuple[str, ...]
    residuals: Array  # (N, 2) pixels
    sigma: dict[str, float]  # of the fitted effects

    @property
    def sum_of_squares(self) -> float:
        """Over both coordinates of all holes, in pixels²."""
        return float((self.residuals**2).sum())

    @property
    def unknowns(self) -> int:
        """Fitted numbers."""
        return 11 + len(self.effects)

    def image(self, xyz: Array) -> Array:
        """Image points (N, 2) of points (N, 3) in the flange frame."""
        return distort(_project(self.P, xyz), self.k1, self.centre, self.corner)

    def plane(self, uv: Array, z: float | Array) -> Array:
        """x, y (N, 2) in the flange frame of image points (N, 2) at height z, scalar or (N,)."""
        ideal = undistort(np.asarray(uv, float), self.k1, self.centre, self.corner)
        z = np.broadcast_to(np.asarray(z, float), len(ideal))
        # Rows of u·(P3 X) = P1 X and v·(P3 X) = P2 X, solved for x and y.
        rows = self.P[:2] - ideal[..., None] * self.P[2]
        right = -(rows[..., 2] * z[:, None] + rows[..., 3])
        return np.asarray(np.linalg.solve(rows[..., :2], right[..., None])[..., 0])


def distort(uv: Array, k1: float, centre: Array, corner: float) -> Array:
    """Ideal to real image points (..., 2): away from the centre by k1·(r/corner)² of their distance r."""
    arm = uv - centre
    return np.asarray(centre + arm * (1 + k1 * ((arm / corner) ** 2).sum(axis=-1, keepdims=True)))


def undistort(uv: Array, k1: float, centre: Array, corner: float) -> Array:
    """Real to ideal image points (..., 2): `distort` inverted by iteration; converges for |k1| well below 1/3."""
    arm = real = uv - centre
    for _ in range(_UNDISTORT_STEPS):
        arm = real / (1 + k1 * ((arm / corner) ** 2).sum(axis=-1, keepdims=True))
    return np.asarray(centre + arm)


def fit_camera(observations: HoleObservations, effects: tuple[str, ...] = ()) -> CameraFit:
    """Projection and the named effects by least squares of the image distances.

    Raises:
        NoResultError: too few holes, all at one height, or a plate height error asked for without a plate.
    """
    _check_enough(observations, effects)
    centre = np.array(observations.image_size) / 2 - 0.5
    corner = float(np.linalg.norm(observations.image_size) / 2)
    # Normalised as the DLT wants it, for the refinement's conditioning too.
    to_uv, to_xyz = normaliser(observations.uv), normaliser(observations.xyz)
    start = _dlt(observations.xyz, observations.uv, to_xyz, to_uv)

    def camera(x: Array) -> tuple[Array, dict[str, float]]:
        P = np.linalg.inv(to_uv) @ np.append(x[:11], 1.0).reshape(3, 4) @ to_xyz
        return P, dict(zip(effects, x[11:], strict=True))

    def residuals(x: Array) -> Array:
        P, named = camera(x)
        xyz = observations.xyz + np.outer(observations.on_plate, [0.0, 0.0, named.get("plate_height", 0.0)])
        return (distort(_project(P, xyz), named.get("k1", 0.0), centre, corner) - observations.uv).ravel()

    solution = least_squares(residuals, np.append(start, np.zeros(len(effects))), method="lm", x_scale="jac")
    P, named = camera(solution.x)
    variance = solution.fun @ solution.fun / max(solution.fun.size - len(solution.x), 1)
    spread = np.sqrt(np.diag(np.linalg.pinv(solution.jac.T @ solution.jac)) * variance)[11:]
    return CameraFit(
        P,
        k1=float(named.get("k1", 0.0)),
        plate_height=float(named.get("plate_height", 0.0)),
        centre=centre,
        corner=corner,
        effects=effects,
        residuals=solution.fun.reshape(-1, 2),
        sigma=dict(zip(effects, spread.tolist(), strict=True)),
    )


def _check_enough(observations: HoleObservations, effects: tuple[str, ...]) -> None:
    """Refuse holes that leave the camera or an effect open."""
    if len(observations.xyz) < 8 or np.ptp(observations.xyz[:, 2]) < 1e-3 * np.ptp(observations.xyz[:, 0]):
        raise NoResultError(
            "a camera beyond its work plane needs eight or more holes at different heights; measure some"
        )
    if "plate_height" in effects and not (
        observations.on_plate.any() and np.unique(observations.xyz[~observations.on_plate, 2]).size > 1
    ):
        raise NoResultError(
            "a plate height error shows only against a hole seen at several other heights; measure some"
        )


def _dlt(xyz: Array, uv: Array, to_xyz: Array, to_uv: Array) -> Array:
    """First eleven entries of the normalised projection, the twelfth being one."""
    p = np.column_stack([xyz, np.ones(len(xyz))]) @ to_xyz.T
    q = uv @ to_uv[:2, :2].T + to_uv[:2, 2]
    zero = np.zeros_like(p)
    matrix = np.vstack([np.hstack([p, zero, -q[:, :1] * p]), np.hstack([zero, p, -q[:, 1:] * p])])
    h = np.linalg.svd(matrix)[2][-1]
    return np.asarray(h[:11] / h[11])


def _project(P: Array, xyz: Array) -> Array:
    mapped = xyz @ P[:, :3].T + P[:, 3]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
