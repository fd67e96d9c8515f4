"""A line that sets windows, with known truth: a robot on a rail carries one scanner and one gripper.

It scans a sphere, the window in its rack and the body, grips the window, places it and scans the seam. What the
controller reports is where it was sent; where it went differs by the robot's and the carriage's scatter.
Lengths in mm, cell frame: x along the rail, z up; the outer sides of window and body look to +y.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.cells.window_scans import NO_FIELD, Weld, area_scanner, warp
from data_synth.cells.window_views import across_seam, along_edges, looking_at, over, stations
from data_synth.scanner import Cloud, Scanner, profile_times
from data_synth.scanning import scan
from data_synth.shapes import car_door, spheres
from data_synth.shapes.car_door import CarDoor, Pane
from stitch.numerics import frames

Array = NDArray[np.float64]

RADIUS = 30.0  # of the calibration sphere
RAIL, STOP = 4000.0, 500.0  # length, and distance between the carriage's stops
_STANDOFF, _WIDE, _NARROW = 500.0, 30.0, 10.0  # of the scanner; narrow is the middle of its chip, undivided
_SWEEP_SECONDS = 2.0
_SPHERE = np.array([0.0, 0.0, 900.0])


@dataclass(frozen=True)
class Errors:
    """One sigma each; the defaults are those of a good robot and a good scanner, zero switches a source off."""

    noise: float = 0.05  # mm along the ray at the standoff
    turn: float = 20e-6  # rad about each axis of the flange, new at every move
    shift: float = 0.03  # mm along each axis of the flange, new at every move
    rail: float = 0.02  # mm along each axis, new whenever the carriage stops


# Below 5 µm of noise a robust fit settles on single facets of the meshes.
EXACT = Errors(0.005, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Scans:
    """What one program of scans brought home."""

    T_cell_flange: Array  # (V, 4, 4) reported, the rail's travel in it; of a sweep in its middle
    rail: Array  # (V,) the carriage's stop
    clouds: list[Cloud]
    velocity: Array | None = None  # (V, 3) mm/s of the flange while it sweeps, cell frame


@dataclass
class WindowLine:
    """The true cell. `sphere_errors` holds while the sphere is scanned, `errors` for scans, `move_errors` for parts."""

    seed: int
    errors: Errors = Errors()
    sphere_errors: Errors = Errors()
    move_errors: Errors = Errors()
    sizes: dict[str, float] = field(default_factory=dict)  # of the door, by the names of CarDoor
    rays: int = 130  # rows and columns that the scanner reports
    grids: tuple[tuple[int, int], tuple[int, int]] = ((4, 2), (4, 3))  # overview of window and body, along x and z
    edges: int = 10  # scans along each edge
    sweeps: bool = False  # a line scanner that the robot sweeps without turning, instead of an area scanner that stands
    weld: Weld | None = None  # a bulge that welding left in the body; its CAD has none
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = rng = np.random.default_rng(self.seed)
        self.door, self.pane = CarDoor(**self.sizes), Pane(**self.sizes)
        self.body_cad, self.window_mesh = car_door.build(self.door), car_door.build_pane(self.pane)
        self.body_mesh = self.body_cad if self.weld is None else warp(self.body_cad, self.weld)
        self.T_flange_scanner_nominal = frames.make(np.eye(3), [0.0, 130.0, 90.0])
        self.T_flange_scanner = self.T_flange_scanner_nominal @ frames.exp(_scatter(rng, 0.005, 2.0))
        self.T_flange_tool = frames.make(np.eye(3), [0.0, -150.0, 220.0])
        self.T_cell_window_nominal = frames.make(np.eye(3), [300.0, 0.0, 300.0])
        self.T_cell_body_nominal = frames.make(np.eye(3), [2300.0, 0.0, 500.0])
        self.T_cell_window = self.T_cell_window_nominal @ frames.exp(_scatter(rng, 0.004, 4.0))
        self.T_cell_body = self.T_cell_body_nominal @ frames.exp(_scatter(rng, 0.004, 8.0))
        # The gripper's pose on the window, as programmed: facing its outer side, in its middle.
        middle = self.window_mesh.bounds.mean(axis=0) + np.array([0.0, 60.0, 0.0])
        self.T_window_tool = looking_at(middle, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]), 0.0)

    def grip_path(self) -> Array:
        """(2, 4, 4) T_cell_tool as programmed for the nominal rack: before the window, and on it."""
        return self._path(self.T_cell_window_nominal)

    def place_path(self) -> Array:
        """(2, 4, 4) T_cell_tool as programmed for the nominal body."""
        return self._path(self.T_cell_body_nominal)

    def _path(self, T_cell_part: Array) -> Array:
        on = T_cell_part @ self.T_window_tool
        return np.array([on @ frames.make(np.eye(3), [0.0, 0.0, -200.0]), on])

    def scan_sphere(self) -> Scans:
        """One stop of the carriage, the wrist turned all ways."""
        poses = 48 if self.sweeps else 16  # a line shows a third of what an area does
        tilts = self.rng.uniform(-1, 1, (poses, 3)) * np.radians([40.0, 40.0, 100.0])
        aims = np.column_stack([self.rng.uniform(-25, 25, (poses, 2)), self.rng.uniform(-520, -430, poses)])
        if self.sweeps:  # one line each, beside the sphere's middle
            aims[:, 1] = self.rng.uniform(0.2, 0.6, poses) * RADIUS
        ahead = looking_at(np.zeros(3), np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]), 0.0)
        R = ahead[:3, :3] @ Rotation.from_euler("xyz", tilts).as_matrix()
        T_sphere_scanner = frames.make(R, np.einsum("vij,vj->vi", R, aims))
        mesh, T = spheres.build(spheres.Sphere(radius=RADIUS)), frames.make(np.eye(3), _SPHERE)
        return self._scan(mesh, T, T, T_sphere_scanner, self.sphere_errors, lines=1)

    def scan_window(self) -> Scans:
        """The window in its rack: an overview, then its edges."""
        views = [
            over(self.window_mesh.bounds, self.grids[0], 600.0, self.rng),
            along_edges(self.pane, "pane", self.edges, 400.0),
        ]
        where = self.T_cell_window_nominal, self.T_cell_window
        return self._with_stations(self.window_mesh, *where, np.concatenate(views))

    def scan_body(self) -> Scans:
        """The body in pieces along the rail: an overview, then the edges of outline and window."""
        overview = over(self.body_mesh.bounds, self.grids[1], 600.0, self.rng)
        views = [overview, along_edges(self.door, "door", self.edges, 400.0)]
        where = self.T_cell_body_nominal, self.T_cell_body
        return self._with_stations(self.body_mesh, *where, np.concatenate(views))

    def _with_stations(self, mesh: trimesh.Trimesh, T_nominal: Array, T_true: Array, views: Array) -> Scans:
        """The views (V, 4, 4); and two close ones at each station where the window is to be glued to a flange."""
        scans = self._scan(mesh, T_nominal, T_true, views, self.errors)
        if not self.door.rebate:
            return scans
        near = across_seam(*self.stations(), 35.0, 350.0)
        close = self._scan(mesh, T_nominal, T_true, near, self.errors, _NARROW)
        return Scans(
            np.concatenate([scans.T_cell_flange, close.T_cell_flange]),
            np.concatenate([scans.rail, close.rail]),
            scans.clouds + close.clouds,
        )

    def stations(self) -> tuple[Array, Array, Array]:
        """Eight places of the seam, across and outwards, (8, 3) each; the body's part frame."""
        return stations(self.pane)

    def place(self, T_cell_tool_grip: Array, T_cell_tool_place: Array) -> None:
        """Grip the window where it stands, take it to the body; the gripper does not slip."""
        to_flange = frames.inverse(self.T_flange_tool)
        grip, place = (
            self._drive(T[None] @ to_flange, self.move_errors)[0][0] @ self.T_flange_tool
            for T in (T_cell_tool_grip, T_cell_tool_place)
        )
        self.T_cell_window = place @ frames.inverse(grip) @ self.T_cell_window

    def scan_seam(self) -> Scans:
        """Body and window together, two views at each station."""
        window = self.window_mesh.copy().apply_transform(frames.inverse(self.T_cell_body) @ self.T_cell_window)
        both = trimesh.util.concatenate([self.body_mesh, window])
        views = across_seam(*self.stations(), 35.0, 350.0)
        return self._scan(both, self.T_cell_body_nominal, self.T_cell_body, views, self.errors, _NARROW)

    def _scan(
        self,
        mesh: trimesh.Trimesh,
        T_nominal: Array,
        T_true: Array,
        T_part_scanner: Array,
        errors: Errors,
        field_of_view: float = _WIDE,
        lines: int | None = None,
    ) -> Scans:
        """Go where the program says for a part at its nominal place (4, 4); see it where it truly is."""
        reported = T_nominal @ T_part_scanner @ frames.inverse(self.T_flange_scanner_nominal)
        true, rail = self._drive(reported, errors)
        scanner = area_scanner(self.rays, field_of_view, _STANDOFF, depth=640.0, noise=errors.noise)
        seen = frames.inverse(T_true) @ true @ self.T_flange_scanner
        if self.sweeps:
            return self._sweep(
                mesh, T_true, reported, true, rail, replace(scanner, kind="line", rows=lines or self.rays)
            )
        return Scans(reported, rail, [scan(mesh, T, scanner, NO_FIELD, self.rng) for T in seen])

    def _sweep(
        self, mesh: trimesh.Trimesh, T_true: Array, reported: Array, true: Array, rail: Array, scanner: Scanner
    ) -> Scans:
        """The robot moves along the y axis that the drawing gives the scanner; no line is put to another yet."""
        length = 2 * _STANDOFF * np.tan(np.radians(scanner.field_of_view / 2))
        scanner = replace(scanner, sweep=length, speed=length / _SWEEP_SECONDS)
        velocity = scanner.speed * (reported @ self.T_flange_scanner_nominal)[:, :3, 1]
        clouds = []
        for T, v in zip(true, velocity, strict=True):
            rows = np.tile(T, (scanner.rows, 1, 1))
            rows[:, :3, 3] += profile_times(scanner)[:, None] * v
            seen = frames.inverse(T_true) @ rows @ self.T_flange_scanner
            clouds.append(scan(mesh, seen, scanner, NO_FIELD, self.rng))
        return Scans(reported, rail, clouds, velocity)

    def _drive(self, T_cell_flange: Array, errors: Errors) -> tuple[Array, Array]:
        """Where the flange (V, 4, 4) truly goes, and the carriage's stops (V,)."""
        rail = np.clip(np.round(T_cell_flange[:, 0, 3] / STOP) * STOP, 0.0, RAIL)
        true = T_cell_flange @ frames.exp(_scatter(self.rng, errors.turn, errors.shift, len(rail)))
        for stop in np.unique(rail):
            true[rail == stop, :3, 3] += errors.rail * self.rng.standard_normal(3)
        return true, rail


def _scatter(rng: np.random.Generator, turn: float, shift: float, count: int | None = None) -> Array:
    """Twists (6,) or (count, 6)."""
    size = 6 if count is None else (count, 6)
    return np.asarray(rng.standard_normal(size) * np.repeat([turn, shift], 3))
