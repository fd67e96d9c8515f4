"""A compressor or turbine blade: lofted aerofoil, fillet, platform and a root the disc holds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import CrossSection
from numpy.typing import NDArray

from data_synth.shapes.solid import extrude, loft, polygon, rounded, to_mesh, union

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Blade:
    """Lengths in mm, angles in degrees.

    Part frame: z along the span, z = 0 the clamp plane at the root's bottom; x chordwise, leading edge
    at −x; y towards the suction side. At the defaults facets leave the aerofoil by less than 4 µm and its
    fillet by less than 8 µm.
    """

    span: float = 152.0  # of the aerofoil, above the platform
    chord_root: float = 72.0
    chord_tip: float = 54.0
    thickness: float = 0.11  # of the chord, at the root
    thickness_tip: float = 0.07
    camber: float = 0.11  # of the chord, at mid-chord
    stagger: float = -8.0  # angle of the chord at the root, about z
    twist: float = 35.0  # root to tip, about z
    lean: float = 10.0  # sideways (y) shift of the tip
    sweep: float = 6.0  # chordwise (x) shift of the tip
    trailing_radius: float = 0.4
    fillet: float = 4.0
    root: str = "dovetail"  # or "fir_tree"
    root_height: float = 40.0
    platform_height: float = 8.0
    sections: int = 100
    around: int = 320  # points of a section, even


def build(blade: Blade = Blade()) -> trimesh.Trimesh:
    """One closed mesh of aerofoil, platform and root. Raises ValueError for an unknown root."""
    if blade.root not in ROOTS:
        raise ValueError(f"root {blade.root!r} is not one of {', '.join(ROOTS)}")
    top = blade.root_height + blade.platform_height
    outline = section(blade, 0.0)
    reach = np.abs(outline).max(axis=0) + blade.fillet + 3.0
    block = np.array([[-reach[1], 0], [reach[1], 0], [reach[1], 1], [-reach[1], 1]])
    platform = polygon(block * [1, blade.platform_height] + [0, blade.root_height])
    profile = rounded(ROOTS[blade.root](blade) + platform, outer=1.0, inner=1.5)
    root = extrude(profile, -reach[0], reach[0], "x", divisions=40)
    return to_mesh(union([loft(_rings(blade, top)), root]))


def section(blade: Blade, share: float) -> Array:
    """(around, 2) x and y of the aerofoil at a share of the span, counter-clockwise from the trailing edge.

    Parabolic camber line with NACA four-digit thickness laid off at right angles to it (Abbott and von
    Doenhoff, section 6.4). The trailing edge is a semicircle: a blade's is never sharp.
    """
    chord = blade.chord_root + (blade.chord_tip - blade.chord_root) * share
    thickness = blade.thickness + (blade.thickness_tip - blade.thickness) * share
    turn = np.linspace(0, 2 * np.pi, blade.around, endpoint=False)
    x = (1 + np.cos(turn)) / 2
    half = 5 * thickness * (0.2969 * np.sqrt(x) + np.polyval([-0.1036, 0.2843, -0.3516, -0.126, 0.0], x))
    half = np.where(turn < np.pi, 1, -1) * (half + _trailing_edge(x, blade.trailing_radius / chord))
    slope = np.arctan(4 * blade.camber * (1 - 2 * x))
    camber = 4 * blade.camber * x * (1 - x)
    outline = chord * np.column_stack([x - 0.5 - half * np.sin(slope), camber + half * np.cos(slope)])
    # The camber's height is taken out in the middle: sections are stacked near their centres of area.
    outline[:, 1] -= chord * blade.camber * 2 / 3
    angle = np.radians(blade.stagger + blade.twist * share)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return outline @ rotation.T + np.array([blade.sweep, blade.lean]) * share**2


def _trailing_edge(x: Array, radius: float) -> Array:
    """Half thickness that grows smoothly to the radius and ends in a quarter circle, in chords."""
    grown = np.clip(2 * x, 0, 1)
    cap = np.sqrt(np.clip(1 - (np.clip(x - 1 + radius, 0, None) / radius) ** 2, 0, None))
    return radius * grown**2 * (3 - 2 * grown) * cap


def _rings(blade: Blade, bottom: float) -> Array:
    """(K, around, 3) sections from inside the platform over the fillet's arc to the tip."""
    arc = np.radians(np.linspace(90, 0, 25))
    grow = np.concatenate([[blade.fillet], blade.fillet * (1 - np.cos(arc)), np.zeros(blade.sections)])
    heights = np.concatenate(
        [
            [-blade.platform_height / 2],
            blade.fillet * (1 - np.sin(arc)),
            np.linspace(blade.fillet, blade.span, blade.sections + 1)[1:],
        ]
    )
    rings = []
    for offset, height in zip(grow, heights, strict=True):
        outline = section(blade, max(height, 0.0) / blade.span)
        tangent = np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        outline = outline + offset * np.column_stack([tangent[:, 1], -tangent[:, 0]])
        rings.append(np.column_stack([outline, np.full(len(outline), bottom + height)]))
    return np.array(rings)


def _fir_tree(blade: Blade) -> CrossSection:
    """Three pairs of lobes in the y-z plane, narrower towards the bottom."""
    pitch = blade.root_height / 3.6
    scale = blade.chord_root / 72.0
    half = [(6.0 * scale, 0.0)]
    for lobe, neck, level in zip((8.0, 11.5, 15.0), (5.0, 8.5, 11.0), range(3), strict=True):
        half += [(lobe * scale, (level + 0.3) * pitch), (lobe * scale, (level + 0.55) * pitch)]
        half += [(neck * scale, (level + 0.95) * pitch), (neck * scale, (level + 1.0) * pitch)]
    return _symmetric([*half, (half[-1][0], blade.root_height + 1)])


def _dovetail(blade: Blade) -> CrossSection:
    """One wedge in the y-z plane, wide at the bottom, with a neck."""
    wide, narrow, h = 0.27 * blade.chord_root, 0.13 * blade.chord_root, blade.root_height
    return _symmetric([(wide, 0), (wide, 0.15 * h), (narrow, 0.65 * h), (narrow, h + 1)])


def _symmetric(half: list[tuple[float, float]]) -> CrossSection:
    return polygon([*half, *((-y, z) for y, z in reversed(half))])


ROOTS: dict[str, Callable[[Blade], CrossSection]] = {"fir_tree": _fir_tree, "dovetail": _dovetail}
