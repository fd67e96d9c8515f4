"""A small world that shares no code with stitch: an arm, a part, a scanner, and what goes wrong at any place.

Rotations are SciPy's, kinematics and sampling are written here. A session comes out as plain arrays
(`Session.from_arrays`): labelled balls, or clouds of a wavy plate whose height is a sum of sines.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = np.ndarray
# Rows of a table after Denavit and Hartenberg (mm, degrees), masses (kg) and centres of mass in each link's own frame.
ROWS = [(30, -90, 420), (580, 0, 0), (40, -90, 0), (0, 90, 560), (0, -90, 0), (0, 0, 95)]
ZERO_DEG = (0, -90, 0, 0, 0, 0)
MASSES = (18.0, 14.0, 9.0, 5.0, 2.5, 0.5)
COMS = ((-15, 60, 0), (-290, 0, 60), (-20, 0, 30), (0, -150, 0), (0, 10, 0), (0, 0, -10))
LOAD, LOAD_COM = 4.0, (0, 0, 90)
# Scatter of a flange (rad, mm) along each axis, and of a coordinate that is measured (mm).
SCATTER, NOISE = (2e-5, 0.015), 0.012
BALLS = np.array([[90, 60, 5], [-80, 75, 40], [-95, -60, 12], [70, -85, 55], [0, 10, 80]], float)
_START = np.radians([10, 25, 15, 20, 55, 30])
_WAVES = np.array([[0.031, 0.009, 4.0], [0.012, -0.036, 5.0], [0.055, 0.042, 1.6], [-0.024, 0.071, 1.2]])


@dataclass
class World:
    """What is known of a session, and what truly happened."""

    mount: str
    joints: Array  # (V, 6) rad
    seconds: Array  # (V,)
    columns: dict[str, Array]  # (V,) of views.csv
    base: Array = field(init=False)  # (V, 6) turn and shift of the arm's foot, base frame; likewise the others
    tool: Array = field(init=False)  # of what hangs at the flange, flange frame
    stand: Array = field(init=False)  # of what stands in the cell, base frame
    wrong: Array = field(init=False)  # (V, 6) of the joints, rad
    seen: Callable[[Array, int], Array] = lambda points, view: points  # as the scanner reports them

    def __post_init__(self) -> None:
        n = len(self.joints)
        self.base, self.tool, self.stand, self.wrong = (np.zeros((n, 6)) for _ in range(4))

    @property
    def moves(self) -> Array:
        """(V, 6) −1, 0, 1: how each joint came."""
        return np.sign(np.diff(self.joints, axis=0, prepend=self.joints[:1]))

    @property
    def moment(self) -> Array:
        """(V, 3) of the weight of links and load about the foot, N m, base frame."""
        total = np.zeros((len(self.joints), 3))
        for v, q in enumerate(self.joints):
            frames = chain(q)
            for T, mass, com in zip((*frames[1:], frames[-1]), (*MASSES, LOAD), (*COMS, LOAD_COM), strict=True):
                total[v] += np.cross((T[:3, :3] @ com + T[:3, 3]) / 1e3, [0, 0, -9.81 * mass])
        return total


def chain(q: Array) -> list[Array]:
    """(7, 4, 4) frames of the links for joint angles (6,), the foot's first."""
    frames = [np.eye(4)]
    for (a, alpha, d), angle, zero in zip(ROWS, q, np.radians(ZERO_DEG), strict=True):
        turn = Rotation.from_euler("z", angle + zero) * Rotation.from_euler("x", alpha, degrees=True)
        step = np.eye(4)
        step[:3, :3] = turn.as_matrix()
        step[:3, 3] = [a * np.cos(angle + zero), a * np.sin(angle + zero), d]
        frames.append(frames[-1] @ step)
    return frames


