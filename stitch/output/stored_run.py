"""Read a run folder again: its documents checked, its model, and the run that wrote it."""

import json
import shlex
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq
from plyfile import PlyData, PlyParseError

from stitch.effects.user_file import load
from stitch.errors import InputError
from stitch.fit.correct import converged_overlaps, gate_of_model
from stitch.fit.target_fit import evaluate_targets
from stitch.model.forward import corrected_capture
from stitch.model.model import EffectsCovariance
from stitch.model.model_toml import ModelFile, bind_to_session, read_model
from stitch.numerics.frames import Array
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import FINE_SAMPLES, Overlaps, collect_overlaps
from stitch.observations.targets.target_model import TargetModelFit
from stitch.output.result_document import restore_counted_targets
from stitch.run_data import (
    ExcludedView,
    Fit,
    FusedCloud,
    LedgerStep,
    Note,
    RunData,
    StageResult,
    Unsupported,
    ViewLinks,
)
from stitch.session.capture import Capture, prepare_capture
from stitch.session.measurement import measurement_of, with_part_origin
from stitch.session.reading.clouds import require_room
from stitch.session.reading.session_folder import UNKNOWN, content_hash, load_session, session_hash
from stitch.session.reading.text_files import read_text, shortened
from stitch.system.threads import library_threads_off

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Finding

_TEXT = {"type": "string"}
_NUMBER = {"type": "number"}
_NUMBER_OR_NULL = {"type": ["number", "null"]}  # JSON has no NaN
_COUNT = {"type": "integer", "minimum": 0}


def _list_schema(items: dict[str, Any], length: int | None = None) -> dict[str, Any]:
    exact = {} if length is None else {"minItems": length, "maxItems": length}
    return {"type": "array", "items": items} | exact


def _object_schema(required: dict[str, Any], **optional: Any) -> dict[str, Any]:
    return {"type": "object", "properties": required | optional, "required": list(required)}


_MATRIX = _list_schema(_list_schema(_NUMBER, 4), 4)
_STAGE = {"name": _TEXT, "rms": _NUMBER_OR_NULL, "correspondences": _COUNT, "iterations": _COUNT, "seconds": _NUMBER}
_VIEW = {"view": _TEXT, "pose": _MATRIX, "correction": _list_schema(_NUMBER, 6), "rms": _NUMBER_OR_NULL}
_PARAMETER = _object_schema({"value": _NUMBER})
RESULT = _object_schema(
    {
        "session": {"type": "string", "pattern": "^[^\\u0000]+$", "maxLength": 4000},
        "hand_eye": _MATRIX,
        "residual_rms": _NUMBER,
        "heldout_rms": _NUMBER_OR_NULL,
        "noise_floor": _NUMBER,
        "effects": {"type": "object", "additionalProperties": {"type": "object", "additionalProperties": _PARAMETER}},
        "stages": _list_schema(_object_schema(_STAGE, note=_TEXT, method=_TEXT)),
        "views": _list_schema(_object_schema(_VIEW)),
        "unobservable": _list_schema(_TEXT),
        "repeatability": _object_schema({"rotation": _NUMBER_OR_NULL, "translation": _NUMBER_OR_NULL}),
        "verdict": _TEXT,
        "notes": _list_schema(_TEXT),
        "convergence": {"type": "object", "additionalProperties": _list_schema(_NUMBER_OR_NULL)},
    },
    disagreement={"type": ["object", "null"], "properties": {"gate": _NUMBER}},
    outliers=_list_schema(_object_schema({"view": _TEXT, "target": {"type": ["string", "null"]}})),
    effects_covariance=_object_schema(
        {"parameters": _list_schema(_TEXT), "matrix": _list_schema(_list_schema(_NUMBER))}
    ),
    cloud_noise_factor=_NUMBER,
    unsupported_points={
        "type": "object",
        "properties": dict.fromkeys(("points", "alone", "looked_through"), _COUNT),
        "additionalProperties": False,
    },
    hand_eye_unknown=_list_schema(_TEXT),
    left_out=_list_schema(_object_schema({"view": _TEXT, "why": _TEXT})),
    linkage=_object_schema(
        {}, components=_list_schema(_list_schema(_TEXT)), weak=_list_schema(_object_schema({"view": _TEXT}))
    ),
)
_LEFT_OUT = {"type": ["object", "null"], "additionalProperties": _NUMBER}
_CANDIDATES = _list_schema(_object_schema({"effect": _TEXT}, hand_eye_if_missed=_NUMBER_OR_NULL, left_out=_LEFT_OUT))
_VERDICT = {"enum": ["adequate", "missing_effect", "cannot_tell", "unknown_effect"]}
_TRIED = _list_schema(_object_schema({"effect": _TEXT, "dropped": _TEXT}))
DIAGNOSIS = _object_schema({"verdict": _VERDICT}, candidates=_CANDIDATES, tried=_TRIED)
_STEP = {
    "effects": _list_schema(_TEXT),
    "residual_rms": _NUMBER,
    "heldout_rms": _NUMBER_OR_NULL,
    "noise_floor": _NUMBER,
}
_VALUES = {"type": "object", "additionalProperties": {"type": "object", "additionalProperties": _NUMBER}}
_NOTES = _list_schema(_object_schema({"at": _TEXT, "by": _TEXT, "text": _TEXT}))
LEDGER = _list_schema(_object_schema(_STEP | {"hand_eye": _MATRIX}, parameters=_VALUES, notes=_NOTES))


