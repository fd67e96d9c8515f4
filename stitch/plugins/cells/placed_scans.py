"""Scans of a part from several robot poses, joined in the robot's base frame, and how their places may err.

Scans lie where the robot and the hand-eye put them, and each of these errs (`PlacingErrors`). An error is a sum of
modes of unit variance: small motions of points. A fit that answers a motion linearly takes up the covariance of all
modes as the sum of its squared answers, whatever it fits.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import METRES
from stitch.plugins.cells.job_files import POSE_COLUMNS, JobTable, poses_from_columns, read_columns
from stitch.session.axis_poses import require_placed
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.session_folder import load_session
from stitch.session.scan import Scan, prepare_scan
from stitch.session.session import SessionData

# Fewer points have no neighbourhoods from which normals could be taken.
_MIN_SCAN_POINTS = 50
# Columns of views.csv: the flange's velocity in the base (length_unit/s) while a line scanner sweeps without turning.
SWEEP = ("sweep_x", "sweep_y", "sweep_z")
SOURCES = ("hand_eye", "robot", "carriage", "scanner")
# Smooth errors along the ray: products of Legendre polynomials over the field up to this degree, without a constant.
_FIELD_DEGREE = 2


@dataclass(frozen=True)
class PlacedScans:
    """V scans as they came; where only the scanner's own poses are known, the scanner counts as the flange."""

    names: tuple[str, ...]
    clouds: tuple[Array, ...]  # (N, 3) each, scanner frame
    T_base_flange: Array  # (V, 4, 4) reported
    T_flange_scanner: Array  # (4, 4)
    length_unit: str = "mm"  # as a session states it; a table of scans does not
    carried: tuple[Array, ...] = ()  # (N, 3) each: how far the flange had moved when a sweep saw each point, base frame
    errors: "PlacingErrors | None" = None  # None: nobody says how the places may err
    columns: tuple[Mapping[str, float], ...] = ()  # of each scan in its session, those that are no pose

    @property
    def T_base_scanner(self) -> Array:
        """(V, 4, 4)."""
        return self.T_base_flange @ self.T_flange_scanner


