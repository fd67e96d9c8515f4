"""Twenty errors of a cell by physics, written down by somebody who had not read the library of effects.

Each law says where the error lives, what it follows, and how large it usually is. Half of them stand in textbooks,
half need not. A law acts on a cell of `bench/outside_world.py`: it adds to the motions of a place in each view, or to
the ranges of the scanner. Lengths in mm, angles in rad, temperatures in degrees Celsius, a twist is (rotation,
translation).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.outside_world import FIELD, Cell

# Gears and encoders of a wrist are smaller, and worse by this factor.
WRIST = 2.5


@dataclass(frozen=True)
class Law:
    """One physical error."""

    place: str  # base, joint, link, mount, part or scanner
    follows: str  # a column of views.csv, or in words
    size: float  # usual
    unit: str  # of the size, with what it is the size of
    textbook: bool
    act: Callable[[Cell, float, np.random.Generator], int | None]  # the law in the cell; which joint, link or view
    clouds_only: bool = False


def _pedestal(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.base[:, 5] += size * (cell.columns["ambient_temperature_c"] - 20)


def _press(cell: Cell, size: float, rng: np.random.Generator) -> None:
    direction, period = rng.uniform(0, 2 * np.pi), rng.uniform(400, 900)
    wave = size * np.sin(2 * np.pi * cell.time / period + rng.uniform(0, 2 * np.pi))
    cell.base[:, :2] += wave[:, None] * [np.cos(direction), np.sin(direction)]


def _spring(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint = int(rng.integers(2, 4))
    cell.joints[:, joint - 1] += size * cell.torques[:, joint - 1]
    return joint


def _any_joint(cell: Cell, rng: np.random.Generator, first: int = 1, last: int = 6) -> tuple[int, float]:
    joint = int(rng.integers(first, last + 1))
    return joint, WRIST if joint > 3 else 1.0


def _code_disc(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, factor = _any_joint(cell, rng)
    cell.joints[:, joint - 1] += size * factor * np.sin(cell.q[:, joint - 1] + rng.uniform(0, 2 * np.pi))
    return joint


def _backlash(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, factor = _any_joint(cell, rng)
    cell.joints[:, joint - 1] -= size * factor / 2 * np.sign(cell.moves[:, joint - 1])
    return joint


def _late_clock(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.joints += size * cell.velocities


def _wrist_coupling(cell: Cell, size: float, rng: np.random.Generator) -> int:
    cell.joints[:, 5] += size * cell.q[:, 4]
    return 6


def _brake(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, _ = _any_joint(cell, rng, 1, 3)
    cell.joints[:, joint - 1] -= size * (cell.columns["wait_s"] > 15)
    return joint


def _creeps_in(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, factor = _any_joint(cell, rng)
    left = np.exp(-cell.columns["wait_s"] / 8)
    cell.joints[:, joint - 1] -= size * factor * cell.moves[:, joint - 1] * left
    return joint


def _warm_link(cell: Cell, size: float, rng: np.random.Generator) -> int:
    link = int(rng.integers(2, 4))
    along = cell.link_vectors[link - 1]
    cell.links[link - 1, :, 3:] += size * (cell.columns["robot_temperature_c"][:, None] - 22) * along
    return link


def _droop(cell: Cell, size: float, rng: np.random.Generator) -> None:
    down = cell.down_in_flange
    cell.mount[:, :3] += size * np.cross([0, 0, 1], down)
    cell.mount[:, 3:5] += size * 40 * down[:, :2]


def _hose(cell: Cell, size: float, rng: np.random.Generator) -> int:
    angle = cell.q[:, 5] * rng.choice([-1, 1])
    slack = np.median(angle)
    cell.mount[:, 0] += size * np.maximum(angle - slack, 0) / np.ptp(angle)
    return 6


def _loose_bolt(cell: Cell, size: float, rng: np.random.Generator) -> None:
    seat = np.sign(cell.down_in_flange[0, 1])
    for view, side in enumerate(cell.down_in_flange[:, 1]):
        seat = np.sign(side) if abs(side) > 0.15 else seat
        cell.mount[view] += seat * size * np.array([0, 0, 1.5e-3, 0, 1, 0])


def _direction(rng: np.random.Generator) -> np.ndarray:
    direction = rng.standard_normal(3)
    return direction / np.linalg.norm(direction)


def _knock(cell: Cell, size: float, rng: np.random.Generator) -> int:
    views = len(cell.q)
    first = int(rng.integers(views // 4, views * 3 // 4 + 1))
    cell.stand[first:] += np.r_[1.5e-3 * size * _direction(rng), size * _direction(rng)]
    return first


def _glue(cell: Cell, size: float, rng: np.random.Generator) -> None:
    way = np.log1p(cell.time / 60) / np.log1p(cell.time[-1] / 60)
    cell.part[:, 3:] += size * way[:, None] * _direction(rng)


def _clamp(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.part[:, 3:] += size * (cell.columns["supply_pressure_bar"][:, None] - 6) * _direction(rng)


def _bowl(cell: Cell, size: float, rng: np.random.Generator) -> None:
    edge = FIELD**2
    cell.ranges.append(lambda p, cosine: size * (p[..., 0] ** 2 + p[..., 1] ** 2) / p[..., 2] ** 2 / edge)


def _steep(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.ranges.append(lambda p, cosine: size * (1 / cosine - 1))


def _warm_scanner(cell: Cell, size: float, rng: np.random.Generator) -> None:
    warm = cell.columns["scanner_temperature_c"] - 30
    cell.stand += size * warm[:, None] * [0, 1, 0, 200, 0, 0]


def _far_and_near(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.ranges.append(lambda p, cosine: size * ((p[..., 2] - 400) / 50) ** 2)


LAWS = {
    "pedestal grows with the room": Law(
        "base", "ambient_temperature_c", 9.2e-3, "mm/K, 0.8 m of steel", True, _pedestal
    ),
    "press next door rocks the base": Law("base", "time_s", 4e-5, "rad, in waves of 400 to 900 s", False, _press),
    "joint gives way to the load": Law("joint", "gravity", 1e-4, "rad at the largest static torque", True, _spring),
    "code disc off its centre": Law("joint", "own angle", 5e-5, "rad, once a turn", True, _code_disc),
    "play in a gear": Law("joint", "approach", 1e-4, "rad, lost motion", True, _backlash),
    "poses read late in motion": Law("joint", "velocity", 5e-4, "s", True, _late_clock),
    "joint 5 turns joint 6": Law("joint", "j5_deg", 3e-4, "rad/rad", False, _wrist_coupling),
    "brake falls in after a wait": Law("joint", "wait_s", 6e-5, "rad from 15 s on", False, _brake),
    "coupling creeps in behind a move": Law("joint", "move, wait_s", 2e-4, "rad/rad, fading in 8 s", False, _creeps_in),
    "one link grows warm": Law("link", "robot_temperature_c", 1.15e-5, "1/K of its length", True, _warm_link),
    "adapter droops at the flange": Law("mount", "gravity", 2e-4, "rad where horizontal", True, _droop),
    "hose pulls once it is taut": Law("mount", "j6_deg", 3e-4, "rad at the end of the range", False, _hose),
    "loose bolt with two seats": Law("mount", "gravity", 0.04, "mm from the middle to a seat", False, _loose_bolt),
    "scanner is knocked": Law("scanner", "view", 0.08, "mm, and 1.5 mrad for a mm", True, _knock),
    "glue creeps under the part": Law("part", "time_s", 0.08, "mm over the session, a logarithm", False, _glue),
    "clamp follows the air supply": Law("part", "supply_pressure_bar", 0.25, "mm/bar", False, _clamp),
    "field of the scanner is a bowl": Law("scanner", "field", 0.05, "mm at the field's edge", True, _bowl),
    "steep surfaces look farther": Law("scanner", "incidence", 0.025, "mm at 60 degrees", False, _steep, True),
    "scanner's axis drifts as it warms": Law("scanner", "scanner_temperature_c", 4e-5, "rad/K", True, _warm_scanner),
    "near and far look farther": Law("scanner", "distance", 0.025, "mm at 50 mm from the middle", False, _far_and_near),
    "nothing": Law("", "", 0.0, "", True, lambda cell, size, rng: None),
}

# Written once the laws were fixed: the library's effects that are one of them by another name.
NAMES = {
    "joint gives way to the load": ("joint_compliance",),
    "code disc off its centre": ("gear_eccentricity",),
    "play in a gear": ("backlash",),
    "poses read late in motion": ("latency",),
    "coupling creeps in behind a move": ("settling",),
    "one link grows warm": ("robot_thermal_growth", "link_thermal"),
    "adapter droops at the flange": ("mount_droop", "mount_bend", "fixture_droop", "fixture_bend"),
    "scanner is knocked": ("mount_step",),
    "field of the scanner is a bowl": ("field_curvature",),
    "steep surfaces look farther": ("incidence_bias",),
    "near and far look farther": ("range_nonlinearity",),
}
