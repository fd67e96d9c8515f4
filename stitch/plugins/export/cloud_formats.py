"""The stitched cloud, and its mesh where there is one, for other programs, coloured by residual.

Frame: that of the run, the flange or the base; or that of the datum its features were measured in. Unit: metres where
the format says so (E57, glTF), else the session's.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.errors import InputError
from stitch.model.model_toml import read_model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.output.cloud_colours import Colours, residual_colours
from stitch.output.stored_run import fused_cloud
from stitch.run_data import FusedCloud
from stitch.session.reading.text_files import shortened
from stitch.system import ply_file
from stitch.system.packages import import_extra

# LAS counts places in whole steps of 32 bits, which hold so many on either side of the middle.
_LAS_STEPS = 1e9


@dataclass(frozen=True)
class ColouredCloud:
    """The stitched cloud of a run with colours."""

    fused: FusedCloud  # length_unit
    colours: Colours  # (N, 3)
    span: float  # residual of the last colour, length_unit
    length_unit: str
    mesh: Path | None  # mesh.ply of the run, if there is one
    T_mesh: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) from the mesh's frame to that of the points


def coloured_cloud(folder: Path) -> ColouredCloud:
    """Return the cloud of a run folder.

    Raises:
        InputError: no run, or one without a stitched cloud, as labelled points alone give it.
    """
    unit = read_model(folder).length_unit
    file = folder / "stitched.ply"
    if not file.is_file():
        raise InputError(f"{file}: no stitched cloud there; to fix: name a run of a session with clouds")
    try:
        fused = fused_cloud(file)
    except (LookupError, TypeError, ValueError, OSError) as error:
        raise InputError(f"{file}: damaged ({shortened(str(error))}); to fix: run `stitch run` again") from None
    if not len(fused.points):
        raise InputError(
            f"{file}: holds no points, since the session has labelled points alone; to fix: name a run with clouds"
        )
    mesh = folder / "mesh.ply"
    return coloured(fused, unit, mesh if mesh.is_file() else None)


def stored_datum(folder: Path) -> Array:
    """Return T_datum_reference (4, 4) of the features.json of a run folder, length_unit.

    Raises:
        InputError: no features were measured there in the frame of a datum.
    """
    file = folder / "features.json"
    try:
        T = np.array(json.loads(file.read_text(encoding="utf-8"))["T_datum_reference"], float)
    except (OSError, ValueError, KeyError, TypeError):
        T = np.zeros(0)
    if not frames.is_rigid(T):
        raise InputError(f"{file}: says no datum; to fix: run stitch measure with datum in FEATURES.toml first")
    return T


def in_datum(cloud: ColouredCloud, T: Array) -> ColouredCloud:
    """Return a cloud of the reference frame in that of a datum, by T_datum_reference (4, 4), length_unit."""
    fused = replace(
        cloud.fused,
        points=frames.transform(T, cloud.fused.points),
        normals=frames.rotate(T, cloud.fused.normals),
    )
    return replace(cloud, fused=fused, T_mesh=T)


def coloured(fused: FusedCloud, length_unit: str, mesh: Path | None = None) -> ColouredCloud:
    """Return a stitched cloud with its residuals as colours."""
    colours, span = residual_colours(fused.residual)
    return ColouredCloud(fused, colours, span, length_unit, mesh)


def write_ply(cloud: ColouredCloud, path: Path) -> None:
    """Write everything that stitched.ply has, and red, green, blue."""
    fused = cloud.fused
    numbers = ("x", "y", "z", "nx", "ny", "nz", "residual")
    layout = [(name, "<f4") for name in numbers] + [(name, "u1") for name in ("red", "green", "blue")]
    vertex = np.empty(len(fused.points), [*layout, ("views", "<u2")])
    columns = np.column_stack([fused.points, fused.normals, fused.residual])
    for name, column in zip(numbers, columns.T, strict=True):
        vertex[name] = column
    for name, column in zip(("red", "green", "blue"), cloud.colours.T, strict=True):
        vertex[name] = column
    vertex["views"] = fused.count
    ply_file.write_ply(path, {"vertex": vertex})


def write_pcd(cloud: ColouredCloud, path: Path) -> None:
    """Write binary PCD 0.7: x, y, z, normals, rgb packed as PCL does, residual."""
    fused, fields = cloud.fused, "x y z normal_x normal_y normal_z rgb residual"
    red, green, blue = cloud.colours.astype(np.uint32).T
    packed = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
    columns = [*fused.points.T, *fused.normals.T, packed, fused.residual]
    table = np.column_stack([np.asarray(column, "<f4").view("<u4") for column in columns])
    count = len(table)
    ones = " ".join("1" * len(columns))
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {ones.replace('1', '4')}\nTYPE {ones.replace('1', 'F')}\n"
        f"COUNT {ones}\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + table.tobytes())


def write_las(cloud: ColouredCloud, path: Path, packed: bool = False) -> None:
    """Write LAS 1.4, or LAZ, by laspy: colours, and residual and normals as extra dimensions; the session's unit."""
    laspy = import_extra("laspy", path, "formats")
    las = laspy.create(point_format=7, file_version="1.4")
    middle = np.floor((cloud.fused.points.min(axis=0) + cloud.fused.points.max(axis=0)) / 2)
    farthest = max(float(np.abs(cloud.fused.points - middle).max()), 1e-6)
    las.header.scales = [10 ** np.ceil(np.log10(farthest / _LAS_STEPS))] * 3
    las.header.offsets = middle
    las.x, las.y, las.z = cloud.fused.points.T
    # Sixteen bits a colour.
    las.red, las.green, las.blue = cloud.colours.astype(np.uint16).T * 257
    extra = {"residual": cloud.fused.residual} | dict(zip(("nx", "ny", "nz"), cloud.fused.normals.T, strict=True))
    las.add_extra_dims([laspy.ExtraBytesParams(name=name, type=np.float32) for name in extra])
    for name, column in extra.items():
        las[name] = column.astype(np.float32)
    with path.open("wb") as stream:
        las.write(stream, do_compress=packed)