@dataclass(frozen=True)
class JoinedScans:
    """N points of all scans, base frame, length_unit."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3) unit, towards the scanner
    usable: NDArray[np.bool_]  # (N,) neither edge nor crease nor grazing
    area: Array  # (N,) surface per point
    spacing: float
    noise: float  # 1-sigma across the surface, from the scans themselves
    view: Indices  # (N,) the scan that a point comes from
    carried: Array | float = 0.0  # (N, 3) how far a sweep had moved the flange then, base frame

    def take(self, keep: NDArray[np.bool_] | Indices) -> "JoinedScans":
        """The points of a mask or of indices."""
        carried = self.carried[keep] if isinstance(self.carried, np.ndarray) else self.carried
        return replace(
            self,
            points=self.points[keep],
            normals=self.normals[keep],
            usable=self.usable[keep],
            area=self.area[keep],
            view=self.view[keep],
            carried=carried,
        )


def join_scans(scans: Sequence[Scan], T_base_scanner: Array) -> JoinedScans:
    """Return one cloud of scans in their scanner frames and their poses (V, 4, 4)."""
    pairs = list(zip(scans, T_base_scanner, strict=True))
    return JoinedScans(
        np.vstack([frames.transform(T, scan.points) for scan, T in pairs]),
        np.vstack([frames.rotate(T, scan.normals) for scan, T in pairs]),
        np.concatenate([scan.usable for scan in scans]).astype(bool),
        np.concatenate([scan.area for scan in scans]),
        float(np.median([scan.spacing for scan in scans])),
        float(np.median([scan.noise for scan in scans])),
        np.repeat(np.arange(len(scans)), [len(scan.points) for scan in scans]),
    )


def assemble_scans(placed: PlacedScans) -> JoinedScans:
    """Return one cloud of all scans, after normals, edges and noise of each."""
    pairs = zip(placed.names, placed.clouds, strict=True)
    joined = join_scans([prepare_scan(name, points) for name, points in pairs], placed.T_base_scanner)
    return replace(joined, carried=np.vstack(placed.carried)) if placed.carried else joined


def with_part_yet_to_place(placed: PlacedScans, part: PlacedScans, T: Array) -> PlacedScans:
    """Return both sets of scans as one, those of a part as if a robot had moved it by T (4, 4) of the base frame."""
    first, poses = len(placed.names), np.concatenate([placed.T_base_flange, T @ part.T_base_flange])
    carried = [
        of.carried or tuple(np.zeros_like(cloud) for cloud in of.clouds)
        for of in (placed, replace(part, carried=tuple(moved @ T[:3, :3].T for moved in part.carried)))
    ]
    seen = [frames.transform(S, cloud.mean(axis=0)) for S, cloud in zip(part.T_base_scanner, part.clouds, strict=True)]
    held = T @ frames.make(np.eye(3), np.mean(seen, axis=0))
    errors = placed.errors
    if errors is not None:
        stop = errors.stop
        if stop is not None and part.errors is not None and part.errors.stop is not None:
            stop = np.concatenate([stop, stop.max() + 1 + part.errors.stop])
        errors = replace(errors, T_base_flange=poses, gripped=(first, held), stop=stop)
    return replace(
        placed,
        names=(*placed.names, *(f"part-{name}" for name in part.names)),
        clouds=placed.clouds + part.clouds,
        T_base_flange=poses,
        carried=carried[0] + carried[1] if placed.carried or part.carried else (),
        errors=errors,
    )


def read_scan_table(file: Path) -> PlacedScans:
    """Read a table of scans: `file` and the scanner's pose in the base, x y z a_deg b_deg c_deg.

    Raises:
        InputError: the table or a cloud is missing or malformed, or a cloud has too few points.
    """
    table = read_columns(file, "file", POSE_COLUMNS)
    clouds = []
    for name in table.texts["file"]:
        points = read_cloud(file.parent / name).points
        if len(points) < _MIN_SCAN_POINTS:
            raise InputError(
                f"{file.parent / name}: {len(points)} points are too few; to fix: scan again or drop its row"
            )
        clouds.append(points)
    names = [Path(name).stem for name in table.texts["file"]]
    if len(set(names)) < len(names):
        names = [f"{i + 1:03}-{name}" for i, name in enumerate(names)]
    return PlacedScans(tuple(names), tuple(clouds), poses_from_columns(table), np.eye(4))


def read_placed_session(folder: Path, hand_eye: Path) -> PlacedScans:
    """Read a session's scans (scanner on the flange), placed by its reported poses and a hand-eye from a JSON file.

    With the columns of SWEEP in views.csv each scan is a sweep: points lie in the scanner's frame at their own time.

    Raises:
        InputError: session or hand-eye is missing or malformed, or they do not belong together.
    """
    session = load_session(folder, at_most=None)
    require_placed(session)
    if session.mount != "eye_in_hand":
        raise InputError(
            f"{folder / 'session.toml'}: mount is {session.mount!r}; to fix: take scans with the scanner on the flange"
        )
    clouds = []
    for view in session.views:
        if view.cloud is None or len(view.cloud.points) < _MIN_SCAN_POINTS:
            raise InputError(
                f"{folder / 'views.csv'}: view {view.name} has too few points; to fix: scan again or drop its row"
            )
        clouds.append(view.cloud)
    poses = np.array([view.T_base_flange for view in session.views])
    T_flange_scanner, errors = read_hand_eye(hand_eye, session.length_unit, poses)
    carried = _sweeps(session)
    points = [cloud.points for cloud in clouds]
    if carried:
        back = (poses @ T_flange_scanner)[:, :3, :3]
        points = [cloud + moved @ R for cloud, moved, R in zip(points, carried, back, strict=True)]
    names = tuple(session.names)
    columns = tuple(view.covariates for view in session.views)
    return PlacedScans(names, tuple(points), poses, T_flange_scanner, session.length_unit, carried, errors, columns)


def _sweeps(session: SessionData) -> tuple[Array, ...]:
    """Return how far the flange had moved when each point was seen, (N, 3) a view; empty where no view is a sweep.

    Raises:
        InputError: a sweep whose points have no time.
    """
    if not all(name in session.views[0].covariates for name in SWEEP):
        return ()
    carried = []
    for view in session.views:
        times = {} if view.cloud is None else view.cloud.scalars
        if "time" not in times:
            raise InputError(
                f"{session.path / 'views.csv'}: view {view.name} is a sweep, and the points of its cloud have no time; "
                "to fix: write the scalar time, s after the pose of the view, or leave out sweep_x, sweep_y, sweep_z"
            )
        carried.append(times["time"][:, None] * np.array([view.covariates[name] for name in SWEEP]))
    return tuple(carried)


def read_hand_eye(file: Path, length_unit: str, T_base_flange: Array) -> tuple[Array, "PlacingErrors"]:
    """Return T_flange_scanner (4, 4) in `length_unit`, as `stitch calibrate` or `stitch run` wrote it, and its errors.

    A run knows how the robot's poses scatter; a calibration by a sphere knows by how much the sphere does.

    Raises:
        InputError: the file is missing, holds no hand-eye, or one of a scanner that stands in the cell.
    """
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        T, unit = np.array(document["hand_eye"], float), METRES[document["length_unit"]]
        covariance = np.array(document.get("hand_eye_covariance", np.zeros((6, 6))), float).reshape(6, 6)
        scatter = document.get("repeatability", {})
        shift = float(scatter.get("translation", document.get("scatter_of_views", {}).get("shift", 0.0)))
        turn = float(scatter.get("rotation", 0.0))
        mount = document.get("mount", "eye_in_hand")
    except FileNotFoundError:
        raise InputError(
            f"{file}: not found; to fix: write it with `stitch calibrate sphere SESSION -o {file.name}`"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(
            f"{file}: holds no hand_eye with length_unit; to fix: name what stitch calibrate wrote"
        ) from None
    if not frames.is_rigid(T) or mount != "eye_in_hand":
        raise InputError(
            f"{file}: hand_eye is no rigid motion of a scanner on the flange; to fix: name an eye_in_hand calibration"
        )
    scale = unit / METRES[length_unit]
    T[:3, 3] *= scale
    units = np.repeat([1.0, scale], 3)
    hand_eye = covariance * np.outer(units, units)
    return T, PlacingErrors(T_base_flange, T, hand_eye, rotation=turn, translation=shift * scale)


@dataclass(frozen=True)
class PlacingErrors:
    """1-sigmas; rotations in rad, lengths in the length unit of the scans."""

    T_base_flange: Array  # (V, 4, 4) reported
    T_flange_scanner: Array  # (4, 4)
    hand_eye: Array  # (6, 6) covariance of ξ in T_flange_scanner · exp(ξ), rotation first
    rotation: float = 0.0  # of the flange about each axis, new in every view
    translation: float = 0.0  # of the flange along each axis, new in every view
    carriage: float = 0.0  # of the robot's carriage along each axis of the base, the same in all views of one stop
    scanner: float = 0.0  # rms over the field of the scanner's smooth error along the ray, the same in all views
    gripped: tuple[int, Array] | None = None  # scans from that one on show a part yet to be moved, held there (4, 4)
    stop: Indices | None = None  # (V,) of the carriage, counted from 0; None: it has no errors

    def modes(self, scan: JoinedScans, source: str) -> Iterator[tuple[Indices, Array]]:
        """Yield the modes of one of SOURCES: which points move (M,), and by how much in the base frame (M, 3)."""
        # Where a sweep's points would lie had the flange not moved: what errs, errs about the flange then.
        still = scan.points - scan.carried
        everything = np.arange(len(scan.points))
        if source == "hand_eye":
            T = self.T_base_flange @ self.T_flange_scanner
            values, vectors = np.linalg.eigh(self.hand_eye)
            for xi in (vectors * np.sqrt(np.maximum(values, 0.0))).T:
                if xi.any():
                    yield everything, _moved(T[scan.view], still, xi)
        elif source == "robot":
            for view in np.unique(scan.view):
                index = np.flatnonzero(scan.view == view)
                for xi in np.diag(np.repeat([self.rotation, self.translation], 3)):
                    if xi.any():
                        yield index, _moved(self.T_base_flange[view], still[index], xi)
            if self.gripped is not None:
                index = np.flatnonzero(scan.view >= self.gripped[0])
                # The robot goes to it, and with it to its place: two moves.
                shift = np.hypot(self.translation, self.carriage)
                for xi in np.sqrt(2) * np.diag(np.repeat([self.rotation, shift], 3)):
                    yield index, _moved(self.gripped[1], scan.points[index], xi)
        elif source == "carriage":
            stops = np.zeros(0, int) if self.stop is None else self.stop[scan.view]
            for stop in np.unique(stops):
                index = np.flatnonzero(stops == stop)
                yield from ((index, np.tile(shift, (len(index), 1))) for shift in self.carriage * np.eye(3))
        elif self.scanner:
            yield from ((everything, self.scanner * mode) for mode in self._field_modes(scan))

    def _field_modes(self, scan: JoinedScans) -> Iterator[Array]:
        T = (self.T_base_flange @ self.T_flange_scanner)[scan.view]
        ray = scan.points - scan.carried - T[:, :3, 3]
        local = np.einsum("nji,nj->ni", T[:, :3, :3], ray)
        image = local[:, :2] / local[:, 2:]
        # From −1 to 1 over what was scanned of the field.
        low = image.min(axis=0)
        high = image.max(axis=0)
        scaled = 2 * (image - low) / np.maximum(high - low, 1e-12) - 1
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        u, v = (np.polynomial.legendre.legvander(axis, _FIELD_DEGREE) for axis in scaled.T)
        orders = [order for order in product(range(_FIELD_DEGREE + 1), repeat=2) if 0 < sum(order) <= _FIELD_DEGREE]
        for i, j in orders:
            size = np.sqrt((2 * i + 1) * (2 * j + 1) / len(orders))
            yield ray * (size * u[:, i] * v[:, j])[:, None]


def _moved(T: Array, points: Array, xi: Array) -> Array:
    """Return the motion (M, 3), base frame, of points (M, 3) when frames T (4, 4) or (M, 4, 4) become T · exp(ξ)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    local = np.einsum("...ji,...j->...i", R, points - t)
    return np.einsum("...ij,...j->...i", R, np.cross(xi[:3], local) + xi[3:])


