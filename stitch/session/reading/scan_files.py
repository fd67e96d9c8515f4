"""Columns of one scan as its file has them: PLY, text, meshes, NumPy arrays, and formats of other trades by packages.

A mesh counts by its vertices, with the normals of its faces. A file with several scans is refused; points stay in the
scanner's own frame. Where a scan is stored pixel by pixel, a pixel that measured nothing is NaN three times, and is no
error.
"""

import re
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.reading import announced_points
from stitch.session.reading.csv_files import is_number
from stitch.session.reading.depth_image import is_depth_image, read_depth_columns
from stitch.session.reading.text_files import require_file
from stitch.system.packages import import_extra
from stitch.system.ply_file import vertex_columns

MESHES = (".stl", ".obj", ".off", ".glb", ".gltf")
_COMMENTS = ("#", "//")  # CloudCompare writes the second
TEXTS = (".xyz", ".csv", ".txt", ".asc", ".pts")
# Headers of PCD and PLY are shorter.
_HEADER_BYTES = 65536
_PTX_HEADER = 10
_COLOURS = ("red", "green", "blue")
# Three numbers or more, apart by blanks or semicolons, with commas before the decimals.
_DECIMAL_COMMAS = re.compile(r"(?=.*,)(?:[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?(?:[ \t]+|;[ \t]*|$)){3,}")


def read_ply(path: Path) -> dict[str, Array]:
    """Return the columns of the vertices of a PLY, property -> (N,), in the types of the file.

    Raises:
        InputError: no PLY, or a header that announces more than the file has.
    """
    require_room(path)
    with path.open("rb") as stream:
        if stream.read(3) != b"ply":
            raise InputError(f"{path}: is not a PLY file; export it again, or name it by its kind")
    return vertex_columns(path)


def require_room(path: Path) -> None:
    """Refuse a PLY whose header announces more elements than the file has bytes, before memory is allocated for them.

    Raises:
        InputError: no such file, or names the announced number.
    """
    require_file(path, "name a PLY file")
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(_HEADER_BYTES).split(b"end_header", 1)[0]
    for line in header.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit() and int(words[2]) > size:
            raise InputError(f"{path}: {words[2].decode()} elements announced in {size} bytes; export it again")