def write_e57(cloud: ColouredCloud, path: Path) -> None:
    """Write E57 by pye57, in metres as its standard (ASTM E2807) has it: points and colours."""
    points = cloud.fused.points * METRES[cloud.length_unit]
    columns = {f"cartesian{axis}": column.copy() for axis, column in zip("XYZ", points.T, strict=True)}
    names = ("colorRed", "colorGreen", "colorBlue")
    columns |= {name: column.copy() for name, column in zip(names, cloud.colours.T, strict=True)}
    with import_extra("pye57", path, "formats").E57(str(path), mode="w") as file:
        file.write_scan_raw(columns)


def write_glb(cloud: ColouredCloud, path: Path) -> None:
    """Write binary glTF 2.0 by trimesh, in metres: the mesh of the run, or its points."""
    import trimesh

    metres = METRES[cloud.length_unit]
    if cloud.mesh is None:
        shape: Any = trimesh.PointCloud(cloud.fused.points * metres, colors=cloud.colours)
    else:
        shape = trimesh.load_mesh(cloud.mesh, process=False).apply_transform(cloud.T_mesh)
        _, nearest = KDTree(np.ascontiguousarray(cloud.fused.points)).query(np.array(shape.vertices), k=1)
        shape.visual = trimesh.visual.ColorVisuals(shape, vertex_colors=cloud.colours[nearest])
        shape.apply_scale(metres)
    path.write_bytes(trimesh.Scene([shape]).export(file_type="glb"))


# Writer, and what it leaves out of points, normals, colours and residual.
CLOUD_FORMATS: dict[str, tuple[Callable[[ColouredCloud, Path], None], str]] = {
    "ply": (write_ply, ""),
    "pcd": (write_pcd, "how many views saw each place"),
    "las": (write_las, "how many views saw each place"),
    "laz": (partial(write_las, packed=True), "how many views saw each place"),
    "e57": (write_e57, "normals, nor residuals but as colours"),
    "glb": (write_glb, "residuals but as colours"),
}