def read_documents(folder: Path) -> tuple[dict[str, Any], tuple[LedgerStep, ...]]:
    """result.json and the history of the model of a run of one session.

    Raises:
        InputError: no run folder, one of several sessions, or a damaged file.
    """
    return read_result(folder), ledger_steps(folder)


def read_result(folder: Path) -> dict[str, Any]:
    """result.json of a run folder.

    Raises:
        InputError: no run folder, one of several sessions, no JSON, or an entry of another kind than stitch writes.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such run folder; to fix: name one that `stitch run` wrote")
    if not (folder / "result.json").is_file() and (folder / "model.toml").is_file():
        inner = sorted(p.parent.name for p in folder.glob("*/result.json"))
        if inner:
            raise InputError(f"{folder}: holds the runs of several sessions ({', '.join(inner)}); name one of them")
    return dict(_read_checked(folder / "result.json", RESULT))


def read_diagnosis(folder: Path) -> dict[str, Any]:
    """Verdict and candidates of the diagnosis in a run folder; {} where there is none.

    Raises:
        InputError: a damaged diagnosis.json.
    """
    file = folder / "diagnosis.json"
    return dict(_read_checked(file, DIAGNOSIS)) if file.is_file() else {}


def covariance_of_effects(path: Path, result: dict[str, Any] | None = None) -> EffectsCovariance:
    """What the result beside a model.toml says of its effects' parameters; nothing where there is none.

    Args:
        path: folder of a run or of a rig, or a model.toml.
        result: its result.json, if it has been read.

    Raises:
        InputError: a result.json that is damaged, or a matrix of another size than its names.
    """
    folder = path if path.is_dir() else path.parent
    found = [folder / "result.json", *sorted(folder.glob("*/result.json"))]
    file = next((f for f in found if f.is_file()), None)
    stated = (result or read_result(file.parent)).get("effects_covariance") if file else None
    if not stated:
        return EffectsCovariance()
    names, rows = tuple(stated["parameters"]), stated["matrix"]
    if [len(row) for row in rows] != [len(names)] * len(names):
        raise InputError(
            f"{file}: effects_covariance.matrix is not {len(names)}x{len(names)} for its {len(names)} parameters; "
            "to fix: run `stitch run` again, or take the entry out"
        )
    matrix = np.array(rows, float).reshape(len(names), len(names))
    if not np.isfinite(matrix).all() or (np.diag(matrix) <= 0).any():
        raise InputError(f"{file}: effects_covariance holds no variances; to fix: run `stitch run` again")
    return EffectsCovariance(names, matrix)


def read_ledger(folder: Path) -> list[dict[str, Any]]:
    """ledger.json of a run folder, a step per change of the model.

    Raises:
        InputError: as `read_result`.
    """
    steps = _read_checked(folder / "ledger.json", LEDGER)
    assert isinstance(steps, list)
    return steps


def ledger_steps(folder: Path) -> tuple[LedgerStep, ...]:
    """History of the model of a run folder.

    Raises:
        InputError: as `read_result`.
    """
    return tuple(
        LedgerStep(
            effects=tuple(step["effects"]),
            residual_rms=step["residual_rms"],
            heldout_rms=float("nan") if step["heldout_rms"] is None else step["heldout_rms"],
            noise_floor=step["noise_floor"],
            T_mount=np.array(step["hand_eye"], float),
            values=step.get("parameters", {}),
            notes=tuple(Note(note["at"], note["by"], note["text"]) for note in step.get("notes", ())),
        )
        for step in read_ledger(folder)
    )


def _read_checked(file: Path, schema: dict[str, Any]) -> Any:
    # Loaded by who reads a run: most that only write one do not.
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import best_match
    from jsonschema.validators import extend

    def items(validator: Any, items: Any, values: Any, schema: Any) -> Iterator[Any]:
        # Nearly all of a result are numbers in lists: one by one they take as long as the session takes to be read.
        plain = items == _NUMBER and isinstance(values, list) and all(type(v) in (int, float) for v in values)
        if not plain:
            yield from Draft202012Validator.VALIDATORS["items"](validator, items, values, schema)

    hint = "name a run folder that `stitch run` wrote"
    if (file.parent / "session.toml").is_file():
        hint = f"this is a session; to fix: `stitch run {shlex.quote(str(file.parent))} -o RUN` first, then name RUN"
    told = read_text(file, hint)
    try:
        document = json.loads(told, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: damaged ({shortened(str(error))}); to fix: run `stitch run` again") from None
    wrong = best_match(extend(Draft202012Validator, {"items": items})(schema).iter_errors(document))
    if wrong is not None:
        place = ".".join(str(step) for step in wrong.absolute_path) or "the document"
        raise InputError(f"{file}: damaged ({place}: {shortened(wrong.message, 160)}); to fix: run `stitch run` again")
    return document


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is no number")


# The model of a run folder, and the Python file of effects that it names: run only where somebody allows it.


def trusted_model(
    path: Path, effects_file: Path | None = None, trust: bool = False, result: dict[str, Any] | None = None
) -> tuple[ModelFile, str | None]:
    """The model, and the absolute path of the file whose effects have joined the library, if any.

    Args:
        path: run folder, or model.toml.
        effects_file: the user's own file; takes the place of the one that the model names.
        trust: run the file that the model names.
        result: result.json beside it, if it has been read.

    Raises:
        InputError: no model, a value in it that is no number, or a file of effects that nobody has allowed.
    """
    model = replace(read_model(path), effects_covariance=covariance_of_effects(path, result))
    file = path / "model.toml" if path.is_dir() else path
    for effect, fitted in model.effects.items():
        for name, parameter in fitted.items():
            if not np.isfinite(parameter.value):
                raise InputError(f"{file}: effects.{effect}.{name} is {parameter.value}; to fix: write a finite number")
    if effects_file is not None:
        load(effects_file)
        return model, str(effects_file.resolve())
    if model.effects_file and not trust:
        raise InputError(
            f"{file}: names effects in {model.effects_file}, Python that runs with your rights; to fix: read it, "
            "then allow it with --trust, or name a file of your own with --effects-file"
        )
    if model.effects_file:
        load(Path(model.effects_file))
    return model, model.effects_file


# A run folder as the run that wrote it: its numbers as they stand there, its correspondences found again.


def load_run(folder: Path, effects_file: Path | None = None, trust: bool = False) -> RunData:
    """Read a run folder; its session is read again and nothing is fitted.

    Args:
        trust: run the Python file of effects that the model names.

    Raises:
        InputError: not a run of one session, its session has gone, an effect is not known, or the model names a file
            of effects that nobody has allowed.
    """
    document, steps = read_documents(folder)
    file, effects = trusted_model(folder, effects_file, trust, document)
    path = Path(document["session"])
    if not path.is_dir():
        raise InputError(f"{folder}/result.json: its session {path} has gone; to fix: restore it or correct the path")
    session = load_session(path)
    with library_threads_off():
        measurement = with_part_origin(measurement_of(session, prepare_capture(session)), file.T_mount_coarse)
        left_out, links = left_out_of(document)
        gone = [v for v, view in enumerate(session.views) if view.name in {item.view for item in left_out}]
        session, measurement = session.without([item.view for item in left_out]), measurement.without(gone)
        model = bind_to_session(file, measurement)
        measurement = restore_counted_targets(measurement, session, document)
        gate = gate_of_model(corrected_capture(measurement, model), model.T_mount)
    return RunData(
        session=session,
        measurement=measurement,
        model=model,
        T_mount_coarse=file.T_mount_coarse,
        gate=gate,
        residual_rms=document["residual_rms"],
        heldout_rms=_number(document["heldout_rms"]),
        noise_floor=document["noise_floor"],
        source=partial(_read_fit, folder),
        ledger=steps,
        effects_file=effects,
        left_out=left_out,
        links=links,
        doubts=tuple(document.get("doubts", ())),
        tried=_dropped_before(folder),
        register_method=next((stage["method"] for stage in document["stages"] if "method" in stage), ""),
    )


def diagnosed_state(run: RunData, folder: Path) -> str:
    """Return what a diagnosis is of: stitch's version, and hashes of the session, the result and the effects' file."""
    file = None if run.effects_file is None else Path(run.effects_file)
    own = content_hash(folder, [folder / "model.toml", folder / "result.json"])
    effects = "" if file is None else content_hash(file.parent, [file])
    return " ".join((version("stitch"), session_hash(run.session), own, effects)).strip()


def standing_diagnosis(folder: Path, run: RunData) -> dict[str, Any]:
    """Return the diagnosis in a run's folder; {} where there is none, or one of another state or version."""
    try:
        told = read_diagnosis(folder)
    except InputError:
        return {}  # damaged: it is soon written anew
    state = diagnosed_state(run, folder) if told else UNKNOWN
    return told if UNKNOWN not in state and told.get("of") == state else {}


