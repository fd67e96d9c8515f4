"""What drilling needs of its sensors: base frame, camera, range sensors, the tool's axis, and groups of holes.

Near the work plane the camera is a homography. Beyond it, it is a 3x4 projection with radial distortion and an error of
the plate's height. On one plane these are hidden: a homography takes up a wrong height completely, and distortion
partly. A hole seen at many places and heights, which robot and rangers measure, shows them.

The tool's true axis follows from how the robot reports to stand when the tool is upright on a hole. The rigid motion of
hole positions cannot see a tool frame that is turned against the tool; the reference holes can: there the rangers made
the tool upright, so the hole's direction in the reported tool frame is the tool's axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import f_tail
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array
from stitch.plugins.cells.job_files import on_a_line
from stitch.system.packages import import_extra

# Axes closer than this (rad) to parallel leave the y axis to noise.
_PARALLEL = np.radians(5.0)
# Effects by the names that a report uses.
CAMERA_EFFECTS = ("k1", "plate_height")
_UNDISTORT_STEPS = 20
# An effect enters when chance would do as well in less than one of a thousand cases, and the BIC agrees.
_EFFECT_P_LIMIT = 1e-3
# With half a dozen reference holes a smaller limit would hide tilts of a degree.
_TILT_P_LIMIT = 0.01
_MIN_HOLES = 4
_MIN_HOLE_WIDTH = 20.0  # pixels


def base_frame(joint6_path: Array, joint1_path: Array, height_joint6: float = 0.0) -> Array:
    """Return T_measuring_base (4, 4) from marker paths (N, 3) in the measuring system, at the home pose.

    The axis of joint 6 is x, that of joint 1 is z, y = z × x (source, formulas 1 and 2). The origin lies on the axis
    of joint 1, `height_joint6` below the axis of joint 6. The paths run in the right-hand sense of x and z.

    Raises:
        NoResultError: a path is no circle, or both axes are parallel.
    """
    centre6, x6, _ = fit_circle(joint6_path)
    centre1, z, _ = fit_circle(joint1_path)
    y = np.cross(z, x6)
    if np.linalg.norm(y) < np.sin(_PARALLEL):
        raise NoResultError("the axes of joint 1 and joint 6 are parallel at this pose; to fix: move to the home pose")
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    # The foot of the common normal: c1 + a z and c6 + b x6 at their closest.
    foot = np.linalg.lstsq(np.column_stack([z, -x6]), centre6 - centre1, rcond=None)[0][0]
    return frames.make(np.column_stack([x, y, z]), centre1 + (foot - height_joint6) * z)


def fit_circle(points: Array) -> tuple[Array, Array, float]:
    """Return centre (3,), axis (3,) and radius of the circle through points (N, 3).

    Plane by SVD, then least squares of the distances within it. The axis is a unit vector that follows the right-hand
    rule along the order of the points.

    Raises:
        NoResultError: fewer than four points, or points on a line.
    """
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    if len(points) < 4 or spread[1] < 1e-6 * spread[0]:
        raise NoResultError(
            "a circle needs four or more marker positions that do not lie on a line; to fix: turn the joint further"
        )
    flat = (points - middle) @ axes[:2].T
    # Algebraic circle |p|² = 2 c·p + k as a start.
    solved = np.linalg.lstsq(np.column_stack([2 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None)[0]
    start = np.append(solved[:2], np.sqrt(max(solved[2] + solved[:2] @ solved[:2], 0.0)))
    x = least_squares(lambda c: np.linalg.norm(flat - c[:2], axis=1) - c[2], start, method="lm").x
    centre = middle + x[:2] @ axes[:2]
    arms = points - centre
    swept = np.cross(arms[:-1], arms[1:]).sum(axis=0)
    return centre, axes[2] * np.sign(axes[2] @ swept), float(x[2])


def fit_homography(xy: Array, uv: Array) -> Array:
    """Return H (3, 3) with s·[u v 1]ᵀ = H·[x y 1]ᵀ, from N ≥ 4 points (N, 2) each; source, formula 5.

    Normalised DLT (Hartley 1997), then least squares of the image distances in pixels.

    Raises:
        NoResultError: fewer than four points, or points on a line.
    """
    if len(xy) < 4:
        raise NoResultError(
            f"a homography needs four or more holes, {len(xy)} are given; to fix: find more of them in the image"
        )
    to_xy = _normaliser(xy)
    to_uv = _normaliser(uv)
    start, values = _direct_linear_transform(xy, uv, to_xy, to_uv)
    if values[7] < 1e-9 * values[0]:
        raise NoResultError("the holes lie on a line and fix no homography; to fix: use holes spread over the plane")
    p = _project(to_xy, xy)
    q = _project(to_uv, uv)

    def matrix_of(x: Array) -> Array:
        return np.append(x, 1.0).reshape(3, 3)

    refined = least_squares(lambda x: (_project(matrix_of(x), p) - q).ravel(), start, method="lm").x
    H = np.linalg.inv(to_uv) @ matrix_of(refined) @ to_xy
    return H / H[2, 2]


def to_plane(H: Array, uv: Array) -> Array:
    """Return work-plane points (..., N, 2) of image points in pixels; source, formula 13."""
    return _project(np.asarray(np.linalg.inv(H), float), uv)


def leave_one_out(xy: Array, uv: Array) -> Array:
    """Return errors (N, 2) in the work plane: each hole mapped by a homography of the others, minus its true place."""
    errors = np.zeros_like(xy)
    for i in range(len(xy)):
        keep = np.arange(len(xy)) != i
        errors[i] = to_plane(fit_homography(xy[keep], uv[keep]), uv[i : i + 1])[0] - xy[i]
    return errors


def _normaliser(points: Array) -> Array:
    """Return the similarity (d+1, d+1) that brings points (N, d) to mean 0 and mean distance √d (Hartley 1997)."""
    mean = points.mean(axis=0)
    size = points.shape[1]
    scale = np.sqrt(size) / max(float(np.linalg.norm(points - mean, axis=1).mean()), np.finfo(float).tiny)
    matrix = np.diag([scale] * size + [1.0])
    matrix[:size, size] = -scale * mean
    return matrix


def _direct_linear_transform(points: Array, uv: Array, to_points: Array, to_uv: Array) -> tuple[Array, Array]:
    """Return the normalised projection of points (N, d) onto image points, without its last entry, and singular values.

    The last entry is one. In normalised coordinates the points' centre maps near the image's, so it is far from zero.
    """
    p = np.column_stack([_project(to_points, points), np.ones(len(points))])
    q = _project(to_uv, uv)
    zero = np.zeros_like(p)
    matrix = np.vstack([np.hstack([p, zero, -q[:, :1] * p]), np.hstack([zero, p, -q[:, 1:] * p])])
    values, vectors = np.linalg.svd(matrix)[1:]
    h = vectors[-1]
    return h[:-1] / h[-1], values


def _project(P: Array, points: Array) -> Array:
    """Return points (..., N, d) through a projective map (k+1, d+1)."""
    mapped = points @ P[:, :-1].T + P[:, -1]
    return mapped[..., :-1] / mapped[..., -1:]


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

    def plane(self, uv: Array, z: float | Array) -> Array:
        """Return x, y (N, 2) in the flange frame of image points (N, 2) at height z, scalar or (N,)."""
        ideal = undistort(uv, self.k1, self.centre, self.corner)
        z = np.broadcast_to(np.asarray(z, float), len(ideal))
        # Rows of u·(P3 X) = P1 X and v·(P3 X) = P2 X, solved for x and y.
        rows = self.P[:2] - ideal[..., None] * self.P[2]
        right = -(rows[..., 2] * z[:, None] + rows[..., 3])
        return np.linalg.solve(rows[..., :2], right[..., None])[..., 0]


def distort(uv: Array, k1: float, centre: Array, corner: float) -> Array:
    """Return real image points of ideal ones (..., 2): away from the centre by k1·(r/corner)² of their distance r."""
    arm = uv - centre
    return centre + arm * (1 + k1 * ((arm / corner) ** 2).sum(axis=-1, keepdims=True))


def undistort(uv: Array, k1: float, centre: Array, corner: float) -> Array:
    """Return ideal image points of real ones (..., 2): `distort` inverted by iteration, for |k1| well below 1/3."""
    arm = real = uv - centre
    for _ in range(_UNDISTORT_STEPS):
        arm = real / (1 + k1 * ((arm / corner) ** 2).sum(axis=-1, keepdims=True))
    return centre + arm


def fit_camera(observations: HoleObservations, effects: tuple[str, ...] = ()) -> CameraFit:
    """Fit the projection and the named effects by least squares of the image distances.

    Raises:
        NoResultError: too few holes, all at one height, or a plate height error asked for without a plate.
    """
    _check_enough(observations, effects)
    centre = np.array(observations.image_size) / 2 - 0.5
    corner = float(np.linalg.norm(observations.image_size) / 2)
    # Normalised as the DLT wants it, for the refinement's conditioning too.
    to_uv = _normaliser(observations.uv)
    to_xyz = _normaliser(observations.xyz)
    start, _ = _direct_linear_transform(observations.xyz, observations.uv, to_xyz, to_uv)

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
            "a camera beyond its work plane needs eight or more holes at different heights; to fix: measure some"
        )
    if "plate_height" in effects and not (
        observations.on_plate.any() and np.unique(observations.xyz[~observations.on_plate, 2]).size > 1
    ):
        raise NoResultError(
            "a plate height error shows only against a hole seen at several other heights; to fix: measure some"
        )


@dataclass(frozen=True)
class CameraEffectTest:
    """One effect tried on top of a fit."""

    effect: str
    value: float
    sigma: float
    F: float
    p_value: float
    bic_change: float  # below zero: the fit with the effect is the better one
    accepted: bool


def select_effects(observations: HoleObservations) -> tuple[CameraFit, list[CameraEffectTest]]:
    """Return the camera with what is accepted of CAMERA_EFFECTS, forwards by F-test and BIC, and the trials in order.

    Raises:
        NoResultError: the observations fix no camera.
    """
    current = fit_camera(observations)
    trials: list[CameraEffectTest] = []
    while len(current.effects) < len(CAMERA_EFFECTS):
        fits = [fit_camera(observations, (*current.effects, e)) for e in CAMERA_EFFECTS if e not in current.effects]
        tried = [_test_effect(current, bigger) for bigger in fits]
        best = int(np.argmin([t.bic_change for t in tried]))
        trials.append(tried[best])
        if not tried[best].accepted:
            trials += [t for i, t in enumerate(tried) if i != best]
            break
        current = fits[best]
    return current, trials


def _test_effect(smaller: CameraFit, bigger: CameraFit) -> CameraEffectTest:
    count = bigger.residuals.size
    free = count - 11 - len(bigger.effects)
    F = (smaller.sum_of_squares - bigger.sum_of_squares) / (bigger.sum_of_squares / free)
    bic = count * np.log(bigger.sum_of_squares / smaller.sum_of_squares) + np.log(count)
    p = f_tail(max(F, 0.0), 1, free)
    effect = bigger.effects[-1]
    value = bigger.k1 if effect == "k1" else bigger.plate_height
    accepted = bool(p < _EFFECT_P_LIMIT and bic < 0)
    return CameraEffectTest(
        effect, value, bigger.sigma[effect], F=float(F), p_value=p, bic_change=float(bic), accepted=accepted
    )


@dataclass(frozen=True)
class GroupCompensation:
    """Nominal to actual drive coordinates of one group."""

    T_actual_nominal: Array  # (4, 4)
    residuals: Array  # (N, 3) actual minus mapped
    errors: Array  # (N, 3) drive errors, actual minus nominal


def compensate_group(nominal: Array, actual: Array) -> GroupCompensation:
    """Return the rigid motion of three or more reference holes (N, 3) by SVD (Kabsch 1976; source, formulas 15, 16).

    Raises:
        NoResultError: fewer than three holes, or holes on a line.
    """
    if len(nominal) < 3 or on_a_line(nominal) or on_a_line(actual):
        raise NoResultError("a group needs three or more reference holes off one line; to fix: add a reference hole")
    T = align_points(nominal, actual)
    return GroupCompensation(T, actual - frames.transform(T, nominal), actual - nominal)


def hole_rotation(direction: Array) -> Array:
    """Return R_base_hole (..., 3, 3): z = hole direction, x = (z2, −z1, 0)/norm, y = z × x (source, formulas 6 to 9).

    The x axis of a vertical hole, which the formula leaves open, is the x axis of the base.
    """
    z = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    x = np.stack([z[..., 1], -z[..., 0], np.zeros_like(z[..., 0])], axis=-1)
    size = np.linalg.norm(x, axis=-1, keepdims=True)
    x = np.where(size > 1e-9, x / np.maximum(size, 1e-9), [1.0, 0.0, 0.0])
    return np.stack([x, np.cross(z, x), z], axis=-1)


def euler_zyx(R: Array) -> Array:
    """Return angles (..., 3) in rad about z, y', x'' (A, B, C of a KUKA controller): R = Rz(A) Ry(B) Rx(C)."""
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_euler("ZYX").reshape(*R.shape[:-2], 3)


