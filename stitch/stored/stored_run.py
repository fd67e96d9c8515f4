"""A run folder as the run that wrote it: its numbers as they stand there, its correspondences found again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from plyfile import PlyData, PlyParseError

from stitch.errors import InputError
from stitch.frames import Array
from stitch.model.forward import corrected
from stitch.model.model_toml import Model, read_model
from stitch.model.terms import sigmas_of
from stitch.observations.surfaces.pose_channel import Repeatability
from stitch.runs.run import FusedCloud, Run, StageResult
from stitch.stages.reuse import converged_overlaps
from stitch.stages.reuse_targets import evaluate
from stitch.stages.target_fit import LabelledFit
from stitch.stored.load_state import State
from stitch.system.threads import library_threads_off


def stored_run(folder: Path, state: State) -> Run:
    """The run of a folder as far as its page shows it; nothing is fitted.

    Args:
        state: of the same folder, with all points.

    Raises:
        InputError: a file of the folder is damaged, or belongs to another model or session.
    """
    model = read_model(folder)
    try:
        document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        _require_one(folder, document, model, state)
        return _restored(folder, document, model, state)
    except (KeyError, TypeError, ValueError, PlyParseError) as error:
        raise InputError(f"{folder}: its files are damaged ({error}); run `stitch run` again") from None


def _require_one(folder: Path, document: dict[str, Any], model: Model, state: State) -> None:
    """Refuse a model or a session that is not that of the result any more."""
    told = {name: {p: f["value"] for p, f in own.items()} for name, own in document["effects"].items()}
    values = {name: {p: f.value for p, f in own.items()} for name, own in model.effects.items()}
    if told != values or not np.array_equal(document["hand_eye"], model.T_mount):
        raise InputError(
            f"{folder}/model.toml: changed after the run; see what it does with `stitch run {state.session.path} "
            f"--hand-eye {folder} -o ANOTHER`"
        )
    if [view["view"] for view in document["views"]] != [view.name for view in state.session.views]:
        raise InputError(f"{state.session.path}/views.csv: changed after {folder} was made; run `stitch run` again")


def _restored(folder: Path, document: dict[str, Any], model: Model, state: State) -> Run:
    session, T_mount, views = state.session, state.T_mount, document["views"]
    with library_threads_off():
        own = corrected(state.measurement, state.terms, T_mount)
        overlaps = converged_overlaps(own, T_mount, state.gate) if own.scans else None
        labelled = None if own.sightings is None else _labelled(folder, model, state)
    scatter = document["repeatability"]
    return Run(
        session=session, measurement=state.measurement, T_mount=T_mount, T_mount_coarse=state.T_mount_coarse,
        mount_covariance=model.covariance, unobservable=tuple(document["unobservable"]),
        stages=tuple(
            StageResult(s["name"], _number(s["rms"]), s["correspondences"], s["iterations"], s["seconds"],
                        s.get("note", "")) for s in document["stages"]
        ),
        poses_model=own.poses(T_mount), poses=np.array([view["pose"] for view in views], float),
        corrections=np.array([view["correction"] for view in views], float),
        view_rms=np.array([_number(view["rms"]) for view in views]), residual_rms=_number(document["residual_rms"]),
        heldout_rms=_number(document["heldout_rms"]), noise_floor=_number(document["noise_floor"]),
        fused=_fused(folder / "stitched.ply"),
        repeatability=Repeatability(scatter["rotation"], scatter["translation"], float("nan")),
        overlaps=overlaps, verdict=document["verdict"], terms=state.terms, sigmas=sigmas_of(model, state.measurement),
        ledger=state.ledger, effects_file=state.effects_file,
        convergence={stage: [_number(x) for x in course] for stage, course in document["convergence"].items()},
        notes=tuple(document["notes"]), labelled=labelled,
    )  # fmt: skip


def _labelled(folder: Path, model: Model, state: State) -> LabelledFit:
    """What the labelled points say under the model; the distances of views left out are those of the fit."""
    found = evaluate(state.measurement, model, state.terms)
    sightings = found.rows.capture.sightings
    assert sightings is not None
    heldout = np.full(sightings.used.shape, np.nan)
    # Beside clouds views are left out with their surfaces, not by their labelled points.
    if not state.measurement.capture.scans:
        heldout[sightings.used] = pq.read_table(folder / "residuals.parquet")["heldout"].to_numpy()
    return replace(found, heldout=heldout)


def _fused(path: Path) -> FusedCloud:
    vertex = PlyData.read(str(path))["vertex"]
    columns: Array = np.column_stack([vertex[name] for name in ("x", "y", "z", "nx", "ny", "nz", "residual")])
    columns = columns.astype(np.float64)
    return FusedCloud(columns[:, :3], columns[:, 3:6], columns[:, 6], np.asarray(vertex["count"]))


def _number(value: float | None) -> float:
    """JSON has no NaN."""
    return float("nan") if value is None else float(value)