def named_before(run: RunData, told: dict[str, Any]) -> "Finding | None":
    """Return the effects that a standing diagnosis of a run names to be added; None where it names none."""
    from stitch.diagnosis.diagnosis import Finding
    from stitch.diagnosis.validation import CrossValidation

    try:
        odds = told["log_odds_over_nothing"]
        if told["verdict"] != "missing_effect":
            return None
        if told["effects"][0] in run.tried or (odds is not None and odds <= 0):
            return None
        notes = (f"{note}." for note in told["notes"] if note not in told["sentence"])
        left_out = {row["effect"]: CrossValidation(**row["left_out"]) for row in told["candidates"] if row["left_out"]}
        return Finding((told["plain"], told["sentence"], *notes), tuple(told["together"]), left_out)
    except (LookupError, TypeError):
        return None  # of an earlier version


def _dropped_before(folder: Path) -> dict[str, str]:
    """Return the effects that were dropped in this run, and why; a damaged diagnosis, which is soon written anew, holds
    none."""
    try:
        return {row["effect"]: row["dropped"] for row in read_diagnosis(folder).get("tried", ())}
    except InputError:
        return {}


def _read_fit(folder: Path, run: RunData) -> Fit:
    """Read what the stages found; correspondences are found again, nothing is fitted.

    Raises:
        InputError: a file of the folder is damaged, or belongs to another model or session.
    """
    model = read_model(folder)
    try:
        document = read_result(folder)
        _require_one(folder, document, model, run)
        return _restore_fit(folder, document, run)
    except (LookupError, TypeError, ValueError, OSError, PlyParseError) as error:
        reason = shortened(" ".join(str(error).split()))
        raise InputError(f"{folder}: its files are damaged ({reason}); to fix: run `stitch run` again") from None