def small(xi: Array) -> Array:
    """(4, 4) of a small turn (rad) and shift (mm)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(xi[:3]).as_matrix()
    T[:3, 3] = xi[3:]
    return T


def draw_world(mount: str, views: int, rng: np.random.Generator) -> tuple[World, Array, Array]:
    """Return a world in which nothing is wrong yet, T_mount (4, 4), and the part's frame (4, 4) where it hangs."""
    hand = small(np.append(rng.uniform(-0.4, 0.4, 3), [*rng.uniform(-40, 40, 2), 110]))
    middle = chain(_START)[-1] @ hand @ small(np.array([0, 0, 0, 0, 0, 380.0]))
    joints = []
    while len(joints) < views:
        tilt = Rotation.from_euler("zy", [rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.6)])
        turn = middle[:3, :3] @ (tilt * Rotation.from_euler("z", rng.uniform(-1.2, 1.2))).as_matrix()
        away = np.array([*rng.uniform(-45, 45, 2), rng.uniform(330, 430)])
        target = np.eye(4)
        target[:3, :3] = turn
        # A scanner turns about what it sees; a part turns about itself before the scanner.
        target[:3, 3] = middle[:3, 3] - (turn if mount == "eye_in_hand" else middle[:3, :3]) @ away

        def miss(q: Array, goal: Array = target) -> Array:
            off = np.linalg.inv(goal) @ chain(q)[-1] @ hand
            return np.append(200 * Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3])

        best = least_squares(miss, joints[-1] if joints and rng.random() < 0.5 else _START)
        if best.cost < 1e-6 and np.abs(best.x).max() < 2.9:
            joints.append(best.x)
    steps = rng.uniform(40, 80, views) + 900 * (rng.random(views) < 0.08)
    seconds = np.cumsum(steps)
    at = seconds / seconds[-1]
    warm = 21 + 3 * np.sin(rng.uniform(2, 5) * at + rng.uniform(0, 6)) + 0.25 * np.cumsum(rng.standard_normal(views))
    blocks = np.cumsum(rng.random(views) < 0.25)
    columns = {
        "ambient_c": warm,
        "spindle_load": rng.uniform(5, 90, blocks[-1] + 1)[blocks] + rng.uniform(-3, 3, views),
        "coolant_on": (blocks + rng.integers(2)) % 2.0,
        "air_bar": 6 + 0.3 * np.sin(rng.uniform(6, 14) * at + rng.uniform(0, 6)) + 0.04 * rng.standard_normal(views),
    }
    return World(mount, np.array(joints), seconds, columns), hand, middle


def measured(world: World, hand: Array, middle: Array, clouds: bool, rng: np.random.Generator) -> dict[str, Any]:
    """Return the arguments of `Session.from_arrays`.

    The scanner hangs at the flange over a part that stands, or the part hangs there before a scanner that stands.
    """
    in_hand = world.mount == "eye_in_hand"
    facing = small(np.array([np.pi, 0, 0, 0, 0, 0]))
    shown = []
    for v, q in enumerate(world.joints):
        noise = np.append(rng.standard_normal(3) * SCATTER[0], rng.standard_normal(3) * SCATTER[1])
        flange = small(world.base[v]) @ chain(q + world.wrong[v])[-1] @ small(noise)
        hangs = flange @ small(world.tool[v]) @ hand
        stands = small(world.stand[v]) @ middle
        part, scanner = (stands, hangs) if in_hand else (hangs, stands @ facing)
        to_scanner = np.linalg.inv(scanner) @ part
        points = _surface(to_scanner, rng) if clouds else BALLS
        own = world.seen(points @ to_scanner[:3, :3].T + to_scanner[:3, 3], v)
        ray = own / np.linalg.norm(own, axis=1, keepdims=True)
        noisy = rng.standard_normal((len(own), 1)) * ray if clouds else rng.standard_normal(own.shape)
        shown.append(own + NOISE * noisy)
    robot = {
        "dh": "standard",
        "name": "small arm",
        "payload": {"mass": LOAD, "com": list(LOAD_COM)},
        "gravity": [0, 0, -9.81],
        "joints": [
            {"a": a, "alpha_deg": alpha, "d": d, "theta_deg": zero, "mass": mass, "com": list(com)}
            for (a, alpha, d), zero, mass, com in zip(ROWS, ZERO_DEG, MASSES, COMS, strict=True)
        ],
    }
    points = None if clouds else [{f"b{i}": x for i, x in enumerate(seen)} for seen in shown]
    return {
        "clouds": shown if clouds else None,
        "points": points,
        "poses": np.array([chain(q)[-1] for q in world.joints]),
        "mount": world.mount,
        "joints": world.joints,
        "robot": robot,
        "times": world.seconds,
        "covariates": world.columns,
        "scanner": {"noise": NOISE, "standoff": 380.0},
        "check": False,
    }


def _surface(to_scanner: Array, rng: np.random.Generator, count: int = 2500) -> Array:
    """(N, 3) points of the wavy plate that lie in the scanner's field, part frame."""
    xy = rng.uniform(-110, 110, (3 * count, 2))
    z = (_WAVES[:, 2] * np.sin(xy @ _WAVES[:, :2].T + np.arange(4))).sum(axis=1)
    points = np.column_stack([xy, z])
    own = points @ to_scanner[:3, :3].T + to_scanner[:3, 3]
    inside = (np.abs(own[:, :2] / np.abs(own[:, 2:])) < 0.2).all(axis=1)
    return points[inside][:count]