def grid_shape(path: Path) -> tuple[int, int] | None:
    """Return (rows, columns) of a PCD or PLY that is stored pixel by pixel; None of any other.

    A PCD has a HEIGHT above 1; a PLY of a range scanner states num_rows and num_cols as obj_info.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES)
    size: dict[bytes, int] = {}
    for line in head.split(b"DATA" if path.suffix.lower() == ".pcd" else b"end_header", 1)[0].splitlines():
        words = line.split()
        if len(words) > 1 and words[-1].isdigit() and (words[0] in (b"WIDTH", b"HEIGHT") or words[0] == b"obj_info"):
            size[words[-2]] = int(words[-1])
    rows = size.get(b"HEIGHT", size.get(b"num_rows", 0))
    return (rows, size.get(b"WIDTH", size.get(b"num_cols", 0))) if rows > 1 else None


def measured_pixels(columns: dict[str, Array]) -> dict[str, Array]:
    """Return columns (N,) without the pixels whose x, y and z are all NaN; without x, y, z as they are."""
    if not all(axis in columns for axis in "xyz"):
        return columns
    empty = np.isnan(np.asarray([columns[axis] for axis in "xyz"], float)).all(axis=0)
    return {name: column[~empty] for name, column in columns.items()} if empty.any() else columns


def read_text_columns(path: Path) -> dict[str, Array]:
    """Return the columns of a text, name -> (N,); cells are separated by comma, semicolon, blanks or tabs.

    A header line names the columns; it may be a comment, if it is the last line before the numbers and names x, y and
    z. Without one they are x, y, z, scalar_0 …. Decimal commas are understood where no comma separates cells.
    """
    text = path.read_text(encoding="utf-8-sig")
    filled = [line for line in text.splitlines() if line.strip()]
    lines = [line for line in filled if not line.lstrip().startswith(_COMMENTS)]
    # Leica's .pts and others write the number of points above them.
    if len(lines) > 1 and lines[0].strip().isdigit() and int(lines[0]) == len(lines) - 1:
        lines = lines[1:]
    if not lines:
        return {axis: np.empty(0) for axis in "xyz"}
    if lines[0].strip() == "Info":
        return _columns_of_gocator(path, lines)
    if _DECIMAL_COMMAS.fullmatch(lines[-1].strip()):
        filled = [line.replace(",", ".") for line in filled]
        lines = [line.replace(",", ".") for line in lines]
    separator = next((s for s in ",;" if s in lines[0]), None)
    names = _column_names(lines[0], separator)
    rows = lines
    if all(is_number(cell) for cell in names):
        comments = [line for line in filled[: filled.index(lines[0])] if not line.strip().isdigit()]
        names = _names_without_header(comments, len(names), separator)
    else:
        rows = lines[1:]
    if not rows:
        return {name: np.empty(0) for name in names}
    table = np.loadtxt(rows, delimiter=separator, ndmin=2).reshape(-1, len(names))
    return dict(zip(names, table.T, strict=True))


def _names_without_header(comments: list[str], count: int, separator: str | None) -> list[str]:
    """Return the names of so many columns: those in the last comment, if it names x, y, z; else x, y, z, scalar_0 …"""
    names = _column_names(comments[-1].lstrip(" #/"), separator) if comments else []
    if len(names) == count and {*"xyz"} <= {*names}:
        return names
    return [*"xyz", *(f"scalar_{i}" for i in range(count - 3))][:count]


# Sections of surfaces in a CSV of Gocator; each begins with so many lines: its name, names of attributes, their values.
_SURFACES, _POINTS = ("Part", "Surface"), "SurfacePointCloud"
_SECTION_HEAD = 3


def _columns_of_gocator(path: Path, lines: list[str]) -> dict[str, Array]:
    """Return x, y, z (N,), mm, scanner frame, of the first surface in a CSV of Gocator, empty pixels left out.

    The section of a surface, here of a point cloud with three measured pixels of four, is

        SurfacePointCloud
        Frame,Source
        0,0
        x,y,z
        0.5,10,7.25,-1.5,12,7.5
        0.5,12,8,,,
        End

    Args:
        lines: of the file, comments and empty ones left out.

    Raises:
        InputError: no surface in it, or a row of a point cloud that is not three numbers a pixel.
    """
    begin = next((i for i, line in enumerate(lines) if line.strip(" ,\r") in (*_SURFACES, _POINTS)), None)
    if begin is None:
        raise InputError(f"{path}: holds no surface; export the surface, not its profiles")
    end = next((i for i in range(begin, len(lines)) if lines[i].startswith("End")), len(lines))
    heading, *rows = ([cell.strip() for cell in line.split(",")] for line in lines[begin + _SECTION_HEAD : end])
    # The heading of heights holds their x; that of a point cloud says nothing.
    is_cloud = lines[begin].startswith(_POINTS)
    return measured_pixels(_columns_of_points(path, rows) if is_cloud else _columns_of_heights(heading, rows))


def _columns_of_points(path: Path, rows: list[list[str]]) -> dict[str, Array]:
    """Return x, y, z (N,), mm, of the pixels of a point cloud of Gocator, all NaN where nothing was measured.

    A row holds x, y, z of each of its pixels, side by side. Empty cells after its last whole pixel are no pixel.

    Raises:
        InputError: a row with text, or whose numbers are not three a pixel: those after it would be of other axes.
    """
    cells: list[str] = []
    for number, row in enumerate(rows, 1):
        whole = len(row) // 3 * 3
        if any(row[whole:]) or not all(is_number(cell or "nan") for cell in row):
            where = f"{path}: row {number} of its point cloud has {len(row)} cells"
            raise InputError(f"{where}, not x, y, z of each pixel; to fix: export the surface again, unedited")
        cells += row[:whole]
    pixels = np.array([float(cell or "nan") for cell in cells]).reshape(-1, 3)
    return dict(zip("xyz", pixels.T, strict=True))


def _columns_of_heights(heading: list[str], rows: list[list[str]]) -> dict[str, Array]:
    """Return x, y, z (N,), mm, of the pixels of a surface of Gocator, all NaN where nothing was measured.

    Cells hold heights z. x is the heading of the column, y stands in the row's own column Y, else in its first cell.
    """
    across = [i for i, name in enumerate(heading) if is_number(name)]
    heights = [row for row in rows if "I" not in row[: across[0]]]  # brightness has rows of its own
    z = np.array([[float(row[i] or "nan") for i in across] for row in heights])
    y = np.array([float(row[heading.index("Y") if "Y" in heading else 0]) for row in heights])
    x = np.array([float(heading[i]) for i in across])
    grid = np.broadcast_arrays(x, y[:, None], z)
    return {axis: np.where(np.isnan(z), np.nan, c).ravel() for axis, c in zip("xyz", grid, strict=True)}


def _column_names(line: str, separator: str | None) -> list[str]:
    """Return the cells of a line, X, Y and Z in small letters; a separator of None: they are separated by blanks."""
    cells = [cell.strip() for cell in line.split(separator)]
    return [cell.lower() if cell.lower() in "xyz" else cell for cell in cells]


def read_mesh(path: Path) -> dict[str, Array]:
    """Return columns x, y, z (N,) of the vertices of a mesh, equal ones merged, and nx, ny, nz if it has faces.

    A normal is the mean of the faces around a vertex. All pieces of a scene are joined.

    Raises:
        InputError: no vertices.
    """
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
    """Return the columns of a .npy, name -> (N,): x, y, z and scalar_0 … of further columns.

    The array is (N, 3 or more), an image (H, W, 3 or more) with NaN in empty pixels, or a depth image (H, W).

    Raises:
        InputError: another shape or type.
    """
    if is_depth_image(path):
        return read_depth_columns(path)
    # Mapped, so that a header that announces more than the file has is refused before room is made.
    array = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise InputError(f"{path}: an array {array.shape} is no cloud; save (N, 3) or (H, W, 3) numbers")
    table = array.reshape(-1, array.shape[-1])
    names = [*"xyz", *(f"scalar_{i}" for i in range(table.shape[1] - 3))]
    columns = dict(zip(names, table.T, strict=True))
    return measured_pixels(columns) if array.ndim == 3 else columns


def read_records(path: Path) -> dict[str, Array]:
    """Return columns (N,) of a .bin without a header: x, y, z and brightness in 32 bits each, as KITTI has them."""
    return dict(zip((*"xyz", "intensity"), np.fromfile(path, "<f4").reshape(-1, 4).T.astype(float), strict=True))


def read_left_handed(path: Path) -> dict[str, Array]:
    """Return columns (N,) of a .3d of 3DTK, whose axes are left-handed, with z the other way round.

    The first line may state how many points follow, or how many rows and columns.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    first = lines[0].split()
    has_header = len(first) < 3 or "x" in first
    table = np.loadtxt(lines[1:] if has_header else lines, ndmin=2)
    return dict(zip("xyz", table[:, :3].T * [[1], [1], [-1]], strict=True))


