"""A shaded picture of parts by ray casting, without a display; scanners drawn as small frustums."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

Array = NDArray[np.float64]

COLOURS = [(176, 190, 205), (222, 160, 92), (140, 180, 140), (190, 150, 190)]
_BACKGROUND = 255.0
_SCANNER, _VIEW, _HIDDEN = (196, 54, 36), (222, 150, 136), (232, 214, 210)
_SUPERSAMPLING = 2
_LINES = 9  # of a frustum: 4 edges, 4 sides of its end, 1 along the view
_FAR = 1e9  # depth where nothing is, mm


@dataclass(frozen=True)
class Camera:
    """A pinhole that sees a ball around the parts; lengths in mm, part frame."""

    eye: Array  # (3,)
    rotation: Array  # (3, 3) columns right, down, forward
    focal: float  # pixels
    size: tuple[int, int]  # width, height in pixels

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (N, 2) and depths (N,) in mm of points (N, 3)."""
        local = (points - self.eye) @ self.rotation
        return self.focal * local[:, :2] / local[:, 2:] + np.array(self.size) / 2, local[:, 2]

    def rays(self) -> Array:
        """(height·width, 3) directions whose component along the view is 1, row by row."""
        u, v = np.meshgrid(np.arange(self.size[0]) + 0.5, np.arange(self.size[1]) + 0.5)
        u, v = u - self.size[0] / 2, v - self.size[1] / 2
        local = np.stack([u, v, np.full(u.shape, self.focal)], axis=-1).reshape(-1, 3) / self.focal
        return np.asarray(local @ self.rotation.T)


def render(
    meshes: trimesh.Trimesh | Sequence[trimesh.Trimesh],
    path: Path | str,
    azimuth: float = 35.0,
    elevation: float = 20.0,
    size: tuple[int, int] = (900, 700),
    colours: Sequence[tuple[int, int, int]] = tuple(COLOURS),
    T_part_scanner: ArrayLike | None = None,
    standoff: float | None = None,
    field_of_view: float = 28.0,
) -> Path:
    """Write a PNG of one mesh or several, each in its colour, on white.

    `azimuth` and `elevation` in degrees say where the camera stands: azimuth about z from +x towards
    +y, elevation above the x-y plane. `T_part_scanner` (V, 4, 4) in mm draws every scanner as a frustum
    of `field_of_view` degrees with a line of `standoff` mm along its view (default: to the parts'
    middle); lines behind a part are pale.
    """
    meshes = [meshes] if isinstance(meshes, trimesh.Trimesh) else list(meshes)
    lines = np.empty((0, 2, 3))
    if T_part_scanner is not None:
        middle = trimesh.util.concatenate(meshes).bounds.mean(axis=0)
        lines = frustums(np.asarray(T_part_scanner, dtype=np.float64), middle, standoff, field_of_view)
    everything = np.concatenate([*(mesh.vertices for mesh in meshes), lines.reshape(-1, 3)])
    fine = (size[0] * _SUPERSAMPLING, size[1] * _SUPERSAMPLING)
    camera = look_at(everything, azimuth, elevation, fine)
    pixels, depth = _shade(meshes, colours, camera)
    image = Image.fromarray(pixels.astype(np.uint8))
    _draw(image, lines, depth, camera)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    image.resize(size, Image.Resampling.BOX).save(path, format="PNG")
    return path


def look_at(points: Array, azimuth: float, elevation: float, size: tuple[int, int]) -> Camera:
    """A camera that sees all points (N, 3), angles in degrees, with a margin of 6 %."""
    a, e = np.radians([azimuth, np.clip(elevation, -89.9, 89.9)])
    back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.cross(-back, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(-back, right), -back])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    eye = middle + back * 2.2 * np.linalg.norm(np.ptp(points, axis=0))
    local = (points - eye) @ rotation
    flat = local[:, :2] / local[:, 2:]
    # Turning the camera would tilt the picture; moving it sideways keeps verticals and fills the frame.
    shift = (flat.min(axis=0) + flat.max(axis=0)) / 2 * np.linalg.norm(eye - middle)
    eye = eye + rotation[:, :2] @ shift
    camera = Camera(eye, rotation, 1.0, (0, 0))
    reach = np.abs(camera.project(points)[0]).max(axis=0)
    return Camera(eye, rotation, float((np.array(size) / 2 / reach).min() / 1.06), size)


