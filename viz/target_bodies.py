"""The marks of a run on labelled points as one surface to draw, and from where it is looked at."""

import numpy as np

from stitch import frames
from viz import mark_shapes
from viz.part_camera import Camera, camera_for
from viz.part_surface import PartSurface
from viz.target_marks import Marks

# Sizes in radii of a ball; what stands still is for orientation.
_BODIES = {
    "ball": (mark_shapes.ball, 1.0),
    "pebble": (mark_shapes.pebble, 1.0),
    "probe": (mark_shapes.probe, 2.5),
    "scanner": (mark_shapes.scanner, 3.0),
    "base": (mark_shapes.pedestal, 3.0),
}


def bodies(marks: Marks) -> PartSurface:
    """All bodies in the base frame; the value of mark m colours the m-th."""
    size = _radius(marks)
    vertices, normals, triangles, owner, count = [], [], [], [], 0
    shapes = {name: form() for name, (form, _) in _BODIES.items()}
    for m, (name, T) in enumerate(zip(marks.shape, marks.T, strict=True)):
        body = shapes[name]
        vertices.append(frames.transform(T, body.vertices * size * _BODIES[name][1]))
        normals.append(frames.rotate(T, body.vertex_normals))
        triangles.append(body.faces + count)
        owner.append(np.full(len(body.vertices), m))
        count += len(body.vertices)
    mark = np.concatenate(owner)
    return PartSurface(
        np.vstack(vertices),
        np.vstack(normals),
        np.vstack(triangles).astype(np.int64),
        patch=np.stack([mark] * 3, axis=1),
        weight=np.tile([1.0, 0.0, 0.0], (len(mark), 1)),
    )


def camera_of(marks: Marks) -> Camera:
    """Upright, from the level direction in which the places spread least: most of them are seen."""
    places = marks.valued
    across = np.linalg.eigh(np.cov(places[:, :2].T))[1][:, 0]
    return camera_for(places, np.tile([*across, 0.0], (len(places), 1)), upright=True)


def _radius(marks: Marks) -> float:
    """Of a ball, length_unit: large enough to be seen, small enough to stand beside the others."""
    places = marks.valued
    size = float(np.ptp(places, axis=0).max()) or 1.0
    return float(size * np.clip(0.05 * len(places) ** -0.25, 0.004, 0.03))
