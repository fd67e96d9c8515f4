"""Parts as closed triangle meshes, in millimetres, each in its own part frame.

Any mesh file takes the place of a part: `load_mesh`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import trimesh

from data_synth.shapes import blade, body_side, car_door, drill_plate, panel, spheres

_FORMATS = (".ply", ".stl")


class Shape(NamedTuple):
    """A frozen dataclass of parameters and the function that makes a mesh of it."""

    parameters: type[Any]
    build: Callable[[Any], trimesh.Trimesh]


SHAPES: dict[str, Shape] = {
    "blade": Shape(blade.Blade, blade.build),
    "car_door": Shape(car_door.CarDoor, car_door.build),
    "body_side": Shape(body_side.BodySide, body_side.build),
    "window_pane": Shape(car_door.Pane, car_door.build_pane),
    "sphere": Shape(spheres.Sphere, spheres.build),
    "sphere_plate": Shape(spheres.SpherePlate, spheres.build_plate),
    "panel": Shape(panel.Panel, panel.build),
    "drill_plate": Shape(drill_plate.DrillPlate, drill_plate.build),
    "curved_drill_plate": Shape(drill_plate.CurvedDrillPlate, drill_plate.build),
}


def build_shape(name: str, **parameters: Any) -> trimesh.Trimesh:
    """The mesh of a shape by its name, in mm. Equal parameters give equal bytes.

    Raises ValueError for an unknown name or parameter.
    """
    if name not in SHAPES:
        raise ValueError(f"shape {name!r} is not one of {', '.join(SHAPES)}")
    shape = SHAPES[name]
    try:
        values = shape.parameters(**parameters)
    except TypeError as error:
        known = ", ".join(shape.parameters.__dataclass_fields__)
        raise ValueError(f"shape {name!r}: {error}; its parameters are {known}") from None
    return shape.build(values)


def load_mesh(path: Path | str, scale: float = 1.0) -> trimesh.Trimesh:
    """Triangles of any file trimesh reads, times `scale` to bring them to mm; equal vertices merged.

    Raises ValueError where the file is missing, unreadable or has no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # every reader of trimesh fails in its own way
        raise ValueError(f"{path}: not readable as a mesh ({error})") from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if len(getattr(mesh, "faces", ())) == 0:
        raise ValueError(f"{path}: no triangles in it")
    mesh.merge_vertices()
    return mesh.apply_scale(scale)


def write_mesh(mesh: trimesh.Trimesh, path: Path | str) -> Path:
    """Write a binary PLY or STL by the suffix; coordinates are rounded to single precision (60 nm at 1 m).

    Equal meshes give equal bytes. Raises ValueError for another suffix.
    """
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise ValueError(f"{path}: meshes are written as {' or '.join(_FORMATS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    # A fresh copy: what was computed on the mesh before must not change what is written.
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    path.write_bytes(bare.export(file_type=path.suffix.lower()[1:]))
    return path
