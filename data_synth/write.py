"""Write what a cell measured as a session folder, and the truth where nobody in the cell looks."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from data_synth.arms import Arm
from data_synth.kinematics import GRAVITY
from data_synth.scanner import Cloud
from data_synth.shapes import write_mesh
from data_synth.simulate import Measured
from stitch import frames

Array = NDArray[np.float64]


def write_session(out: Path, measured: Measured, name: str) -> None:
    """session.toml, views.csv, clouds and, where the scene has them, points.csv, below the new folder `out`."""
    (out / "clouds").mkdir(parents=True)
    for i, cloud in enumerate(measured.clouds):
        write_ply(out / "clouds" / f"v{i:03d}.ply", cloud)
    (out / "views.csv").write_text(_views(measured))
    (out / "session.toml").write_text(tomli_w.dumps(_document(name, measured)))
    if measured.labelled:
        (out / "points.csv").write_text(_points(measured))


def write_truth(path: Path, measured: Measured, seed: int) -> None:
    """What was hidden, and every true number that a judge needs; the mesh beside it."""
    truth = {
        "scene": measured.scene.name,
        "seed": seed,
        "mount": measured.scene.mount,
        "length_unit": "mm",
        "hidden": measured.hidden,
        "repeatability": dict(zip(("rotation", "translation"), measured.scene.repeatability, strict=True)),
        "noise": measured.scene.scanner.noise,
        "hand_eye": measured.T_mount.tolist(),
        "hand_eye_coarse": measured.T_coarse.tolist(),
        "T_reference_part": measured.scene.T_reference_part.tolist(),
        "poses": measured.T_reference_scanner.tolist(),
        "targets": {name: p.tolist() for name, p in measured.targets.items()},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(truth, indent=1) + "\n")
    write_mesh(measured.mesh, path.with_suffix(".ply"))


def _document(name: str, measured: Measured) -> dict[str, object]:
    scene = measured.scene
    document: dict[str, object] = {
        "format": "stitch-session/1",
        "name": name,
        "length_unit": "mm",
        "mount": scene.mount,
        "scanner": {
            "pose": measured.T_coarse.tolist(),
            "noise": scene.scanner.noise,
            "standoff": scene.scanner.standoff,
            "optical_axis": "+z",
        },
    }
    if not scene.rail:
        document["robot"] = robot_table(scene.arm)
    if scene.part.shape == "sphere":
        document["sphere"] = {"radius": float(scene.part.parameters.get("radius", 30.0))}
    return document


def robot_table(arm: Arm) -> dict[str, Any]:
    """The [robot] table of an arm."""
    rows = [
        {
            "a": float(arm.a[i]),
            "alpha_deg": float(np.degrees(arm.alpha[i])),
            "d": float(arm.d[i]),
            "theta_deg": float(np.degrees(arm.theta[i])),
            "mass": float(arm.mass[i]),
            "com": arm.com[i].tolist(),
        }
        for i in range(arm.joints)
    ]
    robot: dict[str, Any] = {"name": arm.name, "dh": "standard", "gravity": GRAVITY.tolist(), "joints": rows}
    if arm.payload_mass:
        robot["payload"] = {"mass": float(arm.payload_mass), "com": [float(x) for x in arm.payload_com]}
    return robot


def _views(measured: Measured) -> str:
    """A rail is no joint of the arm: such a session states flange poses and leaves the joints out."""
    scene, plan = measured.scene, measured.plan
    joints = [] if scene.rail else [f"j{i + 1}" for i in range(scene.arm.joints)]
    header = ["view", "cloud", "time_s", *(f"{j}_deg" for j in joints), "x", "y", "z", "qx", "qy", "qz", "qw"]
    header += [f"{j}_approach" for j in joints]
    moving = bool(joints) and bool(np.abs(plan.velocity).max() > 0)
    header += [f"{j}_velocity_deg_s" for j in joints] if moving else []
    header += [*measured.covariates, *(["rail_mm"] if scene.rail else [])]
    lines = [",".join(header)]
    for v, T in enumerate(measured.T_base_flange):
        numbers = [measured.times[v], *(np.degrees(plan.joints[v]) if joints else ()), *T[:3, 3]]
        numbers += [*frames.to_quaternion(T), *(measured.approach[v] if joints else ())]
        numbers += [*np.degrees(plan.velocity[v])] if moving else []
        numbers += [
            *(values[v] for values in measured.covariates.values()),
            *([measured.rail[v]] if scene.rail else []),
        ]
        lines.append(f"v{v:03d},clouds/v{v:03d}.ply," + ",".join(f"{x:.12g}" for x in numbers))
    return "\n".join(lines) + "\n"


def _points(measured: Measured) -> str:
    lines = ["view,target,x,y,z,sigma"]
    for v in range(len(measured.times)):
        for name, places in measured.labelled.items():
            if np.isfinite(places[v]).all():
                x, y, z = places[v]
                lines.append(f"v{v:03d},{name},{x:.6f},{y:.6f},{z:.6f},{measured.scene.part.sigma:g}")
    return "\n".join(lines) + "\n"


def write_ply(path: Path, cloud: Cloud) -> None:
    """One scan with its intensity and, where it has them, times."""
    # Single precision holds 30 nm at half a metre; positions keep double, they are what everything rests on.
    kinds = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4")]
    if cloud.time is not None:
        kinds.append(("time", "<f4"))
    vertex = np.empty(len(cloud.points), kinds)
    for axis, column in zip("xyz", cloud.points.T, strict=True):
        vertex[axis] = column
    vertex["intensity"] = cloud.intensity
    if cloud.time is not None:
        vertex["time"] = cloud.time
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))