def read_ptx(path: Path) -> dict[str, Array]:
    """Return columns x, y, z, intensity (N,) of Leica's PTX, scanner frame, m; 0 0 0 where nothing was measured.

    A scan begins with `_PTX_HEADER` lines: counts of columns and rows, and the scanner's pose.

    Raises:
        InputError: several scans, or fewer points than announced.
    """
    scans = ptx_scans(path)
    if len(scans) != 1:
        raise InputError(_several_scans_message(path, f"{len(scans)} scans"))
    rows = scans[0][_PTX_HEADER:]
    count = int(scans[0][0]) * int(scans[0][1])
    if len(rows) < count:
        raise InputError(f"{path}: {count} points announced, data for {len(rows)}; export it again")
    return dict(zip([*"xyz", "intensity"], np.loadtxt(rows, ndmin=2).T, strict=False))


def ptx_scans(path: Path) -> list[list[str]]:
    """Return the lines of each scan of a PTX file, header included.

    Its first two lines, columns and rows, say how many points follow the header.
    """
    lines = [line for line in path.read_text(encoding="ascii", errors="replace").splitlines() if line.strip()]
    scans = []
    while lines:
        end = _PTX_HEADER + int(lines[0]) * int(lines[1])
        if end < _PTX_HEADER:
            raise InputError(f"{path}: {lines[0]} columns of {lines[1]} points announced; export it again")
        scans.append(lines[:end])
        lines = lines[end:]
    return scans


def read_las(path: Path) -> dict[str, Array]:
    """Return columns (N,) x, y, z and intensity of LAS and LAZ, by laspy."""
    announced_points.require_las_room(path)
    las = import_extra("laspy", path, "formats").read(path)
    xyz = np.asarray(las.xyz, float)
    return {**dict(zip("xyz", xyz.T, strict=True)), "intensity": np.asarray(las.intensity, float)}


def read_e57(path: Path) -> dict[str, Array]:
    """Return columns x, y, z, and intensity if there is one, (N,), of the only scan of an E57, scanner frame, m.

    Raises:
        InputError: several scans, or pye57 is not installed.
    """
    announced_points.require_e57_room(path)
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


def read_zdf(path: Path) -> dict[str, Array]:
    """Return columns (N,) of the measured pixels of Zivid's .zdf, with their colours.

    Raises:
        InputError: h5py is not installed, or another layout.
    """
    points, colours = read_zdf_image(path)
    columns = dict(zip("xyz", points.reshape(-1, 3).T, strict=True))
    if colours is not None:
        columns |= dict(zip(_COLOURS, colours.reshape(3, -1), strict=True))
    return measured_pixels(columns)


def read_zdf_image(path: Path) -> tuple[Array, Array | None]:
    """Return points (H, W, 3) of Zivid's .zdf and colours (3, H, W), these where the file has them.

    It is an HDF5 file as netCDF-4 writes it, read by h5py in the layout of Zivid's own sample programs: data/pointcloud
    is (H, W, 3), mm, NaN where nothing was measured, data/rgba_image is (H, W, 4) with 8 bits. Source:
    read_zdf_without_zivid.py in github.com/zivid/zivid-python-samples.

    Raises:
        InputError: h5py is not installed, or another layout.
    """
    with import_extra("h5py", path, "formats").File(path, "r") as file:
        cloud = file.get("data/pointcloud")
        image = file.get("data/rgba_image")
        if cloud is None or len(cloud.shape) != 3 or cloud.shape[2] != 3:
            raise InputError(f"{path}: no data/pointcloud of x, y, z in it; to fix: save it as PLY in Zivid Studio")
        announced_points.require_room(path, cloud.shape[0] * cloud.shape[1])
        points = np.asarray(cloud, float)
        if image is None or image.shape[:2] != points.shape[:2] or image.shape[2] < len(_COLOURS):
            return points, None
        return points, np.moveaxis(np.asarray(image[..., :3], float), 2, 0)
