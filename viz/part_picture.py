"""The part with the field as a still picture: for paper, and where no scripts run."""

from typing import NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import length_text
from stitch.output.comparison.model_history import ModelStep
from viz.colours import FIELD, unsigned_colours
from viz.figures import colormap
from viz.part_surface import Camera, PartSurface

# Light that comes from the eye, a little from above and from the left: so little shade that no colour turns into
# another.
_LIGHT = np.array([-0.25, 0.45, 0.86])
_AMBIENT = 0.84
DISAGREE = "views disagree by (µm)"
_PIXELS = 560  # along the longer side of the picture
_INCHES = 4.4


class Seen(NamedTuple):
    """Hold the place of the surface that each pixel shows."""

    shape: tuple[int, int]
    pixel: Indices  # (P,) numbers of the pixels that show the part
    corner: Indices  # (P, 3) vertices about the place
    weight: Array  # (P, 3) theirs


def step_shown(step: ModelStep, um: float) -> tuple[str, Array]:
    """Title and values of a still picture; µm."""
    return f"{step.name}\n{length_text(step.field.mean_abs * um / 1e3, 'mm')} on average", step.field.overall * um


def part_picture(
    surface: PartSurface, camera: Camera, states: list[tuple[str, Array]], limit: float, label: str
) -> Figure:
    """The part once for every state, title and values (K,) of the patches, with one scale of colours."""
    seen = visible(surface, camera)
    high, wide = seen.shape
    inches = _INCHES / max(high, wide)
    each = max(wide * inches, 1.9)
    # As high as the words of the colour bar, however flat the part.
    size = 0.9 + len(states) * each, max(high * inches, 2.0) + 0.6
    figure = Figure(figsize=size, layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(states)))
    for axes, (title, values) in zip(panels, states, strict=True):
        axes.imshow(painted(surface, camera, seen, unsigned_colours(surface.coloured(values), limit)))
        axes.axis("off")
        axes.set_title(title, fontsize=9)
    scale = ScalarMappable(Normalize(0, limit), colormap(FIELD))
    figure.colorbar(scale, ax=panels, label=label, extend="max", shrink=0.8, aspect=30)
    return figure


def visible(surface: PartSurface, camera: Camera) -> Seen:
    """Find the place of the surface that each pixel shows: of dense samples the one nearest to the eye."""
    flat = surface.vertices @ camera.axes.T
    low, size = flat.min(axis=0)[:2], np.ptp(flat, axis=0)[:2]
    scale = (_PIXELS - 1) / float(size.max())
    wide, high = (int(x) + 1 for x in size * scale)
    corners, weights = _samples(surface)
    # From the back to the front: of the samples with the same weights the last one that falls on a pixel stays.
    corners = corners[np.argsort(flat[corners, 2].sum(axis=1))]
    depth = np.full(high * wide, -np.inf)
    corner, weight = np.zeros((high * wide, 3), np.int64), np.zeros((high * wide, 3))
    at = [flat[corners[:, i]] for i in range(3)]
    for own in weights:
        place = sum(w * x for w, x in zip(own, at, strict=True))
        column, row = ((place[:, :2] - low) * scale + 0.5).astype(np.int64).T
        pixel = (high - 1 - np.clip(row, 0, high - 1)) * wide + np.clip(column, 0, wide - 1)
        nearer = np.flatnonzero(place[:, 2] > depth[pixel])
        depth[pixel[nearer]], corner[pixel[nearer]], weight[pixel[nearer]] = place[nearer, 2], corners[nearer], own
    shown = np.flatnonzero(depth > -np.inf)
    return Seen((high, wide), shown, corner[shown], weight[shown])


def painted(surface: PartSurface, camera: Camera, seen: Seen, colours: Array) -> Array:
    """(H, W, 4) shaded picture of colours (N, 3) of the vertices, 0 … 255; clear where there is no part."""
    light = _LIGHT @ camera.axes / np.linalg.norm(_LIGHT)
    shade = _AMBIENT + (1 - _AMBIENT) * np.clip(surface.normals @ light, 0, 1)
    own = np.einsum("pc,pci->pi", seen.weight, (colours * shade[:, None])[seen.corner])
    picture = np.zeros((seen.shape[0] * seen.shape[1], 4), np.uint8)
    picture[seen.pixel] = np.column_stack([own, np.full(len(own), 255.0)])
    return picture.reshape(*seen.shape, 4)


def _samples(surface: PartSurface) -> tuple[Indices, Array]:
    """Corners (T, 3) of the triangles and weights (S, 3) of samples in each, so dense that no pixel is left out."""
    if not len(surface.triangles):
        index = np.arange(len(surface.vertices))
        return np.stack([index] * 3, axis=1), np.array([[1.0, 0.0, 0.0]])
    edges = surface.vertices[surface.triangles] - surface.vertices[np.roll(surface.triangles, 1, axis=1)]
    longest = float(np.quantile(np.linalg.norm(edges, axis=2).max(axis=1), 0.9))
    fine = int(np.ceil(longest * _PIXELS / float(np.ptp(surface.vertices, axis=0).max()))) + 1
    i, j = np.meshgrid(np.arange(fine + 1), np.arange(fine + 1))
    inside = i + j <= fine
    return surface.triangles, np.column_stack([i[inside], j[inside], fine - i[inside] - j[inside]]) / fine
