"""What is going on in the cell while one view is taken."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_synth.arms import Arm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Moment:
    """One view. Angles in rad, lengths in mm, temperatures in °C, time in s."""

    index: int
    time: float  # since the first view
    arm: Arm  # as the controller knows it
    joints: Array  # (n,) reported
    previous: Array  # (n,) of the view before; its own for the first
    approach: Array  # (n,) −1, 0, +1
    velocity: Array  # (n,) rad/s while scanning
    torque: Array  # (n,) N·m of gravity
    covariates: dict[str, float]
    start: dict[str, float]  # covariates of the first view
    gravity_part: Array  # (3,) unit vector in the part frame
    gravity_reference: Array  # (3,) in the frame that holds the part: flange or base
    gravity_mount: Array  # (3,) in the frame that holds the scanner
    standoff: float


@dataclass(frozen=True)
class Plan:
    """All views as the controller knows them."""

    joints: Array  # (V, n) reported
    torque: Array  # (V, n)
    velocity: Array  # (V, n)
    arm: Arm
    useful: tuple[int, ...]  # joints (from 0) whose errors this cell can show
