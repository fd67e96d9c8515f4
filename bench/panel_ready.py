"""Simulated panel cells made ready: calibrated, pre-positioned, the panel laid on."""

from dataclasses import dataclass

import numpy as np
from panel_loops import PanelSetup, ShapeRun, run_pose, run_shape

from data_synth.cells import panel_job
from data_synth.cells.panel import NAMES, PanelCell
from stitch.numerics import frames
from stitch.plugins.cells.panel_model import (
    ClampLayout,
    ControlPoints,
    LaserTracker,
    ReflectorReadings,
    calibrate_robot,
    clamp_contacts,
    preposition,
    rigid_fit,
)

LAYOUT = ClampLayout(**panel_job.LAYOUT, columns=3)
POSES, MASTER, TOLERANCE = 40, 1, 0.6


@dataclass
class Ready:
    """A cell with its panel on the clamps."""

    cell: PanelCell
    stage: PanelSetup
    readings: list[ReflectorReadings]
    T_base_flange: np.ndarray


def ready(seed: int, **settings) -> Ready:
    """Calibrate, pre-position, lay the panel on."""
    r = ready_without_panel(seed, **settings)
    r.cell.lay()
    return r


def ready_without_panel(seed: int, **settings) -> Ready:
    cell = PanelCell(seed, **settings)
    tracker = LaserTracker(cell.tracker)
    readings = read(cell, tracker)
    stage = PanelSetup([calibrate_robot(r) for r in readings], MASTER, tracker, cell.target)
    base, contact = (np.array([getattr(m, n) for m in stage.models]) for n in ("T_world_base", "T_flange_contact"))
    start = preposition(base, cell.target, clamp_contacts(LAYOUT).T_panel_contact, contact)
    cell.drive(start)
    return Ready(cell, stage, readings, start)


def read(cell: PanelCell, tracker: LaserTracker) -> list[ReflectorReadings]:
    commands = panel_job.calibration_poses(POSES, cell.seed)
    seen = panel_job.calibration(cell, commands)
    return [ReflectorReadings(n, commands[:, i], seen[:, i], tracker.sigma(seen[:, i])) for i, n in enumerate(NAMES)]


def pose_error(cell: PanelCell) -> np.ndarray:
    """(6,) true error of the panel's pose: rotation in deg, then mm; from the targets' true places."""
    targets = panel_job.pose_targets()
    T = rigid_fit(targets, cell.true_points(targets), np.ones(len(targets))).T
    e = frames.log(frames.inverse(cell.target) @ T)
    return np.concatenate([np.degrees(e[:3]), e[3:]])


def shape_run(seed: int, compliant: bool, axes: np.ndarray, tolerance: float = TOLERANCE) -> ShapeRun:
    r = ready(seed)
    stand = run_pose(r.cell, r.stage, panel_job.pose_targets(), r.T_base_flange)
    r.cell.compliant = compliant
    control = ControlPoints(*panel_job.control_points(), clamp_contacts(LAYOUT).T_panel_contact)
    return run_shape(r.cell, r.stage, control, stand, tolerance=tolerance, axes=axes)
