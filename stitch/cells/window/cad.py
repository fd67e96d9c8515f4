"""The CAD surface: nearest places for scanned points, told apart by the side they look to."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree

from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.text_file import reason_of

# Normals of scan and CAD may differ by 45°: more is the other side of the sheet, or a wall.
_SAME_SIDE = np.cos(np.radians(45.0))
_FAR_SIDE = -0.5
_MOST_SAMPLES = 400_000


@dataclass(frozen=True)
class CadSurface:
    """A triangle mesh with two ways to search it; part frame."""

    mesh: Any  # trimesh.Trimesh
    boxes: Any  # igl.AABB: tree of bounding boxes over the triangles
    centre: Array  # (3,)
    size: float  # diagonal of the bounding box
    spacing: float  # of the samples
    samples: Array  # (S, 3) on the surface
    normals: Array  # (S, 3) outwards
    tree: Any  # KDTree over (samples, reach · normals)
    reach: float  # distance that counts as much as normals one radian apart


@dataclass(frozen=True)
class NearestPartners:
    """For N points: signed distance along the CAD's normal, that normal, and whether the place is a partner."""

    distance: Array  # (N,) positive outside
    normal: Array  # (N, 3)
    accept: NDArray[np.bool_]  # (N,)


def read_cad(file: Path) -> CadSurface:
    """Read a mesh (STL, PLY, OBJ …) in length_unit.

    Raises:
        InputError: missing, unreadable or without triangles.
    """
    if not file.is_file():
        raise InputError(f"{file}: not found; name the CAD model as a mesh, STL, PLY or OBJ")
    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:
        raise InputError(f"{file}: cannot be read ({reason_of(error)}); export the mesh again") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{file}: holds no triangles; export the CAD model as a triangle mesh")
    return cad_surface(mesh)


def cad_surface(mesh: Any) -> CadSurface:
    """Make a trimesh ready for searching."""
    centre = mesh.bounds.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    boxes = igl.AABB()
    boxes.init(*_arrays(mesh))
    count = int(min(_MOST_SAMPLES, max(5000, mesh.area / (size / 800) ** 2)))
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    normals, reach = np.asarray(mesh.face_normals[faces]), size / 30
    return CadSurface(
        mesh,
        boxes,
        centre,
        size=size,
        spacing=float(np.sqrt(mesh.area / count)),
        samples=np.asarray(samples),
        normals=normals,
        tree=KDTree(np.hstack([samples, reach * normals])),
        reach=reach,
    )


def nearest_partners(cad: CadSurface, points: Array, normals: Array) -> NearestPartners:
    """Partners of points (N, 3) with normals (N, 3), part frame.

    First the nearest triangle; where that is a thin sheet's far side, the nearest of samples that look the same way.
    A normal that lies between is smeared over an edge and has no partner.
    """
    _, face, place = cad.boxes.squared_distance(*_arrays(cad.mesh), np.ascontiguousarray(points, float))
    normal = np.array(cad.mesh.face_normals[face])
    distance, accept = _accept_partners(points - place, normal, normals, 1e-3 * cad.spacing)
    other = np.flatnonzero(np.einsum("ij,ij->i", normal, normals) < _FAR_SIDE)
    if len(other):
        index = sample_partners(cad, points[other], normals[other])
        normal[other] = cad.normals[index]
        off = points[other] - cad.samples[index]
        distance[other], accept[other] = _accept_partners(off, normal[other], normals[other], 2 * cad.spacing)
    return NearestPartners(distance, normal, accept)


def _arrays(mesh: Any) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and faces as libigl takes them."""
    return np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(mesh.faces, np.int64)


def sample_partners(cad: CadSurface, points: Array, normals: Array) -> NDArray[np.int64]:
    """Index of the sample nearest in place and direction to each point (N, 3) with normal (N, 3)."""
    query = np.ascontiguousarray(np.hstack([points, cad.reach * normals]))
    return np.asarray(cad.tree.query(query, k=1)[1], np.int64)


def _accept_partners(off: Array, normal: Array, scan_normals: Array, loose: float) -> tuple[Array, NDArray[np.bool_]]:
    """Distance along the normal; a partner lies straight below its point, not beyond an edge of the surface."""
    distance = np.einsum("ij,ij->i", off, normal)
    aside = np.linalg.norm(off - distance[:, None] * normal, axis=1)
    same = np.einsum("ij,ij->i", normal, scan_normals) > _SAME_SIDE
    return distance, same & (aside <= 0.5 * np.abs(distance) + loose)
