"""A panel cell with known truth: six parallel robots hold an elastic panel, a laser tracker measures it.

Geometry after the source: radius 2960, span 2048, length 3100 mm, tracker 10 µm + 5 µm/m. Lengths in mm, forces in N.
Robots stand below the panel; the world's z points up, the panel's z outwards and so down.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.cells import hexapod
from data_synth.shell import HeldShell, Laminate, Shell
from stitch.numerics import frames

Array = NDArray[np.float64]

RADIUS, SPAN, LENGTH = 2960.0, 2048.0, 3100.0
NAMES = ("A", "B", "C", "D", "E", "F")
_COMPLIANT = np.tile([False, False, True, True, True, False], 6)  # turn about z, then x and y
_ROTATION_FIRST = np.array([0.0, 0.0, -9810.0])
_STEEL, _WARMS = 11.5e-6, 20.0  # growth 1/K of a leg; moves in which two thirds of its warmth come


@dataclass(frozen=True)
class Sizes:
    """Error sizes; the tracker's are taken as one sigma of each coordinate."""

    base: tuple[float, float] = (10.0, 1.0)  # mm, deg: robots against their drawing
    clamp: tuple[float, float] = (3.0, 0.5)  # mm, deg: clamps on their flanges
    leg: float = 0.004  # mm, repeatability of one leg
    joint: float = 0.0  # mm, along each axis, of every joint of base and platform against the controller's
    bend: float = 0.0  # mm/N, what a leg gives under the panel
    warm: float = 0.0  # K, by which the legs warm up in the end, two thirds of it within twenty moves
    tracker: tuple[float, float] = (0.010, 5e-6)
    laid: tuple[float, float] = (4.0, 0.12)  # mm, deg: the panel as it is laid on the clamps
    spring_in: float = 9.0  # mm at the panel's long edges, against the CAD
    twist: float = 3.0  # mm at the corners
    bow: float = 1.0  # mm at the ends
    pad: tuple[float, float] = (250.0, 400.0)  # N/mm of one suction pad along and across its axis
    force_control: float = 20.0  # N/mm and, times 300² mm², N·mm/rad, left by force control


