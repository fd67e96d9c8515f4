"""Small bodies that stand for a target, a probe, a scanner and a robot's base: unit size, about their own origin.

Runs on clouds have none of them, and do not wait for the library of meshes.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh


def ball() -> "trimesh.Trimesh":
    """Radius 1."""
    import trimesh

    return trimesh.creation.icosphere(subdivisions=1)


def pebble() -> "trimesh.Trimesh":
    """A ball for those of which there are thousands: its normals make twenty triangles look round."""
    import trimesh

    return trimesh.creation.icosphere(subdivisions=0)


def scanner() -> "trimesh.Trimesh":
    """A pyramid of height 1 that opens along z, from the eye at the origin to what is seen."""
    import trimesh

    corners = [[0, 0, 0], [-0.5, -0.4, 1], [0.5, -0.4, 1], [0.5, 0.4, 1], [-0.5, 0.4, 1]]
    return _faceted(trimesh.Trimesh(corners).convex_hull)


def pedestal() -> "trimesh.Trimesh":
    """What a robot stands on: a disc of radius 1 below the origin, and a stub of height 1 upon it."""
    import trimesh

    disc = trimesh.creation.cylinder(radius=1.0, height=0.3, sections=24)
    disc.apply_translation([0, 0, -0.15])
    stub = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=24)
    stub.apply_translation([0, 0, 0.5])
    return _faceted(trimesh.util.concatenate([disc, stub]))


def probe() -> "trimesh.Trimesh":
    """Three rods of length 1 along the axes, x the thickest."""
    import trimesh

    rods = []
    for axis, thick in enumerate((0.3, 0.22, 0.14)):
        low, high = np.full(3, -thick / 2), np.full(3, thick / 2)
        high[axis] = 1.0
        rods.append(trimesh.creation.box(bounds=[low, high]))
    return _faceted(trimesh.util.concatenate(rods))


def _faceted(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """Every triangle with corners of its own, so that its edges are seen."""
    mesh.unmerge_vertices()
    return mesh
