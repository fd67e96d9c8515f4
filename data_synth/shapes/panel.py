"""A curved fuselage panel: skin, stringers along the axis and frames across it."""

from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from data_synth.shapes.solid import extrude, polygon, refined, rounded, to_mesh, union, warp

Array = NDArray[np.float64]
_AXIAL = 4.0  # longest extent along the axis, in facets


@dataclass(frozen=True)
class Panel:
    """Lengths in mm.

    Part frame: origin in the middle of the outer surface, z outwards, x along the fuselage's axis.
    Facets leave the cylinder by facet²/(8·radius): 4 µm here. The whole panel of six robots is
    Panel(length=3100, width=2048, frame_pitch=530, facet=20): 17 µm.
    """

    radius: float = 2960.0  # of the outer surface
    length: float = 600.0  # along the axis
    width: float = 500.0  # along the arc
    skin: float = 2.0
    stringer_pitch: float = 160.0
    stringer_height: float = 28.0
    frame_pitch: float = 280.0
    frame_height: float = 75.0
    sheet: float = 1.8  # of stringers and frames
    facet: float = 10.0  # longest extent of a triangle along the arc


def build(panel: Panel = Panel()) -> trimesh.Trimesh:
    """One closed mesh, joined flat and then rolled onto the cylinder.

    Flat coordinates are x, the arc y and the depth z inside the outer surface, counted negative.
    """
    x, y = panel.length / 2, panel.width / 2
    solids = [extrude(polygon([(-x, -y), (x, -y), (x, y), (-x, y)]), -panel.skin, 0.0)]
    lanes = positions(panel.width, panel.stringer_pitch)
    profile = _hat(panel)
    solids += [extrude(profile.translate((lane, 0.0)), -x, x, "x") for lane in lanes]
    frame = _frame(panel, lanes)
    stations = positions(panel.length, panel.frame_pitch)
    solids += [frame.translate((station, 0.0, 0.0)) for station in stations]
    # Rolling leaves the axial direction straight: triangles may be longer there.
    squeezed = union(solids).scale((1 / _AXIAL, 1, 1))
    flat = refined(squeezed, panel.facet).scale((_AXIAL, 1, 1))
    return to_mesh(warp(flat, lambda points: _roll(points, panel.radius)))


def positions(extent: float, pitch: float) -> Array:
    """Places of stringers or frames in mm: as many as fit at the pitch, centred."""
    count = max(1, int(extent // pitch))
    return pitch * (np.arange(0.0, count) - (count - 1) / 2)


def _hat(panel: Panel) -> CrossSection:
    """A stringer's section: two feet on the skin and a cap, in the y-z plane."""
    h, t, z = panel.stringer_height, panel.sheet, 0.3 - panel.skin  # sunk into the skin, to be joined
    outer = polygon([(-16, z), (-11, -h), (11, -h), (16, z)])
    inner = polygon([(-16 + t, z + 1), (-11 + t, t - h), (11 - t, t - h), (16 - t, z + 1)])
    feet = polygon([(-34, z - t - 0.3), (34, z - t - 0.3), (34, z), (-34, z)])
    hollow = polygon([(-16 + t, -h - 1), (16 - t, -h - 1), (16 - t, z + 1), (-16 + t, z + 1)])
    return rounded(outer, 3.0) - inner + (feet - hollow)


def _frame(panel: Panel, lanes: Array) -> Manifold:
    """A Z-shaped frame across the panel, cut out where stringers pass."""
    h, t, y = panel.frame_height, panel.sheet, panel.width / 2
    foot = 0.3 - panel.skin
    section = (
        polygon([(-t / 2, -h), (t / 2, -h), (t / 2, foot), (-t / 2, foot)])
        + polygon([(-t / 2, -h), (22, -h), (22, t - h), (-t / 2, t - h)])
        + polygon([(-22, foot - t), (t / 2, foot - t), (t / 2, foot), (-22, foot)])
    )
    frame = extrude(section, -y, y, "y")
    low = -panel.stringer_height - 8
    opening = rounded(polygon([(-38, low), (38, low), (38, 8), (-38, 8)]), 10.0)
    return frame - union([extrude(opening.translate((lane, 0.0)), -30, 30, "x") for lane in lanes])


def _roll(points: Array, radius: float) -> Array:
    angle = points[:, 1] / radius
    distance = radius + points[:, 2]
    return np.column_stack([points[:, 0], distance * np.sin(angle), distance * np.cos(angle) - radius])
