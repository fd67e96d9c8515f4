"""Scans of a part from several robot poses, joined in the robot's base frame."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.cells.csv_table import read_columns
from stitch.cells.pose_table import POSE_COLUMNS, poses_from_columns
from stitch.errors import InputError
from stitch.frames import Array, Indices
from stitch.measurement.scan import Scan, prepare_scan
from stitch.reading.clouds import read_cloud
from stitch.reading.session_folder import load_session
from stitch.units import METRES

# Fewer points have no neighbourhoods from which normals could be taken.
_MIN_SCAN_POINTS = 50


@dataclass(frozen=True)
class PlacedScans:
    """V scans as they came; where only the scanner's own poses are known, the scanner counts as the flange."""

    names: tuple[str, ...]
    clouds: tuple[Array, ...]  # (N, 3) each, scanner frame
    T_base_flange: Array  # (V, 4, 4) reported
    T_flange_scanner: Array  # (4, 4)
    length_unit: str = "mm"  # as a session states it; a table of scans does not

    @property
    def T_base_scanner(self) -> Array:
        """(V, 4, 4)."""
        return np.asarray(self.T_base_flange @ self.T_flange_scanner)


@dataclass(frozen=True)
class JoinedScans:
    """N points of all scans, base frame, length_unit."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3) unit, towards the scanner
    usable: NDArray[np.bool_]  # (N,) neither edge nor crease nor grazing
    area: Array  # (N,) surface per point
    spacing: float
    noise: float  # 1-sigma across the surface, from the scans themselves

    def take(self, keep: NDArray[np.bool_] | Indices) -> "JoinedScans":
        """The points of a mask or of indices."""
        return JoinedScans(
            self.points[keep], self.normals[keep], self.usable[keep], self.area[keep], self.spacing, self.noise
        )


def join_scans(scans: Sequence[Scan], T_base_scanner: Array) -> JoinedScans:
    """One cloud of scans in their scanner frames and their poses (V, 4, 4)."""
    pairs = list(zip(scans, T_base_scanner, strict=True))
    return JoinedScans(
        np.vstack([frames.transform(T, scan.points) for scan, T in pairs]),
        np.vstack([frames.rotate(T, scan.normals) for scan, T in pairs]),
        np.concatenate([scan.usable for scan in scans]).astype(bool),
        np.concatenate([scan.area for scan in scans]),
        float(np.median([scan.spacing for scan in scans])),
        float(np.median([scan.noise for scan in scans])),
    )


def assemble_scans(placed: PlacedScans) -> JoinedScans:
    """Normals, edges and noise of each scan, then one cloud."""
    pairs = zip(placed.names, placed.clouds, strict=True)
    return join_scans([prepare_scan(name, points) for name, points in pairs], placed.T_base_scanner)


def read_scan_table(file: Path) -> PlacedScans:
    """A table of scans: `file` and the scanner's pose in the base, x y z a_deg b_deg c_deg.

    Raises:
        InputError: the table or a cloud is missing or malformed, or a cloud has too few points.
    """
    table = read_columns(file, "file", POSE_COLUMNS)
    clouds = []
    for name in table.texts["file"]:
        points = read_cloud(file.parent / name).points
        if len(points) < _MIN_SCAN_POINTS:
            raise InputError(f"{file.parent / name}: {len(points)} points are too few; scan again or drop its row")
        clouds.append(points)
    names = [Path(name).stem for name in table.texts["file"]]
    if len(set(names)) < len(names):
        names = [f"{i + 1:03}-{name}" for i, name in enumerate(names)]
    return PlacedScans(tuple(names), tuple(clouds), poses_from_columns(table), np.eye(4))


def read_placed_session(folder: Path, hand_eye: Path) -> PlacedScans:
    """Scans of a session (scanner on the flange) placed by its reported poses and a hand-eye from a JSON file.

    Raises:
        InputError: session or hand-eye is missing or malformed, or they do not belong together.
    """
    session = load_session(folder, at_most=None)
    if session.mount != "eye_in_hand":
        raise InputError(f"{folder / 'session.toml'}: mount is {session.mount!r}; the scanner must ride on the flange")
    clouds = []
    for view in session.views:
        if view.cloud is None or len(view.cloud.points) < _MIN_SCAN_POINTS:
            raise InputError(f"{folder / 'views.csv'}: view {view.name} has too few points; scan again or drop its row")
        clouds.append(view.cloud.points)
    poses = np.array([view.T_base_flange for view in session.views])
    T_flange_scanner = read_hand_eye(hand_eye, session.length_unit)
    names = tuple(session.names)
    return PlacedScans(names, tuple(clouds), poses, T_flange_scanner, session.length_unit)


def read_hand_eye(file: Path, length_unit: str) -> Array:
    """T_flange_scanner (4, 4) in `length_unit` from what `stitch calibrate` or `stitch run` wrote.

    Raises:
        InputError: the file is missing, holds no hand-eye, or one of a scanner that stands in the cell.
    """
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        T, unit = np.array(document["hand_eye"], float), METRES[document["length_unit"]]
        mount = document.get("mount", "eye_in_hand")
    except FileNotFoundError:
        raise InputError(f"{file}: not found; `stitch calibrate sphere SESSION -o {file.name}` writes one") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{file}: holds no hand_eye with length_unit; name what stitch calibrate wrote") from None
    if not frames.is_rigid(T) or mount != "eye_in_hand":
        raise InputError(f"{file}: hand_eye must be a rigid motion of a scanner on the flange (eye_in_hand)")
    T[:3, 3] *= unit / METRES[length_unit]
    return T
