"""A drilling cell with known truth: a curved panel that stands a little wrong, and a robot that is a little wrong.

Geometry after KUKA KR30-3 work on an aircraft panel: work plane at 186.61 mm, tilted camera of 2448 x 2050 pixels
behind a 23 mm lens, four rangers around the tool, six reference holes and eight holes to drill in two groups.
Lengths in mm. Camera axes: x right, y down, z forward.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames

HEIGHT = 186.61
IMAGE = (2448, 2050)
FOCAL = 23.0 / 3.45e-3  # pixels
HOLE_DIAMETER = 5.0
GROUPS = {
    "1": (("101", "102", "105", "106"), ("1001", "1006", "1007", "1008")),
    "2": (("102", "103", "104", "105"), ("1002", "1003", "1004", "1005")),
}
# Across and along the panel from its middle: two rows of three reference holes, two squares of holes between them.
_PLAN = {
    **dict(zip(("101", "102", "103"), ((-150, 60), (0, 60), (150, 60)), strict=True)),
    **dict(zip(("104", "105", "106"), ((150, -60), (0, -60), (-150, -60)), strict=True)),
    **dict(zip(("1001", "1006", "1007", "1008"), ((-105, 30), (-45, 30), (-45, -30), (-105, -30)), strict=True)),
    **dict(zip(("1002", "1003", "1004", "1005"), ((45, 30), (105, 30), (105, -30), (45, -30)), strict=True)),
}
NINE = np.array([[x, y] for y in (-12.0, 0.0, 12.0) for x in (-12.0, 0.0, 12.0)])
# T_tool_flange: the flange's origin lies HEIGHT behind the tool's, with the same axes.
_LIFT = frames.make(np.eye(3), np.array([0.0, 0.0, -HEIGHT]))


@dataclass(frozen=True)
class Sizes:
    """Error sizes; the defaults bring the source's errors before compensation."""

    part_shift: float = 2.58  # mm, mostly along the holes
    part_turn: float = 0.04  # deg
    tool_tilt: float = 3.0  # deg
    local_tilt: float = 0.3  # deg, of single holes against their stated direction
    stretch: float = 4e-4  # of positions, a robot's smooth error
    wave: float = 0.05  # mm, what its gears add over 400 mm
    repeat: float = 0.03  # mm
    ranger: float = 0.05  # mm, one reading; 15 are averaged
    linearity: float = 0.03  # mm, a fixed error of each ranger that changes with the distance
    pixel: float = 0.15
    k1: float = 0.0  # relative radial shift at the image corner
    plate_height: float = 0.0  # mm, true minus stated