@dataclass
class PanelCell:
    """The true cell; `drive` is what the robots do on command, `track` what the tracker sees."""

    seed: int
    sizes: Sizes = Sizes()
    leg_offsets: Array = field(default_factory=lambda: np.zeros((6, 6)))  # mm, by robot and leg
    compliant: bool = False  # force control along x, y and about z of the clamps
    tracker: Array = field(default_factory=lambda: np.array([-3200.0, -1800.0, 1900.0]))
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        upside_down = Rotation.from_euler("ZYX", [2.0, 1.5, 181.0], degrees=True).as_matrix()
        self.target = frames.make(upside_down, [150.0, 80.0, 1400.0])
        triangle = np.array([[-120.0, -180.0, 160.0], [-120.0, 180.0, 160.0], [240.0, 0.0, 160.0]])
        clamps = frames.exp(self._scatter(*self.sizes.clamp, 6))
        self.reflectors = frames.transform(clamps, triangle)  # (6, 3, 3) flange frame
        upright = np.array([self.target @ self.place(*at) for at in self.plan()])
        home = frames.make(np.eye(3), [0.0, 0.0, -160.0 - hexapod.HOME_HEIGHT])
        self.T_world_base = upright @ home @ frames.exp(self._scatter(*self.sizes.base, 6))
        self.T_base_flange = np.tile(frames.make(np.eye(3), [0.0, 0.0, hexapod.HOME_HEIGHT]), (6, 1, 1))
        self.held: HeldShell | None = None
        self.moves = 0
        # Streams of their own: a cell without such errors is the same cell.
        off = self.sizes.joint * np.random.default_rng([self.seed, 5]).standard_normal((2, 6, 6, 3))
        self.base_joints, self.platform_joints = hexapod.BASE + off[0], hexapod.PLATFORM + off[1]

    def _scatter(self, mm: float, deg: float, count: int) -> Array:
        return self.rng.normal(size=(count, 6)) * np.repeat([np.radians(deg), mm], 3)

    @staticmethod
    def plan() -> list[tuple[float, float]]:
        """Where the clamps sit along the panel, mm, and about its axis, rad."""
        return [(x, angle) for x in (-1130.0, 1130.0) for angle in (-0.22, 0.0, 0.22)]

    @staticmethod
    def place(x: float, angle: float) -> Array:
        """Roughly a clamp's frame in the panel's: z inwards, x towards the panel's middle."""
        z = np.array([0.0, -np.sin(angle), -np.cos(angle)])
        ahead = np.array([-np.sign(x), 0.0, 0.0])
        return frames.make(np.column_stack([ahead, np.cross(z, ahead), z]), [x, -RADIUS * z[1], -RADIUS * (z[2] + 1)])

    def drive(self, T_base_flange: Array) -> None:
        """All robots to poses (6, 4, 4); the legs do what they can."""
        self.moves += 1
        grown = _STEEL * self.sizes.warm * (1 - np.exp(-self.moves / _WARMS))
        lengths = np.array([hexapod.lengths(T) for T in T_base_flange])
        self._legs = lengths * (1 + grown) + self.leg_offsets + self.sizes.leg * self.rng.standard_normal((6, 6))
        self._stand(self._legs, T_base_flange)
        self._give()

    def _give(self) -> None:
        """The legs give under the panel, which changes what it does to them: by much less than they give."""
        for _ in range(3 if self.sizes.bend and self.held is not None else 0):
            self._stand(self._legs + self.sizes.bend * self._leg_forces(), self.T_base_flange.copy())

    def _stand(self, lengths: Array, guess: Array) -> None:
        for i, (legs, T) in enumerate(zip(lengths, guess, strict=True)):
            self.T_base_flange[i] = hexapod.forward(legs, T, self.base_joints[i], self.platform_joints[i])

    def _leg_forces(self) -> Array:
        """(6, 6) N, pulling out, by robot and leg: what a clamp's twist makes of the lengths, against its wrench."""
        wrench = self._baseline.reshape(6, 6) + self.state()[2]
        T_flange_contact = frames.inverse(self.T_world_base @ self.T_base_flange) @ self.clamps()
        out = np.zeros((6, 6))
        for i, (T, X) in enumerate(zip(self.T_base_flange, T_flange_contact, strict=True)):
            ends = [hexapod.lengths(T @ X @ frames.exp(d) @ frames.inverse(X)) for d in 1e-6 * np.eye(6)]
            out[i] = np.linalg.solve((np.array(ends) - hexapod.lengths(T)) / 1e-6, wrench[i])
        return out

    def see(self, points: Array) -> Array:
        """The tracker's readings of true points (..., 3), world frame."""
        constant, slope = self.sizes.tracker
        sigma = constant + slope * np.linalg.norm(points - self.tracker, axis=-1, keepdims=True)
        return np.asarray(points + sigma * self.rng.standard_normal(points.shape))

    def see_reflectors(self) -> Array:
        """(6, 3, 3) readings of the three reflectors on each clamp."""
        return self.see(frames.transform(self.T_world_base @ self.T_base_flange, self.reflectors))

    def clamps(self) -> Array:
        """True frames (6, 4, 4) of the clamps in the world: z into the panel."""
        p = frames.transform(self.T_world_base @ self.T_base_flange, self.reflectors)
        x = p[:, 2] - p[:, :2].mean(axis=1)
        z = np.cross(p[:, 2] - p[:, 0], p[:, 1] - p[:, 0])
        x, z = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, z))
        return frames.make(np.stack([x, np.cross(z, x), z], axis=-1), p.mean(axis=1))

    def lay(self) -> None:
        """The panel comes onto the clamps a little off its target and is sucked on where it lies."""
        self.pose = self.target @ frames.exp(self._scatter(*self.sizes.laid, 1)[0])
        self.grip = frames.inverse(self.pose) @ self.clamps()
        world = frames.transform(self.T_world_base @ self.T_base_flange, self.reflectors)
        pads = frames.transform(frames.inverse(self.pose), world.reshape(-1, 3))
        xs = np.column_stack([pads[:, 0], RADIUS * np.arctan2(pads[:, 1], pads[:, 2] + RADIUS)])
        shell = Shell(RADIUS, LENGTH, SPAN, Laminate(), (24, 20))
        along, across = self.sizes.pad
        self.held = shell.hold(xs, np.tile([across, across, along], (18, 1)))
        load = shell.weight(self.pose[:3, :3].T @ _ROTATION_FIRST)
        self._sag, self._moves = self.held.sag(load), self._pad_moves(world, shell, xs)
        self._response = self.held.response(self._moves)
        self._stiffness, self._baseline = self._wrench(self._response, self._moves), self._wrench(self._sag, 0.0)
        self._give()

    def _pad_moves(self, world: Array, shell: Shell, xs: Array) -> Array:
        """(54, 36): displacement of the pads along u, v, w per clamp twist."""
        out = np.zeros((18, 3, 36))
        axes = shell.axes(xs[:, 1])
        inside = frames.transform(frames.inverse(self.clamps()), world)
        for i in range(6):
            R = self.grip[i, :3, :3]
            for k in range(3):
                motion = R @ np.hstack([-frames.skew(inside[i, k]), np.eye(3)])
                out[3 * i + k, :, 6 * i : 6 * i + 6] = axes[3 * i + k].T @ motion
        return out.reshape(54, 36)

    def _wrench(self, unknowns: Array, ends: Array | float) -> Array:
        """What the panel does to the clamps: torques and forces (36, ...), contact frames."""
        assert self.held is not None
        stretch = self.held.at_pads @ unknowns - ends
        springs = self.held.springs[:, None] if stretch.ndim == 2 else self.held.springs
        return np.asarray(self._moves.T @ (springs * stretch))

    def state(self) -> tuple[Array, Array, Array]:
        """Panel pose (4, 4), unknowns of the shell, change of the clamps' torques and forces (6, 6) since laying."""
        clamps, pose = self.clamps(), self.pose
        for _ in range(5):
            off = frames.log(frames.inverse(pose) @ clamps @ frames.inverse(self.grip))
            pose = pose @ frames.exp(off.mean(axis=0))
        q = frames.log(frames.inverse(pose @ self.grip) @ clamps).ravel()
        if self.compliant:
            c, S = _COMPLIANT, self._stiffness
            k = self.sizes.force_control * np.tile([300.0**2] * 3 + [1.0] * 3, 6)[c]
            q[c] = np.linalg.solve(np.diag(k) - S[np.ix_(c, c)], k * q[c] + S[np.ix_(c, ~c)] @ q[~c])
        return pose, self._sag + self._response @ q, (self._stiffness @ q).reshape(6, 6)

    def free_shape(self, xs: Array) -> Array:
        """(N,) how far the panel as made stands outside its CAD, mm."""
        a, b = 2 * xs[:, 0] / LENGTH, 2 * xs[:, 1] / SPAN
        return self.sizes.spring_in * (b**2 - 1 / 3) + self.sizes.twist * a * b + self.sizes.bow * (a**2 - 1 / 3)

    def true_points(self, nominal: Array) -> Array:
        """Where nominal points (N, 3) on or near the panel really are, world frame."""
        assert self.held is not None
        pose, unknowns, _ = self.state()
        xs = np.column_stack([nominal[:, 0], RADIUS * np.arctan2(nominal[:, 1], nominal[:, 2] + RADIUS)])
        local = (self.held.shell.at(xs) @ unknowns).reshape(-1, 3)
        local[:, 2] += self.free_shape(xs)
        return frames.transform(pose, nominal + np.einsum("nij,nj->ni", self.held.shell.axes(xs[:, 1]), local))

    def track(self, nominal: Array) -> Array:
        """The tracker's readings of targets glued at nominal points (N, 3) of the panel, world frame."""
        return self.see(self.true_points(nominal))

    def forces(self) -> Array:
        """(6, 6) change of torques (N·mm) and forces (N) at the sensors since the panel was laid on."""
        return self.state()[2] + self.rng.standard_normal((6, 6)) * np.repeat([200.0, 1.0], 3)
