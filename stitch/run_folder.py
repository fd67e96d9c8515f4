"""The run folder on disk: written whole or not at all."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from plyfile import PlyData, PlyElement

from stitch.effects.terms import fitted_of
from stitch.errors import InputError
from stitch.frames import Array
from stitch.labelled.document import labelled_facts, residual_columns, target_rows, targets_of
from stitch.model import Model, write_model
from stitch.result import FusedCloud, Run
from stitch.session import View

FORMAT = "stitch-run/1"
_VERSIONS = ("stitch", "numpy", "scipy", "open3d-cpu", "open3d", "pykdtree", "rerun-sdk", "kiss-icp", "trimesh")


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A scratch folder that takes the place of `path` if the block succeeds, and goes if it fails.

    Raises:
        InputError: `path` holds something that is not a run.
    """
    if path.exists() and not _is_run(path):
        raise InputError(f"{path}: exists and is not a run folder; name another with -o")
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield scratch
        _replace(scratch, path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _is_run(path: Path) -> bool:
    return path.is_dir() and ((path / "model.toml").is_file() or not any(path.iterdir()))


def _replace(scratch: Path, path: Path) -> None:
    # A folder cannot replace a full one in one step: the old run steps aside until the new one stands.
    scratch.chmod(0o777 & ~_umask())
    old = path.with_name(f".{path.name}.old-{os.getpid()}")
    if path.exists():
        path.rename(old)
    scratch.rename(path)
    shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def take_over(scratch: Path, path: Path) -> None:
    """Move every file of `scratch` into the run folder; a diagnosis of the old model goes."""
    for stale in ("diagnosis.json", "diagnosis.rrd", "compare.json", "mesh.ply"):
        (path / stale).unlink(missing_ok=True)
    shutil.rmtree(path / "pictures", ignore_errors=True)
    for file in sorted(scratch.iterdir()):
        file.replace(path / file.name)
    scratch.rmdir()


def extend(group: str, *arguments: Any) -> None:
    """Call what other packages offer under an entry-point group."""
    for entry in entry_points(group=group):
        entry.load()(*arguments)


def write_run(run: Run, folder: Path) -> None:
    """Write model.toml, result.json, ledger.json, stitched.ply and residuals.parquet into `folder`."""
    write_model(model_of(run), folder / "model.toml")
    write_json(result_document(run), folder / "result.json")
    write_json(ledger(run), folder / "ledger.json")
    write_cloud(run.fused, folder / "stitched.ply")
    write_residuals(run, folder / "residuals.parquet")


def model_of(run: Run) -> Model:
    """The model that a run fitted."""
    return Model(
        run.session.length_unit, run.session.mount, run.T_mount, run.T_mount_coarse, run.mount_covariance,
        fitted_of(run.chain, run.terms, run.sigmas), run.effects_file, targets_of(run.labelled),
    )  # fmt: skip


def result_document(run: Run) -> dict[str, Any]:
    """result.json as a dictionary."""
    unit = run.session.length_unit
    return {
        "format": FORMAT,
        "session": str(run.session.path.resolve()),
        "name": run.session.name,
        "length_unit": unit,
        "mount": run.session.mount,
        "reference_frame": "flange" if run.session.mount == "eye_to_hand" else "base",
        "hand_eye": run.T_mount.tolist(),
        "hand_eye_coarse": run.T_mount_coarse.tolist(),
        "hand_eye_sigma": np.sqrt(np.diag(run.mount_covariance)).tolist(),
        "unobservable": list(run.unobservable),
        "stages": [
            {"name": s.name, "rms": s.rms, "correspondences": s.correspondences, "iterations": s.iterations,
             "seconds": round(s.seconds, 3)}
            for s in run.stages
        ],
        "residual_rms": run.residual_rms,
        "heldout_rms": run.heldout_rms,
        "noise_floor": run.noise_floor,
        "repeatability": {"rotation": run.repeatability.rotation, "translation": run.repeatability.translation},
        "effects": {
            name: {p: {"value": f.value, "sigma": f.sigma, "unit": f.unit} for p, f in fitted.items()}
            for name, fitted in fitted_of(run.chain, run.terms, run.sigmas).items()
        },
        "views": [
            {"view": view.name, "pose": pose.tolist(), "correction": correction.tolist(), "rms": float(rms),
             "points": points_of(view)}
            for view, pose, correction, rms in zip(
                run.session.views, run.poses, run.corrections, run.view_rms, strict=True)
        ],
        "targets": target_rows(run.labelled),
        **labelled_facts(run),
        "convergence": run.convergence,
        "verdict": run.verdict,
        "notes": list(run.notes),
        "versions": _versions(),
    }  # fmt: skip


def points_of(view: View) -> int:
    """Number of points that a view shows, of its cloud and by name."""
    labelled = 0 if view.sighting is None else len(view.sighting.targets)
    return labelled + (0 if view.cloud is None else len(view.cloud.points))


def ledger(run: Run) -> list[dict[str, Any]]:
    """The model's history, one step per change."""
    return [
        {"step": i, "effects": list(s.effects), "residual_rms": s.residual_rms, "heldout_rms": s.heldout_rms,
         "noise_floor": s.noise_floor, "hand_eye": s.T_mount.tolist()}
        for i, s in enumerate(run.ledger)
    ]  # fmt: skip


def _versions() -> dict[str, str]:
    found = {}
    for name in _VERSIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def write_json(document: Any, path: Path) -> None:
    """Write JSON whole or not at all; what is not known is null."""
    scratch = path.with_name(f".{path.name}.new")
    scratch.write_text(to_json(document) + "\n", encoding="utf-8")
    scratch.replace(path)


def to_json(document: Any) -> str:
    """JSON text; JSON has no NaN and no infinity: what is not known is null."""
    return json.dumps(_without_nan(document), indent=1, allow_nan=False)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def write_cloud(cloud: FusedCloud, path: Path) -> None:
    """Binary PLY with normals, `residual` and `count`."""
    names = ("x", "y", "z", "nx", "ny", "nz", "residual")
    columns = np.column_stack([cloud.points, cloud.normals, cloud.residual])
    vertex = np.empty(len(cloud.points), [(name, "<f4") for name in names] + [("count", "<u2")])
    for name, column in zip(names, columns.T, strict=True):
        vertex[name] = column
    vertex["count"] = cloud.count
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))