@dataclass
class DrillingCell:
    """The true cell; `measure` is what the machine does on command."""

    seed: int
    sizes: Sizes = Sizes()
    panel_radius: float = 2000.0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = rng = np.random.default_rng(self.seed)
        s = self.sizes
        self.nominal = {name: self._nominal(*at) for name, at in _PLAN.items()}
        mostly_down = np.array([0.5, 0.0, -0.85]) + rng.normal(0, 0.05, 3)
        mostly_down = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).apply(mostly_down)
        self.shift = s.part_shift * mostly_down / np.linalg.norm(mostly_down)
        self.T_part = frames.exp(np.append(np.radians(rng.normal(0, s.part_turn, 3)), np.zeros(3)))
        bearing = rng.uniform(0, 2 * np.pi)
        self.tool_turn = Rotation.from_rotvec(np.radians(s.tool_tilt) * np.array([np.cos(bearing), np.sin(bearing), 0]))
        self.wave_phase = rng.uniform(0, 2 * np.pi, (3, 3))
        self.linearity_phase = rng.uniform(0, 2 * np.pi, (4, 1))
        self.stretch = rng.normal(0, s.stretch, (3, 3))
        self.actual = {name: self._actual(*hole) for name, hole in self.nominal.items()}
        self.reached: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # drive coordinates of holes that were found
        tilt = np.radians(25 + rng.normal(0, 1))
        # The camera stands beside the tool, looks at the work plane's centre and keeps 280 mm from it.
        look = Rotation.from_euler("y", tilt).as_matrix()
        self.T_flange_camera = frames.make(look, np.array([0, 0, HEIGHT]) - 280 * look[:, 2])
        angle = np.pi / 4 + np.arange(4) * np.pi / 2 + rng.normal(0, 0.02, 4)
        ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        self.ranger_origins = 35 * ring + [0, 0, HEIGHT - 40]
        inward = -0.25 * ring + [0, 0, 1] + rng.normal(0, 0.005, (4, 3))
        self.ranger_directions = inward / np.linalg.norm(inward, axis=1, keepdims=True)

    def _nominal(self, across: float, along: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and inward direction on a cylinder about an axis along y, in front of the robot."""
        a = across / self.panel_radius
        inward = np.array([-np.sin(a), 0.0, -np.cos(a)])
        middle, lean = np.array([1400.0, 0.0, 900.0]), Rotation.from_euler("zy", [0.4, 0.3])
        local = np.array([0, along, 0]) - self.panel_radius * (inward + np.array([0.0, 0.0, 1.0]))
        return middle + lean.apply(local), lean.apply(inward)

    def _actual(self, position: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle = np.array([1400.0, 0.0, 900.0])
        turn = self.T_part[:3, :3]
        bend = Rotation.from_rotvec(np.radians(self.rng.normal(0, self.sizes.local_tilt, 3)))
        return middle + turn @ (position - middle) + self.shift, turn @ bend.apply(direction)

    def true_pose(self, T_base_tool: np.ndarray) -> np.ndarray:
        """Where the tool truly goes when the controller is sent to T_base_tool."""
        away = T_base_tool[:3, 3] - [1400.0, 0.0, 900.0]
        wave = self.sizes.wave * np.sin(2 * np.pi * away / 400 + self.wave_phase).sum(axis=1) * np.sqrt(2 / 3)
        moved = T_base_tool[:3, 3] + self.stretch @ away + wave + self.rng.normal(0, self.sizes.repeat, 3)
        return frames.make(T_base_tool[:3, :3] @ self.tool_turn.as_matrix(), moved)

    def measure(self, name: str, T_base_tool: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move, then read the four rangers (mean of 15) and the hole's image point."""
        T_flange_base = frames.inverse(self.true_pose(T_base_tool) @ _LIFT)
        position, direction = self.actual[name]
        centre = frames.transform(T_flange_base, position[None])[0]
        normal = T_flange_base[:3, :3] @ direction
        ranges = self._read(self.ranges(centre, normal))
        return ranges, self.image(centre[None])[0] + self.rng.normal(0, self.sizes.pixel, 2)

    def ranges(self, centre: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Beam lengths to the panel around a hole: (p − c)·n = (across² of p − c) / (2 radius), sagging inwards."""
        d = ((centre - self.ranger_origins) @ normal) / (self.ranger_directions @ normal)
        # Across is taken as the flange's x: which way the panel bends does not matter at this size.
        for _ in range(5):
            across = (self.ranger_origins + d[:, None] * self.ranger_directions - centre)[:, 0]
            d = ((centre - self.ranger_origins) @ normal + across**2 / (2 * self.panel_radius)) / (
                self.ranger_directions @ normal
            )
        return d

    def image(self, points: np.ndarray) -> np.ndarray:
        """Exact image points (N, 2) of points (N, 3) in the flange frame."""
        p = frames.transform(frames.inverse(self.T_flange_camera), points)
        arm = FOCAL * p[:, :2] / p[:, 2:]
        corner = np.hypot(*IMAGE) / 2
        return arm * (1 + self.sizes.k1 * (arm**2).sum(-1, keepdims=True) / corner**2) + np.array(IMAGE) / 2 - 0.5

    def plate(self) -> tuple[np.ndarray, np.ndarray]:
        """Nine holes as stated in the flange frame (9, 3), and their image points (9, 2)."""
        stated = np.column_stack([NINE, HEIGHT + self.rng.uniform(-0.11, 0.12, 9) * 0.3])
        true = stated + self.rng.normal(0, 0.005, (9, 3)) + [0, 0, self.sizes.plate_height]
        return stated, self.image(true) + self.rng.normal(0, self.sizes.pixel, (9, 2))

    def check_holes(self, heights: tuple[float, ...] = (-4.0, 0.0, 4.0)) -> tuple[np.ndarray, np.ndarray]:
        """One hole seen at a grid of places over the image and at several heights: flange frame, image points."""
        x, y, z = np.meshgrid(np.linspace(-36, 36, 5), np.linspace(-30, 30, 5), HEIGHT + np.array(heights))
        stated = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        true = stated + self.rng.normal(0, 0.01, stated.shape)
        return stated, self.image(true) + self.rng.normal(0, self.sizes.pixel, (len(stated), 2))

    def plane_readings(self, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
        """Planes (count, 4) in the flange frame and the readings (4, count) of the rangers at each."""
        turn = Rotation.from_euler("xy", np.radians(self.rng.uniform(-15, 15, (count, 2))))
        normals = turn.apply([0.0, 0.0, 1.0])
        offsets = -normals[:, 2] * (HEIGHT + self.rng.uniform(-20, 20, count))
        d = -((self.ranger_origins @ normals.T) + offsets) / (self.ranger_directions @ normals.T)
        return np.column_stack([normals, offsets + self.rng.normal(0, 0.01, count)]), self._read(d)

    def _read(self, d: np.ndarray) -> np.ndarray:
        """What the rangers show for true lengths (4,) or (4, N): the mean of 15, with their fixed errors."""
        phase = self.linearity_phase.reshape(4, *[1] * (d.ndim - 1))
        fixed = np.sqrt(2) * self.sizes.linearity * np.sin(2 * np.pi * d / 40 + phase)
        return d + fixed + self.rng.normal(0, self.sizes.ranger / np.sqrt(15), d.shape)

    def errors(self, name: str, T_base_tool: np.ndarray) -> tuple[float, float]:
        """True distance (mm) and angle (deg) of the tool from the actual hole when sent to T_base_tool."""
        T = self.true_pose(T_base_tool)
        position, direction = self.actual[name]
        angle = np.arctan2(np.linalg.norm(np.cross(T[:3, 2], direction)), T[:3, 2] @ direction)
        return float(np.linalg.norm(T[:3, 3] - position)), float(np.degrees(angle))
