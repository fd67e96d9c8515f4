"""What is known of a cell before measuring, from a session without scans; and what a finished run knows of its cell."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.diagnosis.diagnose import linear_model_of
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.capture import build_capture
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.planning.expected_model import FEWEST, CellModel, expected_scans
from stitch.planning.expected_scan import FieldOfView
from stitch.planning.planned_part import PlannedPart, block_surface, surface_of_file, thinned_surface
from stitch.planning.scatter import FittedScatter, scatter_of_run, stated_scatter
from stitch.reading.clouds import read_cloud
from stitch.runs.state import RunState
from stitch.units import METRES, length_text

# Full angle of the field where nobody states it, and how far it reaches about the standoff.
USUAL_FIELD_DEG, _DEPTH = 30.0, 0.3
# Of what a run's scanner saw, the share that counts as its field, and what is added to it.
_SEEN, _MARGIN = 0.99, 0.1


@dataclass(frozen=True)
class PlannedCell:
    """A cell, and in words what nobody stated of it."""

    cell: CellModel
    assumed: tuple[str, ...]
    fitted_scatter: FittedScatter | None = None  # errors that a run has found


def cell_of_session(
    session: Session, part: Path | None = None, size_mm: float | None = None, field_deg: float | None = None
) -> PlannedCell:
    """The cell as session.toml and the options describe it.

    Args:
        part: mesh, or cloud with normals, in length_unit; None: the session's CAD, or a block of `size_mm`.
        field_deg: full angle of the scanner's field.

    Raises:
        InputError: a session that does not say where the scanner sits or how far it sees, or an unknown part.
    """
    file, scanner = session.path / "session.toml", session.scanner
    if scanner.T_mount is None:
        raise InputError(f"{file}: no scanner.pose; to fix: state about where the scanner sits, a plan begins there")
    if scanner.standoff is None:
        raise InputError(f"{file}: no scanner.standoff; to fix: state the distance at which the scanner sees the part")
    if scanner.kind not in (None, "area", "line"):
        raise InputError(
            f"{file}: scanner.kind is {scanner.kind}; plans are made for scans; to fix: run it, then stitch next"
        )
    scatter, assumed = stated_scatter(session), list[str]()
    half = np.tan(np.radians((field_deg or USUAL_FIELD_DEG) / 2))
    if field_deg is None:
        assumed.append(f"the scanner's field is {USUAL_FIELD_DEG:.0f}° wide (--field)")
    near, far = scanner.standoff * (1 - _DEPTH), scanner.standoff * (1 + _DEPTH)
    field = FieldOfView(np.array([half, half]), near, far, standoff=scanner.standoff, axis=scanner.optical_axis)
    surface, words = _part_of_session(session, part, size_mm)
    cell = CellModel(Model(scanner.T_mount), surface, field, scatter)
    poses = _scanner_poses(session, scanner.T_mount)
    counts = np.array([len(index) for index in expected_scans(cell, poses)])
    if words or np.mean(counts >= FEWEST) < 0.5:
        # Where nobody says where the part is, it is where the views look.
        looked_at = frames.transform(poses, (scanner.standoff * scanner.optical_axis)[None])[:, 0].mean(axis=0)
        cell = replace(cell, part=surface.moved(frames.make(np.eye(3), looked_at - surface.centre)))
        words += ["the part is where the views look"]
    return PlannedCell(cell, (*scatter.assumed, *assumed, *words))


def cell_of_run(state: RunState, folder: Path) -> PlannedCell:
    """The cell as a run found it: its model, its scatter, its fused cloud, the field that its scans fill.

    Raises:
        InputError: a run of labelled points, or one without its cloud.
    """
    if not state.session.has_clouds:
        raise InputError(f"{folder}: a run of labelled points; plans are made for scans; to fix: stitch next {folder}")
    file = folder / "stitched.ply"
    cloud = read_cloud(file)
    if cloud.normals is None:
        raise InputError(f"{file}: has no normals; to fix: stitch run {state.session.path} -o {folder}")
    return cell_of_state(state, cloud.points, cloud.normals)


def cell_of_state(state: RunState, points: Array, normals: Array) -> PlannedCell:
    """Return the cell as a run found it.

    Args:
        points, normals: (N, 3) of its stitched cloud, reference frame, length_unit.
    """
    scans = state.measurement.capture.scans
    seen = np.concatenate([scan.points for scan in scans])
    reach = np.linalg.norm(seen, axis=1)
    slopes = np.abs(seen[:, :2] / seen[:, 2:])
    near, far = np.quantile(reach, [1 - _SEEN, _SEEN])
    field = FieldOfView(
        np.quantile(slopes, _SEEN, axis=0) * (1 + _MARGIN),
        float(near * (1 - _MARGIN)),
        float(far * (1 + _MARGIN)),
        standoff=state.measurement.views.standoff,
        axis=state.session.scanner.optical_axis,
    )
    noise = float(np.nanmedian([scan.noise for scan in scans]))
    told = scatter_of_run(linear_model_of(state), noise)
    return PlannedCell(CellModel(state.model, thinned_surface(points, normals), field, told.believed), (), told)


def _part_of_session(session: Session, part: Path | None, size_mm: float | None) -> tuple[PlannedPart, list[str]]:
    """The part's surface, and what is assumed of it."""
    unit = METRES[session.length_unit]
    if part is not None:
        return surface_of_file(part, 1.0), []
    if size_mm is not None:
        size = size_mm * METRES["mm"] / unit
        return block_surface(size), [f"the part is a block, {length_text(size, session.length_unit)} long (--part)"]
    if session.cad is not None:
        return surface_of_file(session.cad, METRES[session.cad_unit or session.length_unit] / unit), []
    raise InputError(
        f"{session.path}: nobody says what is scanned; to fix: --part MESH, or --size MM of its longest side"
    )


def _scanner_poses(session: Session, T_mount: Array) -> Array:
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    return build_capture(session.name, (), T_base_flange, session.mount).poses(T_mount)
