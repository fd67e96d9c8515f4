"""Shape control: each clamp's control points against the CAD, turned into a motion of its flange."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices

# Of a contact frame's twist (rotation first): the panel is shaped by its z and by turns about x and y; the other axes
# give way to force control, because the panel is stiff in its plane.
SHAPING = np.array([True, True, False, False, False, True])


@dataclass(frozen=True)
class ShapeStep:
    """One step for all clamps."""

    T_base_flange: Array  # (N, 4, 4) to drive to
    twists: Array  # (N, 6) of the contact frames, rotation (rad) first; zero in compliant axes
    deviations: Array  # (K, 3) of the control points before the step, actual minus target, panel frame


def shape_step(
    points: Array, targets: Array, clamp: Indices, T_panel_contact: Array, T_base_flange: Array,
    T_flange_contact: Array, axes: Array = SHAPING,
) -> ShapeStep:  # fmt: skip
    """Move every clamp as its own control points need it.

    Args:
        points: (K, 3) measured control points, panel frame (in its target pose).
        targets: (K, 3) where the CAD has them.
        clamp: (K,) index of the clamp next to each point.
        T_panel_contact: (N, 4, 4) nominal contact frames.
        T_base_flange: (N, 4, 4) where the robots stand.
        T_flange_contact: (N, 4, 4) of the global model.
        axes: (6,) the axes of the twist that are driven; the rest stay where they are.

    With one or two points at a clamp only z is driven there: turns about x and y need three points.
    """
    deviations = points - targets
    twists = np.zeros((len(T_base_flange), 6))
    for i, T in enumerate(T_panel_contact):
        own = clamp == i
        if not own.any():
            continue
        local = frames.transform(frames.inverse(T), points[own])
        wanted = -frames.rotate(frames.inverse(T), deviations[own])
        driven = axes if own.sum() >= 3 else axes & np.array([False] * 5 + [True])
        design = np.concatenate([-frames.skew(local), np.tile(np.eye(3), (len(local), 1, 1))], axis=-1)
        # Deviations within the panel's plane are not the business of axes that cannot mend them.
        rows = design[:, 2][:, driven] if not axes[[2, 3, 4]].any() else design.reshape(-1, 6)[:, driven]
        right = wanted[:, 2] if not axes[[2, 3, 4]].any() else wanted.ravel()
        twists[i, driven] = np.linalg.lstsq(rows, right, rcond=None)[0]
    T_contact = T_base_flange @ T_flange_contact @ frames.exp(twists)
    return ShapeStep(T_contact @ frames.inverse(T_flange_contact), twists, deviations)


def largest(deviations: Array, clamp: Indices, T_panel_contact: Array) -> Array:
    """(N,) largest deviation across the panel's surface (along a contact frame's z) at each clamp, mm."""
    across = np.einsum("ki,ki->k", deviations, T_panel_contact[clamp][:, :3, 2])
    return np.array([np.abs(across[clamp == i]).max(initial=0.0) for i in range(len(T_panel_contact))])
