"""A compressor blade: lofted aerofoil on a platform with a dovetail root."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Blade:
    """Lengths in mm, angles in degrees. z runs along the span, z = 0 is the bottom of the root."""

    span: float = 130.0  # of the aerofoil, above the platform
    chord_root: float = 70.0
    chord_tip: float = 52.0
    thickness: float = 0.12  # of the chord
    camber: float = 0.08  # of the chord
    twist: float = 35.0  # root to tip
    lean: float = 12.0  # sideways shift of the tip
    root_height: float = 28.0
    platform_height: float = 8.0
    sections: int = 60
    around: int = 120


def build(blade: Blade = Blade()) -> trimesh.Trimesh:
    """The closed surfaces of aerofoil, platform and root, as one mesh; they penetrate each other.

    A ray from outside meets the outermost surface first, so a scan sees the union.
    """
    platform_top = blade.root_height + blade.platform_height
    platform = trimesh.creation.box((blade.chord_root * 1.25, blade.chord_root * 0.75, blade.platform_height))
    platform.apply_translation((0, 0, blade.root_height + blade.platform_height / 2))
    return trimesh.util.concatenate([_aerofoil(blade, platform_top - 2.0), platform, _dovetail(blade)])


def section(blade: Blade, share: float) -> Array:
    """(around, 2) outline at a share of the span, leading edge at −chord/2.

    NACA four-digit thickness with a closed trailing edge on a parabolic camber line.
    """
    chord = blade.chord_root + (blade.chord_tip - blade.chord_root) * share
    turn = np.linspace(0, 2 * np.pi, blade.around, endpoint=False)
    x = (1 + np.cos(turn)) / 2
    half = 5 * blade.thickness * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    y = 4 * blade.camber * x * (1 - x) + np.where(turn < np.pi, half, -half)
    angle = np.radians(blade.twist * (share - 0.5))
    outline = np.column_stack([(x - 0.5) * chord, y * chord])
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return outline @ rotation.T + [0.0, blade.lean * share**2]


def _aerofoil(blade: Blade, bottom: float) -> trimesh.Trimesh:
    shares = np.linspace(0, 1, blade.sections)
    rings = np.array([section(blade, s) for s in shares])
    heights = bottom + blade.span * shares
    points = np.concatenate(
        [np.column_stack([ring, np.full(len(ring), z)]) for ring, z in zip(rings, heights, strict=True)]
    )
    n = blade.around
    i = np.arange(n)
    faces = []
    for k in range(blade.sections - 1):
        a, b = k * n + i, k * n + (i + 1) % n
        faces += [np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])]
    bottom_centre, top_centre = len(points), len(points) + 1
    points = np.vstack([points, [*rings[0].mean(axis=0), heights[0]], [*rings[-1].mean(axis=0), heights[-1]]])
    top = (blade.sections - 1) * n
    faces.append(np.column_stack([(i + 1) % n, i, np.full(n, bottom_centre)]))
    faces.append(np.column_stack([top + i, top + (i + 1) % n, np.full(n, top_centre)]))
    return trimesh.Trimesh(points, np.vstack(faces), process=False)


def _dovetail(blade: Blade) -> trimesh.Trimesh:
    """A trapezoid prism, wide at the bottom, that the disc holds."""
    wide, narrow, length = blade.chord_root * 0.55, blade.chord_root * 0.35, blade.chord_root * 1.2
    corners = np.array(
        [(x, y * (wide if z == 0 else narrow) / 2, z) for x in (-length / 2, length / 2) for y in (-1, 1)
         for z in (0.0, blade.root_height + 1)]
    )  # fmt: skip
    return trimesh.Trimesh(corners).convex_hull
