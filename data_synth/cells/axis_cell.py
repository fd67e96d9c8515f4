"""Cells with external axes, by kinematics of their own: a turntable, a table or a rail beside an arm, tilt and turn.

The blade is scanned; the arm is what its controller reports of the flange, with scatter. What a machine of this kind
does wrong is hidden by name: the table's centre and axis run along a line once a turn, the rail's way is longer than it
says and bends to an arc, readings stay behind by half a play.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.scanner import Cloud, Scanner, field_map
from data_synth.scanning import scan
from data_synth.shapes import build_shape

Array = NDArray[np.float64]
KINDS = ("turntable", "table-arm", "rail-arm", "tilt-turn", "arm")
# What is hidden at amplitude 1: mm, rad, share, rad/m, and half a play in rad or mm.
SIZES = {
    "axis_eccentricity": 0.1,
    "axis_wobble": 4e-4,
    "axis_scale": 4e-4,
    "axis_pitch": 4e-4,
    "axis_backlash": 3e-4,
}
_RAIL_BACKLASH = 0.08
_BALL = 30.0  # radius of a ball that is scanned in place of the blade
_ARM_SCATTER = np.repeat([20e-6, 0.02], 3)
_AXIS_SCATTER = {"rotary": 10e-6, "linear": 0.005}
_SCANNER = Scanner(columns=130, rows=130, noise=0.02, standoff=420.0, depth_of_field=500.0)


@dataclass(frozen=True)
class TrueAxis:
    """An axis as it is; mm, frame of the world."""

    name: str
    kind: str  # rotary | linear
    carries: str  # part | robot
    direction: Array  # (3,) unit vector
    point: Array  # (3,)
    faults: dict[str, Array] = field(default_factory=dict)

    def motion(self, reading: float, approach: float) -> Array:
        """(4, 4) what it does to what it carries."""
        across = np.linalg.svd(self.direction[None])[2][1:]
        q = reading - self.faults.get("axis_backlash", np.zeros(1))[0] * approach
        if self.kind == "rotary":
            swing = np.sin(q + self.faults.get("phase", np.zeros(1))[0])
            tilt = swing * self.faults.get("axis_wobble", np.zeros(2)) @ across
            shift = swing * self.faults.get("axis_eccentricity", np.zeros(2)) @ across
            R = Rotation.from_rotvec(tilt).as_matrix() @ Rotation.from_rotvec(q * self.direction).as_matrix()
            return pose_of(R, self.point + shift - R @ self.point)
        q = q * (1 + self.faults.get("axis_scale", np.zeros(1))[0])
        bend = self.faults.get("axis_pitch", np.zeros(3)) / 1e3
        # Along an arc of small steps: each goes where the carriage then looks.
        T = np.eye(4)
        for _ in range(200):
            T = T @ pose_of(Rotation.from_rotvec(bend * q / 200).as_matrix(), self.direction * q / 200)
        return T


@dataclass(frozen=True)
class AxisCell:
    """What such a cell wrote down, and what is true of it. V views; mm, rad."""

    kind: str
    axes: tuple[TrueAxis, ...]
    readings: Array  # (V, K) reported
    T_base_flange: Array | None  # (V, 4, 4) reported; None without an arm
    clouds: list[Cloud]
    T_mount: Array  # (4, 4) T_flange_scanner, or T_world_scanner without an arm
    poses: Array  # (V, 4, 4) T_part_scanner, true
    scanner: Scanner
    hidden: dict[str, float]

    def in_scanner(self, axis: TrueAxis) -> tuple[Array, Array]:
        """Direction and point of an axis in the frame of a scanner that stands still."""
        T = np.linalg.inv(self.T_mount)
        return T[:3, :3] @ axis.direction, T[:3, :3] @ axis.point + T[:3, 3]

    def stated(self, axis: TrueAxis) -> tuple[Array, Array]:
        """The same in the frame in which session.toml states it: the base, or the scanner without an arm."""
        return (axis.direction, axis.point) if self.T_base_flange is not None else self.in_scanner(axis)


def axis_cell(
    kind: str,
    seed: int,
    hidden: dict[str, float] | None = None,
    views: int = 18,
    *,
    pixels: int = 130,
    ball: bool = False,
) -> AxisCell:
    """Simulate a cell; `hidden` are faults by their names, times what a cell could really have.

    Args:
        ball: a ball, 60 mm beside, in place of the blade.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    chance = np.random.default_rng([seed, KINDS.index(kind), 1])
    scanner = replace(_SCANNER, columns=pixels, rows=pixels)
    mesh = trimesh.creation.icosphere(5, _BALL) if ball else build_shape("blade")
    has_arm = kind.endswith("arm")
    axes = tuple(_with_faults(axis, hidden or {}, chance) for axis in _axes(kind, rng))
    readings = _readings(kind, axes, views, rng)
    approach = np.sign(np.diff(readings, axis=0, prepend=readings[:1]))
    middle = np.asarray(mesh.bounds.mean(axis=0))
    turned = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
    place = np.array([950.0, 40.0, 400.0]) + rng.normal(0, 8.0, 3)
    T_world_part = pose_of(turned, place - turned @ middle + [0.0, 60.0 * ball, 0.0])
    weights = field_map(scanner, rng)
    T_mount = pose_of(
        Rotation.from_rotvec(rng.normal(0, 0.6, 3)).as_matrix(), np.array([40.0, -30.0, 110.0]) + rng.normal(0, 10, 3)
    )
    looks = [_view_of(place, kind, v, rng) for v in range(views)]
    if not has_arm:
        T_mount = looks[0]
    poses, flanges, clouds = [], [], []
    for v in range(views):
        sigma = [_AXIS_SCATTER[axis.kind] for axis in axes]
        true = readings[v] + rng.normal(0, sigma)
        carried, believed = {"part": np.eye(4), "robot": np.eye(4)}, np.eye(4)
        for axis, q, side, told in zip(axes, true, approach[v], readings[v], strict=True):
            carried[axis.carries] = carried[axis.carries] @ axis.motion(q, side)
            if axis.carries == "robot":
                believed = believed @ replace(axis, faults={}).motion(told, 0.0)
        if has_arm:
            # The arm is sent where it would look at the part if its rail were right.
            flange = np.linalg.inv(believed) @ looks[v] @ np.linalg.inv(T_mount)
            twist = rng.normal(0, _ARM_SCATTER)
            off = pose_of(Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:])
            T_world_scanner = carried["robot"] @ flange @ off @ T_mount
            flanges.append(flange)
        else:
            T_world_scanner = T_mount
        T_part_scanner = np.linalg.inv(carried["part"] @ T_world_part) @ T_world_scanner
        poses.append(T_part_scanner)
        clouds.append(scan(mesh, T_part_scanner, scanner, weights, rng))
    return AxisCell(
        kind,
        axes,
        readings,
        np.array(flanges) if has_arm else None,
        clouds,
        T_mount,
        poses=np.array(poses),
        scanner=scanner,
        hidden=dict(hidden or {}),
    )


