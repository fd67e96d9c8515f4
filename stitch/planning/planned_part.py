"""The surface of a part that views would see: of a mesh, of a cloud with normals, or a block as large as the part."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.scan import even_indices
from stitch.reading.clouds import read_cloud
from stitch.reading.text_file import reason_of, require_file

# Points on the whole surface: a view sees a third of them, and a few thousand say what millions would.
_POINTS = 9_000
# Sides of a block that stands for a part of which only the size is known.
_SIDES = np.array([1.0, 0.7, 0.5])


@dataclass(frozen=True)
class PlannedPart:
    """Points (N, 3) on a surface and their outward normals (N, 3); length_unit."""

    points: Array
    normals: Array

    @property
    def centre(self) -> Array:
        """(3,) middle of its box."""
        return np.asarray((self.points.min(axis=0) + self.points.max(axis=0)) / 2)

    @property
    def size(self) -> float:
        """Diagonal of its box."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def moved(self, T: Array) -> "PlannedPart":
        """The surface in another frame, T (4, 4)."""
        return PlannedPart(frames.transform(T, self.points), frames.rotate(T, self.normals))


def surface_of_file(file: Path, scale: float) -> PlannedPart:
    """A mesh (STL, PLY, OBJ …), or a cloud with normals, as that of a run; `scale` turns its unit into the session's.

    Raises:
        InputError: missing, unreadable, or a cloud without normals.
    """
    require_file(file, "name a mesh or a cloud of the part")
    mesh = _read_mesh(file)
    if mesh is not None:
        mesh.apply_scale(scale)
        return surface_of_mesh(mesh)
    cloud = read_cloud(file, scale)
    if cloud.normals is None:
        raise InputError(
            f"{file}: a cloud without normals has no outside; to fix: name a mesh, or stitched.ply of a run"
        )
    return thinned_surface(cloud.points, cloud.normals)


def thinned_surface(points: Array, normals: Array, at_most: int = _POINTS) -> PlannedPart:
    """At most so many points (N, 3) of a cloud with their normals (N, 3), evenly over their order."""
    picked = even_indices(len(points), at_most)
    return PlannedPart(points[picked], normals[picked])


def block_surface(size: float) -> PlannedPart:
    """What stands for a part of which only the largest side is known: a block of 1 : 0.7 : 0.5 about the origin."""
    return surface_of_mesh(trimesh.creation.box(extents=size * _SIDES))


def _read_mesh(file: Path) -> trimesh.Trimesh | None:
    """None where the file holds no triangles."""
    if file.suffix.lower() not in (".stl", ".obj", ".off", ".glb", ".gltf", ".ply"):
        return None
    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:  # whatever a library raises at bytes that are no mesh
        raise InputError(f"{file}: cannot be read ({reason_of(error)}); to fix: export it again") from None
    return mesh if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) else None


def surface_of_mesh(mesh: trimesh.Trimesh) -> PlannedPart:
    """Points spread over a mesh at random, the same every time."""
    points, faces = trimesh.sample.sample_surface(mesh, _POINTS, seed=0)
    return PlannedPart(np.asarray(points), np.asarray(mesh.face_normals[faces]))
