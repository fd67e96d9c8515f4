"""The closed loops of a panel cell on any machines that drive and measure: pose first, then shape.

`stitch panel` gives the commands of one step from files; a loop drives, measures and steps again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.panel_model import (
    SHAPE_AXES,
    ControlPoints,
    LaserTracker,
    RigidFit,
    RobotModel,
    adjust_pose,
    largest_deviations,
    rigid_fit,
    shape_step,
)

_MOST_CORRECTIONS = 10


class PanelMachines(Protocol):
    """What a loop needs of the machines."""

    def drive(self, T_base_flange: Array, /) -> None:
        """All robots to poses (N, 4, 4)."""

    def track(self, nominal: Array, /) -> Array:
        """Readings (K, 3), world frame, of the panel's targets given by their nominal places (K, 3)."""

    def forces(self) -> Array:
        """(N, 6) change of torques and forces at the clamps since the panel was laid on."""


@dataclass(frozen=True)
class PanelSetup:
    """Where the panel shall go, and what holds it."""

    models: Sequence[RobotModel]
    master: int
    tracker: LaserTracker
    T_world_target: Array  # (4, 4)


@dataclass(frozen=True)
class ShapeRun:
    """Deviations and forces, first before any correction."""

    T_base_flange: Array  # (N, 4, 4) at the end
    deviations: list[Array]  # (N,) mm each
    forces: list[Array]  # (N, 6) each


def measure_pose(cell: PanelMachines, setup: PanelSetup, targets: Array) -> RigidFit:
    """The panel's pose from its targets (K, 3), panel frame."""
    seen = cell.track(targets)
    return rigid_fit(targets, seen, setup.tracker.sigma(seen))


def run_pose(cell: PanelMachines, setup: PanelSetup, targets: Array, T_base_flange: Array) -> Array:
    """One adjustment: measure, move master and slaves; returns where the robots stand then, (N, 4, 4)."""
    bases = np.array([m.T_world_base for m in setup.models])
    T_world_panel = measure_pose(cell, setup, targets).T
    moved = adjust_pose(bases, T_base_flange, setup.master, T_world_panel, setup.T_world_target)
    cell.drive(moved)
    return moved


def run_shape(
    cell: PanelMachines,
    setup: PanelSetup,
    control: ControlPoints,
    T_base_flange: Array,
    *,
    tolerance: float,
    axes: Array = SHAPE_AXES,
) -> ShapeRun:
    """Correct from poses (N, 4, 4) on until all control points are within the tolerance, mm.

    Raises:
        NoResultError: they are not after ten corrections.
    """
    contact = np.array([m.T_flange_contact for m in setup.models])
    deviations: list[Array] = []
    forces: list[Array] = []
    T_target_world = frames.inverse(setup.T_world_target)
    for _ in range(_MOST_CORRECTIONS + 1):
        seen = frames.transform(T_target_world, cell.track(control.nominal))
        step = shape_step(seen, control, T_base_flange, contact, axes=axes)
        deviations.append(largest_deviations(step.deviations, control))
        forces.append(cell.forces())
        if deviations[-1].max() <= tolerance:
            return ShapeRun(T_base_flange, deviations, forces)
        T_base_flange = step.T_base_flange
        cell.drive(T_base_flange)
    raise NoResultError(
        f"shape: still {deviations[-1].max():.2f} mm off after {_MOST_CORRECTIONS} corrections "
        f"(tolerance {tolerance:g} mm); look at the forces, or check that control points and clamps belong together"
    )