def _axes(kind: str, rng: np.random.Generator) -> list[TrueAxis]:
    lean = rng.normal(0, 0.02, 3)
    table = TrueAxis(
        "table",
        "rotary",
        "part",
        _near(lean, 2),
        np.array([950.0, 40.0, 300.0]) + rng.normal(0, 10, 3),
    )
    if kind == "arm":
        return []
    if kind == "rail-arm":
        return [TrueAxis("E1", "linear", "robot", _near(lean, 1), np.zeros(3))]
    if kind == "tilt-turn":
        tilt = TrueAxis("tilt", "rotary", "part", _near(lean[::-1], 0), table.point + rng.normal(0, 30, 3))
        return [tilt, replace(table, name="turn")]
    return [table]


def _with_faults(axis: TrueAxis, hidden: dict[str, float], rng: np.random.Generator) -> TrueAxis:
    faults = dict(axis.faults)
    for name, amplitude in hidden.items():
        rotary = name in ("axis_eccentricity", "axis_wobble")
        if (rotary and axis.kind != "rotary") or (name in ("axis_scale", "axis_pitch") and axis.kind != "linear"):
            continue
        size = amplitude * (_RAIL_BACKLASH if name == "axis_backlash" and axis.kind == "linear" else SIZES[name])
        count = {"axis_eccentricity": 2, "axis_wobble": 2, "axis_pitch": 3}.get(name, 1)
        faults[name] = size * _unit(rng.standard_normal(count))
        faults["phase"] = rng.uniform(0, 2 * np.pi, 1)
    return replace(axis, faults=faults)


