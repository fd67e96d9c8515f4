"""result.json and ledger.json of a run folder, checked: a person may have edited them, or a disk cut them short."""

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.model.effects_covariance import EffectsCovariance
from stitch.reading.text_file import read_text, shortened
from stitch.runs.run import LedgerStep, Note

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
    left_out=_list_schema(_object_schema({"view": _TEXT, "why": _TEXT})),
    linkage=_object_schema(
        {}, components=_list_schema(_list_schema(_TEXT)), weak=_list_schema(_object_schema({"view": _TEXT}))
    ),
)
_CANDIDATES = _list_schema(_object_schema({"effect": _TEXT}, hand_eye_if_missed=_NUMBER_OR_NULL))
_VERDICT = {"enum": ["adequate", "missing_effect", "cannot_tell", "unknown_effect"]}
DIAGNOSIS = _object_schema({"verdict": _VERDICT}, candidates=_CANDIDATES)
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
        raise InputError(f"{folder}: no such run folder; `stitch run` writes one")
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


def covariance_of_effects(path: Path) -> EffectsCovariance:
    """What the result beside a model.toml says of its effects' parameters; nothing where there is none.

    Args:
        path: folder of a run or of a rig, or a model.toml.

    Raises:
        InputError: a result.json that is damaged, or a matrix of another size than its names.
    """
    folder = path if path.is_dir() else path.parent
    found = [folder / "result.json", *sorted(folder.glob("*/result.json"))]
    file = next((f for f in found if f.is_file()), None)
    stated = read_result(file.parent).get("effects_covariance") if file else None
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

    hint = "name a run folder that `stitch run` wrote"
    if (file.parent / "session.toml").is_file():
        hint = f"this is a session; to fix: `stitch run {shlex.quote(str(file.parent))} -o RUN` first, then name RUN"
    told = read_text(file, hint)
    try:
        document = json.loads(told, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: damaged ({shortened(str(error))}); run `stitch run` again") from None
    wrong = best_match(Draft202012Validator(schema).iter_errors(document))
    if wrong is not None:
        place = ".".join(str(step) for step in wrong.absolute_path) or "the document"
        raise InputError(f"{file}: damaged ({place}: {shortened(wrong.message, 160)}); run `stitch run` again")
    return document


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is no number")