def _require_one(folder: Path, document: dict[str, Any], model: ModelFile, run: RunData) -> None:
    """Refuse a model or a session that is not that of the result any more."""
    stated = {name: {p: f["value"] for p, f in own.items()} for name, own in document["effects"].items()}
    values = {name: {p: f.value for p, f in own.items()} for name, own in model.effects.items()}
    if stated != values or not np.array_equal(document["hand_eye"], model.T_mount):
        raise InputError(
            f"{folder}/model.toml: changed after the run; see what it does with `stitch run {run.session.path} "
            f"--hand-eye {folder} -o ANOTHER`"
        )
    gone = {item.view for item in run.left_out}
    if [v["view"] for v in document["views"] if v["view"] not in gone] != run.session.names:
        raise InputError(f"{run.session.path}/views.csv: changed after {folder}; to fix: run `stitch run` again")


def _restore_fit(folder: Path, document: dict[str, Any], run: RunData) -> Fit:
    model = run.model
    gone = {item.view for item in run.left_out}
    views = [view for view in document["views"] if view["view"] not in gone]
    with library_threads_off():
        own = corrected_capture(run.measurement, model)
        overlaps = converged_overlaps(own, model.T_mount, run.gate) if own.scans else None
        poses = np.array([view["pose"] for view in views], float)
        registered = _registered_overlaps(own, poses, document, run.gate) if own.scans else None
        targets = _target_fit(folder, run) if document.get("targets") and own.sightings is not None else None
    scatter = document["repeatability"]
    return Fit(
        unobservable=tuple(document["unobservable"]),
        unknown=tuple(document.get("hand_eye_unknown", ())),
        stages=tuple(_stage_result(row) for row in document["stages"]),
        poses_model=own.poses(model.T_mount),
        poses=poses,
        corrections=np.array([view["correction"] for view in views], float),
        view_rms=np.array([_number(view["rms"]) for view in views]),
        fused=fused_cloud(folder / "stitched.ply"),
        repeatability=Repeatability(_number(scatter["rotation"]), _number(scatter["translation"]), float("nan")),
        overlaps=overlaps,
        registered=registered,
        verdict=document["verdict"],
        convergence={stage: [_number(x) for x in course] for stage, course in document["convergence"].items()},
        notes=tuple(document["notes"]),
        targets=targets,
        unsupported=Unsupported(**document.get("unsupported_points", {})),
    )


