"""What a cell measured as a session folder, so that `stitch run`, `compare`, `diagnose` and `add` can be asked."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from plyfile import PlyData, PlyElement

from stitch import frames
from stitch.cells.pose_table import write_columns
from stitch.errors import InputError
from stitch.frames import Array


@dataclass(frozen=True)
class LabelledPoint:
    """One place of a named target in the sensor's frame."""

    view: str
    target: str
    position: Array  # (3,)
    sigma: float | None  # of each coordinate; None: not known


@dataclass(frozen=True)
class HandOver:
    """One session: V views with reported flange poses, and what the sensor saw in them. Lengths in length_unit."""

    name: str
    length_unit: str
    mount: str
    views: tuple[str, ...]
    T_base_flange: Array  # (V, 4, 4)
    T_mount: Array | None = None  # (4, 4) hand-eye as the cell found it
    covariates: dict[str, Array] = field(default_factory=dict)  # (V,) each
    points: tuple[LabelledPoint, ...] = ()
    targets: dict[str, Array] = field(default_factory=dict)  # nominal places (3,), part frame
    clouds: tuple[Array, ...] = ()  # (N, 3) each, scanner frame; one a view, or none
    cad: Path | None = None


def write_sessions(folder: Path, sessions: Sequence[HandOver]) -> None:
    """One session into `folder`, several into folders of their names below it; all of them or nothing.

    Raises:
        InputError: the folder exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists already; name another folder for the session")
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = folder.with_name(f".{folder.name}.writing")
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        for session in sessions:
            _write(scratch if len(sessions) == 1 else scratch / session.name, session)
        if folder.exists():
            folder.rmdir()
        scratch.rename(folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write(folder: Path, s: HandOver) -> None:
    folder.mkdir(parents=True)
    document: dict[str, Any] = {
        "format": "stitch-session/1", "name": s.name, "length_unit": s.length_unit, "mount": s.mount,
    }  # fmt: skip
    if s.T_mount is not None:
        document["scanner"] = {"pose": np.asarray(s.T_mount).tolist()}
    if s.cad is not None:
        shutil.copyfile(s.cad, folder / s.cad.name)
        document["part"] = {"cad": s.cad.name, "cad_unit": s.length_unit}
    (folder / "session.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    _write_views(folder, s)
    if s.points:
        xyz = np.array([p.position for p in s.points])
        columns: dict[str, Any] = {"view": [p.view for p in s.points], "target": [p.target for p in s.points]}
        columns |= {axis: xyz[:, i] for i, axis in enumerate("xyz")}
        if all(p.sigma is not None for p in s.points):
            columns["sigma"] = np.array([p.sigma for p in s.points], float)
        write_columns(folder / "points.csv", columns)
    if s.targets:
        xyz = np.array(list(s.targets.values()))
        write_columns(folder / "targets.csv", {"target": list(s.targets), **dict(zip("xyz", xyz.T, strict=True))})


def _write_views(folder: Path, s: HandOver) -> None:
    columns: dict[str, Any] = {"view": list(s.views)}
    if s.clouds:
        (folder / "clouds").mkdir()
        columns["cloud"] = [f"clouds/{name}.ply" for name in s.views]
        for name, points in zip(columns["cloud"], s.clouds, strict=True):
            vertex = np.empty(len(points), [(axis, "<f8") for axis in "xyz"])
            vertex["x"], vertex["y"], vertex["z"] = points.T
            PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(folder / name))
    columns |= dict(zip("xyz", s.T_base_flange[:, :3, 3].T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), frames.to_quaternion(s.T_base_flange).T, strict=True))
    write_columns(folder / "views.csv", columns | s.covariates)