def write_residuals(run: Run, path: Path) -> None:
    """One row per residual of the model, before the register stage moves single views."""
    names = np.array([view.name for view in run.session.views])
    covariates = sorted({key for view in run.session.views for key in view.covariates})
    table: dict[str, list[Any]] = {}

    def add(key: str, values: Array | Sequence[str]) -> None:
        table.setdefault(key, []).append(values)

    for m in () if run.overlaps is None else run.overlaps.matches:
        size = len(m.residual)
        add("view", np.repeat(names[m.v], size))
        add("partner", np.repeat(names[m.w], size))
        for axis, column in zip("xyz", m.middle.T, strict=True):
            add(axis, column)
        for axis, column in zip("xyz", m.normal.T, strict=True):
            add(f"n{axis}", column)
        add("residual", m.residual)
        for key in covariates:
            add(key, np.full(size, run.session.views[m.v].covariates.get(key, np.nan)))
        if run.session.views[m.v].time_s is not None:
            add("time_s", np.full(size, run.session.views[m.v].time_s))
    if run.labelled is not None:
        for key, values in residual_columns(run.labelled, run.session).items():
            if run.overlaps is None or key in table:
                add(key, values)
    columns = {key: np.concatenate(parts) for key, parts in table.items()}
    arrays = {
        key: pa.array(c).dictionary_encode() if c.dtype.kind == "U" else pa.array(c) for key, c in columns.items()
    }
    pq.write_table(pa.table(arrays), path, compression="zstd")
