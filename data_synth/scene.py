"""A scene file: which part, arm and scanner, where they stand, how the views are planned, what is always there."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.arms import ARMS, Arm, with_payload
from data_synth.scanner import Scanner
from data_synth.scene_tables import read_dataclass, take_vector
from stitch.errors import InputError
from stitch.numerics import frames

Array = NDArray[np.float64]
SCENES = Path(__file__).parent / "scenes"
_KINDS = {"scanner": ("area", "line"), "plan": ("turntable", "orbit", "raster", "sweep", "path")}


@dataclass(frozen=True)
class PartPlace:
    """What is scanned and where it sits: T_reference_part, on the flange (eye_to_hand) or in the base frame."""

    shape: str = "blade"
    parameters: dict[str, Any] = field(default_factory=dict)
    mesh: str | None = None  # a mesh file instead of a shape, path relative to the scene file
    mesh_scale: float = 1.0  # to millimetres
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    labelled: bool = False  # also write points.csv of sphere centres or holes
    sigma: float = 0.02  # of those points


@dataclass(frozen=True)
class ViewPlan:
    """How the scanner looks at the part. Angles in degrees, lengths in mm."""

    kind: str = "turntable"  # turntable | orbit | raster | sweep | path
    views: int = 18
    turn: float = 20.0  # turntable: about the part's z from view to view
    tilt: float = 25.0  # largest tilt of the part or of the view direction
    roll: float = 15.0  # largest turn about the view direction
    aim: float = 15.0  # largest offset of the point looked at
    distance: float = 0.1  # largest relative change of the standoff
    towards: tuple[float, float, float] = (0.0, 0.0, 1.0)  # all but turntable: from the part to the scanner
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)  # all but turntable: image rows run against it
    step: tuple[float, float] = (180.0, 180.0)  # raster: between stations
    columns: int = 4  # raster: stations in a row
    rate: float = 5.0  # path: views per second, while the scanner moves on
    minimum_seen: float = 0.02  # share of the rays that must hit


@dataclass(frozen=True)
class Climate:
    """Changes over the session in °C and %, slow and never quite in step with each other."""

    minutes: float = 40.0  # of the session
    scanner: float = 4.0
    part: float = -12.0
    robot: float = 5.0
    humidity: float = 12.0


@dataclass(frozen=True)
class Scene:
    """Everything but the seed and what is hidden."""

    name: str
    mount: str
    arm: Arm
    scanner: Scanner
    part: PartPlace
    plan: ViewPlan
    climate: Climate
    T_mount: Array  # (4, 4) nominal hand-eye: T_base_scanner or T_flange_scanner
    coarse_error: tuple[float, float] = (0.3, 2.0)  # of the hand-eye that the session states: degrees, mm
    mount_spread: tuple[float, float] = (0.003, 1.0)  # of the true hand-eye about the nominal one: rad, mm
    repeatability: tuple[float, float] = (20e-6, 0.02)  # of the flange: rad, mm
    joint_repeatability: float = 0.0  # of every joint beside it: rad
    small: float = 1.0  # factor on the effects that are always there
    useful: tuple[int, ...] = (1, 2, 3, 4)  # joints, from 0, whose errors the cell can show
    rail: float = 0.0  # length of a rail along x that carries the base
    folder: Path = SCENES

    @property
    def T_reference_part(self) -> Array:
        """(4, 4) as planned."""
        R = Rotation.from_euler("xyz", self.part.rpy_deg, degrees=True).as_matrix()
        return frames.make(R, np.array(self.part.xyz, float))


def load_scene(name: str | Path) -> Scene:
    """A scene of the project by its name, or a TOML file.

    Raises:
        InputError: no such scene, unknown key or value.
    """
    path = Path(name) if str(name).endswith(".toml") else SCENES / f"{name}.toml"
    if not path.is_file():
        raise InputError(
            f"{name}: no such scene; to fix: name one of {', '.join(names())}, a TOML file, or a cell of docs/synth.md"
        )
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    try:
        return _scene(path, document)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None


def names() -> list[str]:
    """Scenes of the project."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def _scene(path: Path, document: dict[str, Any]) -> Scene:
    for key in ("mount", "robot", "scanner"):
        if key not in document:
            raise ValueError(f"{key} is missing")
    robot, scanner = dict(document.pop("robot")), dict(document.pop("scanner"))
    payload = robot.pop("payload", {"mass": 0.0, "com": [0.0, 0.0, 0.0]})
    if robot.get("arm") not in ARMS:
        raise ValueError(f"robot.arm is {robot.get('arm')!r}; there are {', '.join(ARMS)}")
    if not isinstance(payload, dict) or set(payload) != {"mass", "com"}:
        raise ValueError("robot.payload is { mass = kg, com = [x, y, z] }")
    arm = with_payload(ARMS[robot.pop("arm")], payload["mass"], tuple(payload["com"]))
    T_mount = _mount(*(take_vector(scanner, key) for key in ("xyz", "looks", "x_axis")))
    table = {
        "part": read_dataclass(PartPlace, "part", document.pop("part", {})),
        "plan": read_dataclass(ViewPlan, "plan", document.pop("plan", {})),
        "climate": read_dataclass(Climate, "climate", document.pop("climate", {})),
        "scanner": read_dataclass(Scanner, "scanner", scanner),
    }
    for key in ("useful", "rail"):
        if key in robot:
            document[key] = tuple(j - 1 for j in robot.pop(key)) if key == "useful" else float(robot.pop(key))
    if robot:
        raise ValueError(f"unknown key robot.{next(iter(robot))}")
    built = {"arm": arm, "T_mount": T_mount, "folder": path.parent}
    scene: Scene = read_dataclass(Scene, "", {"name": path.stem, **document, **table, **built})
    _check(scene)
    return scene


def _check(scene: Scene) -> None:
    if scene.mount not in ("eye_to_hand", "eye_in_hand"):
        raise ValueError(f"mount is {scene.mount!r}; use 'eye_to_hand' or 'eye_in_hand'")
    for where, kinds in _KINDS.items():
        if (kind := getattr(scene, where).kind) not in kinds:
            raise ValueError(f"{where}.kind is {kind!r}; use {', '.join(kinds)}")
    if scene.plan.views < 2:
        raise ValueError(f"plan.views is {scene.plan.views}; stitching needs at least 2")
    if not scene.useful or not set(scene.useful) <= set(range(scene.arm.joints)):
        raise ValueError(f"robot.useful names joints from 1 to {scene.arm.joints}")


def _mount(xyz: list[float], looks: list[float], x_axis: list[float]) -> Array:
    """A scanner at xyz that looks along `looks`; its x axis is as near `x_axis` as that allows."""
    z = np.array(looks, float) / np.linalg.norm(looks)
    x = np.array(x_axis, float) - z * (z @ x_axis)
    x /= np.linalg.norm(x)
    return frames.make(np.column_stack([x, np.cross(z, x), z]), np.array(xyz, float))