def _readings(kind: str, axes: tuple[TrueAxis, ...], views: int, rng: np.random.Generator) -> Array:
    """(V, K): a table turns on, there and back; what tilts, and a rail, go to and fro."""
    columns = []
    for axis in axes:
        if axis.kind == "linear":
            columns.append(rng.uniform(-450.0, 450.0, views))
        elif axis.name == "tilt":
            columns.append(rng.uniform(-0.6, 0.6, views))
        else:
            turn = np.arange(views) * 2 * np.pi / views + rng.uniform(-0.1, 0.1, views)
            # Some steps go back, as operators do: play shows.
            order = np.argsort(np.arange(views) + 1.6 * (rng.random(views) < 0.4))
            columns.append(turn[order] if kind != "table-arm" else rng.permutation(turn))
    return np.column_stack(columns) if columns else np.zeros((views, 0))


def _view_of(place: Array, kind: str, v: int, rng: np.random.Generator) -> Array:
    """(4, 4) T_world_scanner that looks at a place."""
    azimuth = np.pi + rng.uniform(-0.7, 0.7) + (v * 2.4 if kind in ("rail-arm", "arm") else 0.0)
    height = rng.uniform(0.1, 0.9)
    away = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    z = -away
    x = _unit(np.cross([0, 0, 1.0], z))
    R = np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_rotvec([0, 0, rng.uniform(-0.8, 0.8)]).as_matrix()
    aim = place + rng.normal(0, 15.0, 3)
    return pose_of(R, aim + away * 420.0 * rng.uniform(0.93, 1.07))


def _near(lean: Array, axis: int) -> Array:
    """(3,) unit vector that leans a little from an axis of the world."""
    return _unit(lean + np.eye(3)[axis])


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def pose_of(R: Array, t: Array) -> Array:
    """Return (4, 4) of a rotation (3, 3) and a shift (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def write_cell(folder: Path, cell: AxisCell, tables: list[dict[str, object]], hand_eye: Array | None = None) -> None:
    """Write the session folder; `tables` are the [[axis]] entries beside name, kind and what is carried."""
    from data_synth.write import cloud_file
    from stitch.output import session_files
    from stitch.output.session_files import SessionFiles, pose_columns

    names = [f"v{v:03d}" for v in range(len(cell.clouds))]
    columns: dict[str, object] = {"view": names, "cloud": [f"clouds/{name}.ply" for name in names]}
    columns["time_s"] = 30.0 * np.arange(len(names))
    if cell.T_base_flange is not None:
        columns |= pose_columns(cell.T_base_flange)
    for k, axis in enumerate(cell.axes):
        rotary = axis.kind == "rotary"
        columns[f"{axis.name}_{'deg' if rotary else 'mm'}"] = (
            np.degrees(cell.readings[:, k]) if rotary else cell.readings[:, k]
        )
    scanner = {"noise": cell.scanner.noise, "standoff": cell.scanner.standoff}
    stated = [
        {"name": axis.name, "kind": axis.kind, "carries": axis.carries, **table}
        for axis, table in zip(cell.axes, tables, strict=True)
    ]
    files = SessionFiles(
        name=cell.kind,
        length_unit="mm",
        mount="eye_to_hand" if cell.T_base_flange is None else "eye_in_hand",
        views=columns,
        tables={"scanner": scanner | ({} if hand_eye is None else {"pose": hand_eye.tolist()}), "axis": stated},
        clouds={f"clouds/{name}.ply": cloud_file(cloud) for name, cloud in zip(names, cell.clouds, strict=True)},
    )
    session_files.write_session(folder, files)
