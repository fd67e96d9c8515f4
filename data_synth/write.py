"""Write what a cell measured as a session folder, and the truth where nobody in the cell looks."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth import scanner
from data_synth.arms import Arm
from data_synth.kinematics import GRAVITY
from data_synth.shapes import write_mesh
from data_synth.simulate import Measured
from stitch.output import session_files
from stitch.output.session_files import SessionFiles, TableColumns, pose_columns
from stitch.session.session import Cloud

Array = NDArray[np.float64]


def write_session(out: Path, measured: Measured, name: str) -> None:
    """session.toml, views.csv, clouds and, where the scene has them, points.csv: the new folder `out`, whole or not.

    Raises:
        InputError: `out` exists and is not empty.
    """
    files = SessionFiles(
        name=name,
        length_unit="mm",
        mount=measured.scene.mount,
        views=_views(measured),
        tables=_tables(measured),
        clouds={f"clouds/v{i:03d}.ply": cloud_file(cloud) for i, cloud in enumerate(measured.clouds)},
        points=_points(measured) if measured.labelled else None,
    )
    session_files.write_session(out, files)


def cloud_file(cloud: scanner.Cloud) -> Cloud:
    """One scan as its file holds it: intensity and, where the scanner moved, times; nature's incidence stays hidden."""
    times = {} if cloud.time is None else {"time": cloud.time}
    return Cloud(cloud.points, scalars={"intensity": cloud.intensity, **times})


def write_truth(path: Path, measured: Measured, seed: int) -> None:
    """What was hidden, and every true number that a judge needs; the mesh beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    document = {"scene": measured.scene.name, "seed": seed, **truth_of(measured)}
    path.write_text(json.dumps(document, indent=1) + "\n")
    write_mesh(measured.mesh, path.with_suffix(".ply"))


def truth_of(measured: Measured) -> dict[str, Any]:
    """Plain data of what was true."""
    return {
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


def _tables(measured: Measured) -> dict[str, dict[str, Any]]:
    """What session.toml says beside its head."""
    scene = measured.scene
    tables: dict[str, dict[str, Any]] = {
        "scanner": {
            "pose": measured.T_coarse.tolist(),
            "noise": scene.scanner.noise,
            "standoff": scene.scanner.standoff,
            "optical_axis": "+z",
        }
    }
    if scene.scanner.exposure:
        tables["scanner"]["moving"] = True
    if not scene.rail:
        tables["robot"] = robot_table(scene.arm)
    if scene.part.shape == "sphere":
        tables["sphere"] = {"radius": float(scene.part.parameters.get("radius", 30.0))}
    return tables


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


def _views(measured: Measured) -> TableColumns:
    """Columns of views.csv. A rail is no joint of the arm: such a session states flange poses and no joints."""
    scene, plan = measured.scene, measured.plan
    joints = [] if scene.rail else [f"j{i + 1}" for i in range(scene.arm.joints)]
    names = [f"v{v:03d}" for v in range(len(measured.times))]
    columns: dict[str, Sequence[object] | Array] = {"view": names, "cloud": [f"clouds/{name}.ply" for name in names]}
    columns["time_s"] = np.asarray(measured.times, float)
    columns |= {f"{j}_deg": np.degrees(plan.joints[:, i]) for i, j in enumerate(joints)}
    columns |= pose_columns(measured.T_base_flange)
    columns |= {f"{j}_approach": measured.approach[:, i] for i, j in enumerate(joints)}
    if joints and np.abs(plan.velocity).max() > 0:
        columns |= {f"{j}_velocity_deg_s": np.degrees(plan.velocity[:, i]) for i, j in enumerate(joints)}
    columns |= measured.covariates
    return columns | ({"rail_mm": measured.rail} if scene.rail else {})


def _points(measured: Measured) -> TableColumns:
    """Columns of points.csv: every target in every view that saw it."""
    seen = [
        (f"v{v:03d}", name, *(f"{x:.6f}" for x in places[v]), f"{measured.scene.part.sigma:g}")
        for v in range(len(measured.times))
        for name, places in measured.labelled.items()
        if np.isfinite(places[v]).all()
    ]
    return {name: [row[i] for row in seen] for i, name in enumerate(("view", "target", "x", "y", "z", "sigma"))}
