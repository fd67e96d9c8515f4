"""Where the clamps touch the panel: six (or more) clamps of three pads each on the equivalent cylinder.

The source prints its formulas as pictures; these are rebuilt from its text and its figures' captions.
"""

from dataclasses import dataclass

import numpy as np

from stitch.cells.panel.contact_frame import contact_frame
from stitch.errors import InputError
from stitch.frames import Array


@dataclass(frozen=True)
class ClampLayout:
    """Lengths in mm. Panel frame: origin in the middle of the outer surface, x along the axis, z outwards."""

    radius: float  # R of the outer surface
    clamp_width: float  # W_c: chord between the two pads at a clamp's base, across the panel
    spacing: float  # D: chord between the facing pads of neighbouring clamps
    clamp_height: float  # H: from a clamp's base to its third pad
    edge: float  # D_E: from the panel's end to the pads next to it
    length: float  # L of the panel along its axis
    columns: int  # clamps side by side; there are two rows


@dataclass(frozen=True)
class Contacts:
    """Clamps row by row, each row from −y to +y."""

    pads: Array  # (N, 3, 3) the base's two, then the third one; panel frame
    T_panel_contact: Array  # (N, 4, 4); z into the panel, x from the base to the third pad
    columns: Array  # (columns,) angle of each column about the cylinder's axis, rad
    tilt: float  # θ between a clamp's plane and the axis, rad


def clamp_contacts(layout: ClampLayout) -> Contacts:
    """Pads and contact frames, symmetric about the panel's middle; the bases lie towards the ends.

    A clamp's chord W_c spans the angle 2·asin(W_c/2R), the free chord D the angle 2·asin(D/2R). The base's pads lie
    lower than the third one by the rise R·(1 − cos(α/2)), so the clamp's plane leans by sin θ = rise/H and covers
    H·cos θ of the axis: x = ∓(L/2 − D_E) and ∓(L/2 − D_E − H·cos θ).

    Raises:
        InputError: the clamps do not fit the panel.
    """
    half_chords = {"clamp_width": layout.clamp_width / 2, "spacing": layout.spacing / 2}
    for name, half in half_chords.items():
        if half >= layout.radius:
            raise InputError(f"layout: {name} is {2 * half:g} mm, wider than the cylinder; make it smaller")
    width, free = (2 * np.arcsin(half / layout.radius) for half in half_chords.values())
    rise = layout.radius * (1 - np.cos(width / 2))
    if rise >= layout.clamp_height:
        raise InputError(f"layout: clamp_height is below the arc's rise of {rise:.3g} mm under it; make it larger")
    tilt = float(np.arcsin(rise / layout.clamp_height))
    outer = layout.length / 2 - layout.edge
    inner = outer - layout.clamp_height * np.cos(tilt)
    if inner <= 0:
        raise InputError("layout: edge and clamp_height together reach over the panel's middle; make them smaller")
    angles = (width + free) * (np.arange(layout.columns) - (layout.columns - 1) / 2)
    if np.abs(angles).max() + width / 2 >= np.pi / 2:
        raise InputError("layout: the clamps reach beyond a quarter turn; take fewer columns or less spacing")
    pads = np.array([_pads(layout.radius, a, width, side * outer, side * inner) for side in (-1, 1) for a in angles])
    return Contacts(pads, contact_frame(pads), angles, tilt)


def _pads(radius: float, angle: float, width: float, x_base: float, x_third: float) -> Array:
    # Seen into the panel, the base's pads run from −y to +y of the contact frame on both rows.
    turn = np.sign(x_base) * width / 2
    at = np.array([angle - turn, angle + turn, angle])
    x = np.array([x_base, x_base, x_third])
    return np.column_stack([x, radius * np.sin(at), radius * (np.cos(at) - 1)])