def holes_of_plate(picture: Path) -> Array:
    """Return the centres (9, 2) of the plate's holes in a picture, from the top, each row from the left.

    Raises:
        InputError: no OpenCV, no picture, or another number of holes.
    """
    try:
        return order_grid(find_holes(_read_picture(picture)))
    except NoResultError as error:
        raise InputError(f"{picture}: {error}") from None


def hole_at_tool(picture: Path, H: Array) -> Array:
    """Return the centre (2,) of the hole nearest the tool's axis, by the homography of the work plane.

    Raises:
        InputError: no OpenCV, no picture, or no hole in it.
    """
    centres = find_holes(_read_picture(picture))
    if not len(centres):
        raise InputError(f"{picture}: no hole is found; to fix: light the part evenly, or write u, v in the CSV")
    middle = _project(H, np.zeros((1, 2)))
    return centres[np.linalg.norm(centres - middle, axis=1).argmin()]


def _read_picture(file: Path) -> NDArray[np.uint8]:
    """Read one grey channel of 8 bits."""
    cv2 = import_extra("cv2", file, "vision")
    if not file.is_file():
        raise InputError(f"{file}: not found; to fix: correct its name, relative to the file that names it")
    picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise InputError(f"{file}: is no picture that OpenCV reads; to fix: save it as PNG, JPEG or TIFF")
    return np.asarray(picture, np.uint8)


