"""Scans in formats of other trades: meshes (STL, OBJ, OFF, glTF), NumPy arrays, PTX, and E57 and LAS by their packages.

A mesh counts by its vertices, with the normals of its faces. A file with several scans is refused; points stay in the
scanner's own frame.
"""

from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.depth_image import is_depth_image, read_depth_columns
from stitch.reading.extras import import_extra
from stitch.reading.organised import measured_pixels

MESHES = (".stl", ".obj", ".off", ".glb", ".gltf")
_PTX_HEADER = 10


def read_mesh(path: Path) -> dict[str, Array]:
    """Columns (N,) of the vertices, each once, with the mean normal of the faces around them where there are faces."""
    import trimesh

    scene = trimesh.load_scene(str(path))
    pieces = [g for g in scene.dump() if hasattr(g, "vertices") and len(g.vertices)]
    if not pieces:
        raise InputError(f"{path}: holds no surface; export the scan again")
    points, normals = [], []
    for piece in pieces:
        if getattr(piece, "faces", None) is not None and len(piece.faces):
            piece.merge_vertices(merge_norm=True, merge_tex=True)
            normals.append(np.asarray(piece.vertex_normals))
        points.append(np.asarray(piece.vertices))
    columns = dict(zip("xyz", np.vstack(points).T, strict=True))
    if len(normals) == len(points):
        columns |= dict(zip(("nx", "ny", "nz"), np.vstack(normals).T, strict=True))
    return columns


def read_array(path: Path) -> dict[str, Array]:
    """NumPy's .npy: (N, 3) or more columns, an image (H, W, 3) whose empty pixels are NaN, or a depth image (H, W)."""
    if is_depth_image(path):
        return read_depth_columns(path)
    array = np.load(path, allow_pickle=False)
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise InputError(f"{path}: an array {array.shape} is no cloud; save (N, 3) or (H, W, 3) numbers")
    table = array.reshape(-1, array.shape[-1])
    names = [*"xyz", *(f"scalar_{i}" for i in range(table.shape[1] - 3))]
    columns = dict(zip(names, table.T, strict=True))
    return measured_pixels(columns) if array.ndim == 3 else columns


def read_ptx(path: Path) -> dict[str, Array]:
    """Columns (N,) of Leica's PTX.

    The file has columns, rows, ten lines of frames, then x y z intensity; 0 0 0 where nothing was measured.
    """
    lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    count = int(lines[0]) * int(lines[1])
    rows = lines[_PTX_HEADER : _PTX_HEADER + count]
    if len(rows) < count:
        raise InputError(f"{path}: {count} points announced, data for {len(rows)}; export it again")
    if any(line.strip() for line in lines[_PTX_HEADER + count :]):
        raise InputError(_several_scans_message(path, "several scans"))
    table = np.loadtxt(rows, ndmin=2)
    return dict(zip([*"xyz", "intensity"], table.T, strict=False))


def read_las(path: Path) -> dict[str, Array]:
    """Columns (N,) x, y, z and intensity of LAS and LAZ, by laspy."""
    las = import_extra("laspy", path, "formats").read(path)
    xyz = np.asarray(las.xyz, float)
    return {**dict(zip("xyz", xyz.T, strict=True)), "intensity": np.asarray(las.intensity, float)}


def read_e57(path: Path) -> dict[str, Array]:
    """Columns (N,) of the one scan of an E57 in its own frame, by pye57."""
    file = import_extra("pye57", path, "formats").E57(str(path))
    if file.scan_count != 1:
        raise InputError(_several_scans_message(path, f"{file.scan_count} scans"))
    scan = file.read_scan(0, ignore_missing_fields=True, transform=False)
    columns = {axis: np.asarray(scan[f"cartesian{axis.upper()}"], float) for axis in "xyz"}
    if "intensity" in scan:
        columns["intensity"] = np.asarray(scan["intensity"], float)
    return measured_pixels(columns)


def _several_scans_message(path: Path, held: str) -> str:
    return f"{path}: holds {held}, a file is one view; to fix: export every scan to a file of its own"
