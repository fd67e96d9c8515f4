"""The scans of a part or a seam as a cloud session, with the hand-eye that placed them and their CAD."""

from pathlib import Path

from stitch.cells.window.joined_scans import PlacedScans
from stitch.measurement.cloud import Cloud
from stitch.writing.session_files import SessionFiles, pose_columns


def scan_session(name: str, placed: PlacedScans, cad: Path | None = None) -> SessionFiles:
    """One view for each scan; where the job knew only the scanner's poses, the scanner itself counts as the flange."""
    files = [f"clouds/{view}.ply" for view in placed.names]
    tables = {"scanner": {"pose": placed.T_flange_scanner.tolist()}}
    if cad is not None:
        tables["part"] = {"cad": cad.name, "cad_unit": placed.length_unit}
    return SessionFiles(
        name=name,
        length_unit=placed.length_unit,
        mount="eye_in_hand",
        tables=tables,
        views={"view": placed.names, "cloud": files, **pose_columns(placed.T_base_flange)},
        clouds={file: Cloud(points) for file, points in zip(files, placed.clouds, strict=True)},
        copies=() if cad is None else (cad,),
    )
