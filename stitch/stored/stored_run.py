"""A run folder as the run that wrote it: its numbers as they stand there, its correspondences found again."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from plyfile import PlyData, PlyParseError

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.model.forward import corrected_capture
from stitch.model.model_toml import ModelFile, read_model
from stitch.observations.surfaces.match import sample_points
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, Overlaps, collect_overlaps
from stitch.observations.surfaces.pose_channel import Repeatability
from stitch.observations.targets.target_fit import TargetModelFit
from stitch.reading.clouds import require_room
from stitch.reading.text_file import shortened
from stitch.runs.run import FusedCloud, Run, StageResult
from stitch.runs.state import RunState
from stitch.stages.evaluate_targets import evaluate_targets
from stitch.stages.reuse import converged_overlaps
from stitch.stored.run_documents import read_result
from stitch.system.threads import library_threads_off


def stored_run(folder: Path, state: RunState) -> Run:
    """The run of a folder as far as its page shows it; nothing is fitted.

    Args:
        state: of the same folder, with all points.

    Raises:
        InputError: a file of the folder is damaged, or belongs to another model or session.
    """
    model = read_model(folder)
    try:
        document = read_result(folder)
        _require_one(folder, document, model, state)
        return _restore_run(folder, document, state)
    except (LookupError, TypeError, ValueError, OSError, PlyParseError) as error:
        reason = shortened(" ".join(str(error).split()))
        raise InputError(f"{folder}: its files are damaged ({reason}); run `stitch run` again") from None


def _require_one(folder: Path, document: dict[str, Any], model: ModelFile, state: RunState) -> None:
    """Refuse a model or a session that is not that of the result any more."""
    stated = {name: {p: f["value"] for p, f in own.items()} for name, own in document["effects"].items()}
    values = {name: {p: f.value for p, f in own.items()} for name, own in model.effects.items()}
    if stated != values or not np.array_equal(document["hand_eye"], model.T_mount):
        raise InputError(
            f"{folder}/model.toml: changed after the run; see what it does with `stitch run {state.session.path} "
            f"--hand-eye {folder} -o ANOTHER`"
        )
    gone = {item.view for item in state.left_out}
    if [v["view"] for v in document["views"] if v["view"] not in gone] != state.session.names:
        raise InputError(f"{state.session.path}/views.csv: changed after {folder} was made; run `stitch run` again")


def _restore_run(folder: Path, document: dict[str, Any], state: RunState) -> Run:
    session, model = state.session, state.model
    gone = {item.view for item in state.left_out}
    views = [view for view in document["views"] if view["view"] not in gone]
    with library_threads_off():
        own = corrected_capture(state.measurement, model)
        overlaps = converged_overlaps(own, model.T_mount, state.gate) if own.scans else None
        poses = np.array([view["pose"] for view in views], float)
        registered = _registered_overlaps(own, poses, document, state.gate) if own.scans else None
        targets = _target_fit(folder, state) if document.get("targets") and own.sightings is not None else None
    scatter = document["repeatability"]
    return Run(
        session=session,
        measurement=state.measurement,
        model=model,
        T_mount_coarse=state.T_mount_coarse,
        unobservable=tuple(document["unobservable"]),
        stages=tuple(_stage_result(row) for row in document["stages"]),
        poses_model=own.poses(model.T_mount),
        poses=poses,
        corrections=np.array([view["correction"] for view in views], float),
        view_rms=np.array([_number(view["rms"]) for view in views]),
        residual_rms=_number(document["residual_rms"]),
        heldout_rms=_number(document["heldout_rms"]),
        noise_floor=_number(document["noise_floor"]),
        fused=fused_cloud(folder / "stitched.ply"),
        repeatability=Repeatability(_number(scatter["rotation"]), _number(scatter["translation"]), float("nan")),
        overlaps=overlaps,
        registered=registered,
        verdict=document["verdict"],
        ledger=state.ledger,
        effects_file=state.effects_file,
        convergence={stage: [_number(x) for x in course] for stage, course in document["convergence"].items()},
        notes=tuple(document["notes"]),
        doubts=state.doubts,
        targets=targets,
        left_out=state.left_out,
        links=state.links,
    )


def _registered_overlaps(own: Capture, poses: Array, document: dict[str, Any], gate: float) -> Overlaps:
    """Correspondences after register, as the run found them last."""
    stated = (document.get("disagreement") or {}).get("gate")
    return collect_overlaps(own, poses, stated or gate, [sample_points(scan, FINE_SAMPLES) for scan in own.scans])


def _stage_result(row: dict[str, Any]) -> StageResult:
    rms, words = _number(row["rms"]), (row.get("note", ""), row.get("method", ""))
    return StageResult(row["name"], rms, row["correspondences"], row["iterations"], row["seconds"], *words)


def _target_fit(folder: Path, state: RunState) -> TargetModelFit:
    """What the labelled points say under the model; the distances of views left out are those of the fit."""
    found = evaluate_targets(state.measurement, state.model)
    used = found.rows.sightings.used
    heldout = np.full(used.shape, np.nan)
    # Beside clouds views are left out with their surfaces, not by their labelled points.
    if not state.measurement.capture.scans:
        heldout[used] = pq.read_table(folder / "residuals.parquet")["heldout"].to_numpy()
    return replace(found, heldout=heldout)


def fused_cloud(path: Path) -> FusedCloud:
    """stitched.ply read again; reference frame, length_unit."""
    require_room(path)
    vertex = PlyData.read(str(path))["vertex"]
    columns: Array = np.column_stack([vertex[name] for name in ("x", "y", "z", "nx", "ny", "nz", "residual")])
    columns = columns.astype(np.float64)
    return FusedCloud(columns[:, :3], columns[:, 3:6], columns[:, 6], np.asarray(vertex["count"]))


def _number(value: float | None) -> float:
    """JSON has no NaN."""
    return float("nan") if value is None else float(value)