def left_out_of(document: dict[str, Any]) -> tuple[tuple[ExcludedView, ...], ViewLinks]:
    """Views that the run left out, and how the others hold each other."""
    rows = {row["view"]: row for row in document["views"]}
    left_out = [
        ExcludedView(
            item["view"], item["why"], np.array(rows[item["view"]]["pose"], float), rows[item["view"]]["points"]
        )
        for item in document.get("left_out", ())
        if item["view"] in rows
    ]
    linkage = document.get("linkage", {})
    components = tuple(tuple(part) for part in linkage.get("components", ()))
    weak = tuple((row["view"], row.get("partner", "")) for row in linkage.get("weak", ()))
    return tuple(left_out), ViewLinks(components, weak)


def _registered_overlaps(own: Capture, poses: Array, document: dict[str, Any], gate: float) -> Overlaps:
    """Correspondences after register, as the run found them last."""
    stated = (document.get("disagreement") or {}).get("gate")
    return collect_overlaps(own, poses, stated or gate, [sample_points(scan, FINE_SAMPLES) for scan in own.scans])


def _stage_result(row: dict[str, Any]) -> StageResult:
    rms, words = _number(row["rms"]), (row.get("note", ""), row.get("method", ""))
    return StageResult(row["name"], rms, row["correspondences"], row["iterations"], row["seconds"], *words)


def _target_fit(folder: Path, run: RunData) -> TargetModelFit:
    """What the labelled points say under the model; the distances of views left out are those of the fit."""
    found = evaluate_targets(run.measurement, run.model)
    used = found.rows.sightings.used
    heldout = np.full(used.shape, np.nan)
    # Beside clouds views are left out with their surfaces, not by their labelled points.
    if not run.measurement.capture.scans:
        heldout[used] = pq.read_table(folder / "residuals.parquet")["heldout"].to_numpy()
    return replace(found, heldout=heldout)


def fused_cloud(path: Path) -> FusedCloud:
    """stitched.ply read again; reference frame, length_unit."""
    require_room(path)
    vertex = PlyData.read(str(path))["vertex"]
    columns: Array = np.column_stack([vertex[name] for name in ("x", "y", "z", "nx", "ny", "nz", "residual")])
    columns = columns.astype(np.float64)
    # Earlier versions called it count.
    views = vertex["views" if "views" in vertex else "count"]
    return FusedCloud(columns[:, :3], columns[:, 3:6], columns[:, 6], np.asarray(views))


def _number(value: float | None) -> float:
    """JSON has no NaN."""
    return float("nan") if value is None else float(value)