def find_holes(image: NDArray[np.uint8]) -> Array:
    """Return centres (N, 2) in pixels of the dark, nearly elliptic spots wider than 20 pixels.

    (0, 0) is a pixel's middle. A spot's centre is the grey-weighted mean over its surroundings, so that partly covered
    edge pixels count.

    Raises:
        InputError: OpenCV is not installed, or the image is not one grey channel.
    """
    cv2 = import_extra("cv2", "holes in a picture", "vision")
    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(
            f"the image has shape {image.shape} and type {image.dtype}; to fix: give one grey channel of 8 bits"
        )
    _, mask = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    centres = []
    for contour in contours:
        if len(contour) < 20:
            continue
        _, (a, b), _ = cv2.fitEllipse(contour)
        area = cv2.contourArea(contour)
        # Scratches and letters fill their ellipse badly; a hole fills it to a few per cent.
        if min(a, b) >= _MIN_HOLE_WIDTH and abs(area / (np.pi * a * b / 4) - 1) <= 0.1:
            centres.append(_centroid(image, cv2.boundingRect(contour)))
    return np.array(centres, float).reshape(-1, 2)


def order_grid(centres: Array) -> Array:
    """Return centres (9, 2) of a plate of 3 × 3 holes, sorted by rows from the top and by columns from the left.

    Raises:
        NoResultError: another number of holes.
    """
    if len(centres) != 9:
        raise NoResultError(
            f"{len(centres)} holes found, 9 expected; to fix: light the plate evenly and keep it in the picture"
        )
    by_row = centres[np.argsort(centres[:, 1])].reshape(3, 3, 2)
    return np.concatenate([row[np.argsort(row[:, 0])] for row in by_row])