def frustums(T_part_scanner: Array, middle: Array, standoff: float | None, field_of_view: float) -> Array:
    """(9·V, 2, 3) lines in mm, part frame: per scanner 8 of a small pyramid and one along its view."""
    segments = []
    for T in T_part_scanner.reshape(-1, 4, 4):
        ahead = standoff if standoff is not None else float((middle - T[:3, 3]) @ T[:3, 2])
        depth = 0.12 * abs(ahead)
        half = depth * np.tan(np.radians(field_of_view / 2))
        corners = [np.array([x * half, y * half, depth]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        local = [(np.zeros(3), corner) for corner in corners]
        local += [(corners[i - 1], corners[i]) for i in range(4)]
        local.append((np.array([0.0, 0.0, depth]), np.array([0.0, 0.0, ahead])))
        segments.append(np.array(local) @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(segments)


def _shade(
    meshes: Sequence[trimesh.Trimesh], colours: Sequence[tuple[int, int, int]], camera: Camera
) -> tuple[Array, Array]:
    """Pixels (height, width, 3) of 0…255 and depths (height, width) in mm, _FAR where nothing is."""
    mesh = trimesh.util.concatenate(list(meshes))
    owner = np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes])
    paint = np.array(colours, dtype=np.float64)[owner % len(colours)]
    rays = camera.rays()
    eyes = np.broadcast_to(camera.eye, rays.shape)
    hit, ray, face = mesh.ray.intersects_location(eyes, rays, multiple_hits=False)
    normal = mesh.face_normals[face]
    normal = normal * -np.sign(np.einsum("ij,ij->i", normal, rays[ray]))[:, None]
    # A key light over the camera's left shoulder that casts shadows, a weak one from the camera itself.
    key = camera.rotation @ np.array([-0.55, -0.65, -0.6])
    key /= np.linalg.norm(key)
    lift = 1e-4 * float(np.linalg.norm(mesh.extents))
    lit = ~mesh.ray.intersects_any(hit + lift * (normal + key), np.broadcast_to(key, hit.shape))
    light = 0.30 + 0.46 * lit * np.clip(normal @ key, 0, None) + 0.34 * np.abs(normal @ camera.rotation[:, 2])
    width, height = camera.size
    pixels = np.full((height * width, 3), _BACKGROUND)
    depth = np.full(height * width, _FAR)
    normals = np.tile([0.0, 0.0, 1.0], (height * width, 1))
    pixels[ray] = np.clip(paint[face] * light[:, None] * 1.15, 0, 255)
    depth[ray] = (hit - camera.eye) @ camera.rotation[:, 2]
    normals[ray] = normal
    depth, shape = depth.reshape(height, width), (height, width, 3)
    edge = _edges(normals.reshape(shape), depth)
    return np.where(edge[..., None], 0.62, 1.0) * pixels.reshape(shape), depth


def _edges(normals: Array, depth: Array) -> NDArray[np.bool_]:
    """(height, width) true where the surface turns by 40° or the depth jumps by 0.6 %, as a pen draws."""
    edge = np.zeros(depth.shape, dtype=bool)
    for here, there in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        jump = np.abs(depth[here] - depth[there]) > 0.006 * np.minimum(depth[here], depth[there])
        turn = np.einsum("ijk,ijk->ij", normals[here], normals[there])
        edge[here] |= jump | (turn < np.cos(np.radians(40)))
    return edge


def _draw(image: Image.Image, lines: Array, depth: Array, camera: Camera) -> None:
    """Lines in short pieces, pale where a part stands before them."""
    brush = ImageDraw.Draw(image)
    steps = np.linspace(0, 1, 121)[:, None]
    for number, (start, stop) in enumerate(lines):
        # The view's direction, last of a frustum's lines, is drawn finer, so as not to cover the part.
        colour, width = (_VIEW, 2) if number % _LINES == _LINES - 1 else (_SCANNER, 4)
        places, away = camera.project(start + (stop - start) * steps)
        middle = ((places[:-1] + places[1:]) / 2).astype(int)
        column, row = (np.clip(middle[:, i], 0, camera.size[i] - 1) for i in (0, 1))
        hidden = depth[row, column] < away[:-1] * 0.999
        for a, b, behind in zip(places[:-1], places[1:], hidden, strict=True):
            brush.line([tuple(a), tuple(b)], fill=_HIDDEN if behind else colour, width=width)
