"""Shape control: each clamp's control points against the CAD, turned into a motion of its flange."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices

# Of a contact frame's twist (rotation first): the panel is shaped by its z and by turns about x and y; the other axes
# give way to force control, because the panel is stiff in its plane.
SHAPE_AXES = np.array([True, True, False, False, False, True])


@dataclass(frozen=True)
class ShapeStep:
    """One step for all clamps."""

    T_base_flange: Array  # (N, 4, 4) to drive to
    twists: Array  # (N, 6) of the contact frames, rotation (rad) first; zero in compliant axes
    deviations: Array  # (K, 3) of the control points before the step, actual minus target, panel frame


@dataclass(frozen=True)
class ControlPoints:
    """Where the CAD has the points by which the shape is controlled."""

    nominal: Array  # (K, 3) panel frame
    clamp: Indices  # (K,) index of the clamp next to each point
    T_panel_contact: Array  # (N, 4, 4) nominal contact frames of the clamps


def shape_step(
    measured: Array, control: ControlPoints, T_base_flange: Array, T_flange_contact: Array, axes: Array = SHAPE_AXES
) -> ShapeStep:
    """Move every clamp as its own control points need it.

    Args:
        measured: (K, 3) the control points, panel frame (in its target pose).
        T_base_flange: (N, 4, 4) where the robots stand.
        T_flange_contact: (N, 4, 4) of the global model.
        axes: (6,) the axes of the twist that are driven; the rest stay where they are.

    With one or two points at a clamp only z is driven there: turns about x and y need three points.
    """
    deviations = measured - control.nominal
    twists = np.zeros((len(T_base_flange), 6))
    for i, T in enumerate(control.T_panel_contact):
        beside = control.clamp == i
        if not beside.any():
            continue
        local = frames.transform(frames.inverse(T), measured[beside])
        wanted = -frames.rotate(frames.inverse(T), deviations[beside])
        driven = axes if beside.sum() >= 3 else axes & np.array([False] * 5 + [True])
        design = np.concatenate([-frames.skew(local), np.tile(np.eye(3), (len(local), 1, 1))], axis=-1)
        # Deviations within the panel's plane are left out where no driven axis can correct them.
        rows = design[:, 2][:, driven] if not axes[[2, 3, 4]].any() else design.reshape(-1, 6)[:, driven]
        right = wanted[:, 2] if not axes[[2, 3, 4]].any() else wanted.ravel()
        twists[i, driven] = np.linalg.lstsq(rows, right, rcond=None)[0]
    T_contact = T_base_flange @ T_flange_contact @ frames.exp(twists)
    return ShapeStep(T_contact @ frames.inverse(T_flange_contact), twists, deviations)


def largest_deviations(deviations: Array, control: ControlPoints) -> Array:
    """(N,) largest deviation across the panel's surface (along a contact frame's z) at each clamp, mm."""
    across = np.einsum("ki,ki->k", deviations, control.T_panel_contact[control.clamp][:, :3, 2])
    clamps = range(len(control.T_panel_contact))
    return np.array([np.abs(across[control.clamp == i]).max(initial=0.0) for i in clamps])