def _centroid(image: NDArray[np.uint8], box: tuple[int, int, int, int]) -> Array:
    """Return the mean of the pixels in and just around a box, weighted by how much darker they are than the plate."""
    u, v, width, height = box
    margin = 6
    rows = slice(max(v - margin, 0), v + height + margin)
    columns = slice(max(u - margin, 0), u + width + margin)
    patch = image[rows, columns].astype(float)
    plate = float(np.median(np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])))
    # Noise on the plate must not pull the mean: only what is clearly darker counts.
    weight = np.where(patch < plate - 0.1 * (plate - patch.min()), plate - patch, 0.0)
    v_index, u_index = np.mgrid[
        rows.start : rows.start + patch.shape[0], columns.start : columns.start + patch.shape[1]
    ]
    return np.array([(weight * u_index).sum(), (weight * v_index).sum()]) / weight.sum()


@dataclass(frozen=True)
class RangerFit:
    """One beam in the flange frame."""

    origin: Array  # (3,)
    direction: Array  # (3,) unit vector
    rms: float  # of the distances to the planes


def fit_ranger(planes: Array, readings: Array) -> RangerFit:
    """Return the beam from planes (N, 4) Ax + By + Cz + D = 0 in the flange frame and the reading at each, N ≥ 6.

    Solves A(x + d nx) + B(y + d ny) + C(z + d nz) + D = 0 (source, formula 4): linear first, then with |n| = 1.

    Raises:
        NoResultError: fewer than six planes, or planes that leave the beam open.
    """
    planes = planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    normals = planes[:, :3]
    offsets = planes[:, 3]
    matrix = np.hstack([normals, readings[:, None] * normals])
    # Columns of unit size, so that the rank does not depend on the length unit.
    scale = np.linalg.norm(matrix, axis=0)
    if len(planes) < 6 or (scale == 0).any() or np.linalg.cond(matrix / scale) > 1e6:
        raise NoResultError(
            "six or more plane positions are needed, tilted both ways and at different distances; to fix: measure more"
        )
    start = np.linalg.lstsq(matrix, -offsets, rcond=None)[0]
    n0 = start[3:] / np.linalg.norm(start[3:])
    across = np.linalg.svd(n0[None])[2][1:]

    def direction(x: Array) -> Array:
        n = n0 + x[3:] @ across
        return n / np.linalg.norm(n)

    def distances(x: Array) -> Array:
        return ((x[:3] + readings[:, None] * direction(x)) * normals).sum(axis=1) + offsets

    x = least_squares(distances, np.append(start[:3], [0.0, 0.0]), method="lm", x_scale=[100, 100, 100, 1, 1]).x
    return RangerFit(x[:3], direction(x), float(np.sqrt(np.mean(distances(x) ** 2))))