def stated_errors(document: JobTable, placed: PlacedScans) -> PlacingErrors | None:
    """Return the errors of `placed`, with those in their place that a job's table [errors] states.

    Raises:
        InputError: an unknown key, or something that is no number.
    """
    table = document.table("errors", ("rotation", "translation", "carriage", "carriage_column", "scanner"))
    if not table.entries:
        return placed.errors
    known = placed.errors or exact_placing(placed)
    carriage = abs(table.number("carriage", 0.0))
    return replace(
        known,
        rotation=abs(table.number("rotation", known.rotation)),
        translation=abs(table.number("translation", known.translation)),
        carriage=carriage,
        scanner=abs(table.number("scanner", known.scanner)),
        stop=_stops(table, placed) if carriage else None,
    )


def exact_placing(placed: PlacedScans) -> PlacingErrors:
    """Return errors of which none is known yet."""
    return PlacingErrors(placed.T_base_flange, placed.T_flange_scanner, np.zeros((6, 6)))


def _stops(table: JobTable, placed: PlacedScans) -> Indices:
    """Return the carriage's stop (V,) of each scan: it stands where its column of views.csv says the same."""
    if not placed.columns:
        raise table.refusal("carriage", "leave it out, for a table of scans does not say where a carriage stood")
    shared = [name for name in placed.columns[0] if all(name in row for row in placed.columns)]
    column = table.choice("carriage_column", shared)
    return np.unique([row[column] for row in placed.columns], return_inverse=True)[1].ravel()