@dataclass(frozen=True)
class ToolAxis:
    """Mean axis, and whether it differs from z by more than its scatter explains."""

    axis: Array  # (3,) unit vector in the reported tool frame
    tilt: float  # rad, from z
    sigma: float  # rad, of the mean
    p_value: float
    accepted: bool

    def orient(self, R_base_hole: Array) -> Array:
        """Return the reported orientation (..., 3, 3) that lays an accepted axis along the hole's z."""
        if not self.accepted:
            return R_base_hole
        turn = np.cross([0.0, 0.0, 1.0], self.axis)
        turn *= self.tilt / np.linalg.norm(turn)
        return R_base_hole @ Rotation.from_rotvec(turn).as_matrix().T


def find_tool_axis(reported: Array, directions: Array) -> ToolAxis | None:
    """Return the axis from reported orientations (N, 3, 3) and hole directions (N, 3), both in the base.

    None below four holes. Hotelling's T² of the two small components against zero (Anderson 2003, section 5.2).
    """
    count = len(reported)
    if count < _MIN_HOLES:
        return None
    local = np.einsum("nji,nj->ni", reported, directions)
    small = local[:, :2]
    scatter = np.cov(small, rowvar=False)
    mean = small.mean(axis=0)
    F = count * mean @ np.linalg.pinv(scatter) @ mean * (count - 2) / (2 * (count - 1))
    p = f_tail(F, 2, count - 2)
    axis = local.mean(axis=0)
    axis /= np.linalg.norm(axis)
    tilt = float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2]))
    return ToolAxis(axis, tilt, float(np.sqrt(np.trace(scatter) / 2 / count)), p, p < _TILT_P_LIMIT)


@dataclass(frozen=True)
class HoleSight:
    """A hole against the tool, by rangers and camera at one pose, in the flange frame."""

    normal: Array  # (3,) unit vector into the part
    offset: Array  # (3,): x', y', h' − h
    uv: Array  # (2,) pixels

    @property
    def tilt(self) -> float:
        """Angle (rad) between the tool's axis and the normal."""
        return float(np.arctan2(np.hypot(self.normal[0], self.normal[1]), self.normal[2]))

    @property
    def in_plane(self) -> float:
        """Distance of the hole from the tool's axis by the camera, e2D of the source."""
        return float(np.hypot(self.offset[0], self.offset[1]))

    def hole(self, T_base_tool: Array) -> Array:
        """Return the hole's drive coordinate (3,): p + R'·(x', y', h' − h) (source, formula 14)."""
        return T_base_tool[:3, 3] + T_base_tool[:3, :3] @ self.offset


@dataclass(frozen=True)
class FlangeSensors:
    """Camera and rangers of the flange, calibrated."""

    H: Array  # (3, 3) work plane to image
    beams: dict[str, RangerFit]
    height: float  # h, of the work plane
    camera: CameraFit | None = None  # beyond the work plane, where check holes show it
    trials: Sequence[CameraEffectTest] = ()  # of its effects

    def in_plane(self, uv: Array, height: float) -> Array:
        """Return x, y (2,) in the flange frame of a hole that the camera saw at uv (2,).

        Where check holes have shown the camera beyond its work plane, at the hole's own height and without the effects
        that were selected; else as if the hole lay in the work plane: a camera tilted by 25° is then off by 0.47 mm for
        each mm.
        """
        if self.camera is not None:
            return self.camera.plane(uv[None], height)[0]
        return to_plane(self.H, uv[None])[0]

    def see(self, ranges: Array, uv: Array) -> HoleSight:
        """Return what three or more ranges (n,) and an image point (2,) say of a hole.

        The plane through the laser points gives normal and height; the height is read on the tool's axis, where the
        source takes the mean of its four points, which is the same if the axis passes their centre.
        """
        beams = self.beams.values()
        spots = np.array([beam.origin + d * beam.direction for beam, d in zip(beams, ranges, strict=True)])
        middle = spots.mean(axis=0)
        normal = np.linalg.svd(spots - middle)[2][2]
        normal = normal * np.sign(normal[2])
        height = float(middle @ normal / normal[2])
        return HoleSight(normal, np.append(self.in_plane(uv, height), height - self.height), uv)
