"""A run folder at one moment, as the browser shows it: documents, undo history, candidates, the part's viewer."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from stitch.diagnosis.sentences import posterior_text
from stitch.errors import InputError
from stitch.numerics.units import MICROMETRES, format_amount
from stitch.output.comparison.model_history import effect_changes
from stitch.output.comparison.run_verdict import shorten_doubts
from stitch.output.plain_words import effect_description, effect_in_words
from stitch.output.stored_run import read_documents
from stitch.run_data import LedgerStep
from stitch.session.reading.text_files import shortened

# Undo and redo, read from the ledger alone: it only grows, and a return to an earlier model is one of its steps.

Effects = Sequence[str]


def undo_history(steps: Sequence[Effects]) -> dict[str, Any]:
    """Return the effects of undo and redo: {"undo": {"command", "effects", "to"}, "redo": …}, or None.

    Args:
        steps: effects of the model at every step of the ledger, the present one last.
    """
    visited, at = _visited(steps)
    return {
        "undo": _change(visited[at], visited[at - 1]) if at > 0 else None,
        "redo": _change(visited[at], visited[at + 1]) if at + 1 < len(visited) else None,
    }


def _visited(steps: Sequence[Effects]) -> tuple[list[Effects], int]:
    """Models as a browser keeps pages, and which of them is shown: a step to a neighbour goes there."""
    visited: list[Effects] = [steps[0]] if steps else [()]
    at = 0
    for effects in steps[1:]:
        if set(effects) == set(visited[at]):
            continue
        if at > 0 and set(effects) == set(visited[at - 1]):
            at -= 1
        elif at + 1 < len(visited) and set(effects) == set(visited[at + 1]):
            at += 1
        else:
            visited = [*visited[: at + 1], effects]
            at += 1
    return visited, at


def _change(present: Effects, target: Effects) -> dict[str, Any] | None:
    """The one command that leads there; None where it takes two."""
    new = [effect for effect in target if effect not in present]
    gone = [effect for effect in present if effect not in target]
    if bool(new) == bool(gone):
        return None
    return {"command": "add" if new else "drop", "effects": new or gone, "to": list(target)}


# A diagnosis as rows for people: candidate effects with what they should leave if added.


def told_diagnosis(document: dict[str, Any], um: float) -> dict[str, Any]:
    """diagnosis.json for the browser.

    Args:
        um: micrometres in one length_unit.

    An older diagnosis has one sentence for everything: it stands once.
    """
    plain = document.get("plain")
    candidates = document.get("candidates", [])
    follows = [row for row in document.get("depends_on", []) if row["p_value"] is not None and row["p_value"] < 0.05]
    screen = document.get("screen") or {}
    posteriors = {row["effect"]: row["posterior"] for row in candidates}
    posterior = partial(posterior_text, document["verdict"], document["effects"], posteriors)
    return {
        "headline": screen.get("headline", ""),
        "proof": screen.get("proof", ""),
        "certainty": screen.get("certainty", ""),
        "why": screen.get("why"),
        "courses": {row["effect"]: row["why"] for row in screen.get("candidates", [])},
        "verdict": document["verdict"],
        "named": document["effects"],
        "advised": _advised(document.get("next_command", "")),
        "instead": _advised(document.get("command_without_a_view", "")),
        "plain": plain or document["sentence"],
        "sentence": document["sentence"] if plain else "",
        "candidates": [
            _candidate(row, um) | {"posterior": posterior(row["effect"])} for row in candidates if row["observable"]
        ],
        "unseen": [row["effect"] for row in candidates if not row["observable"] and not row.get("needs")],
        "untested": [{"effect": row["effect"], "needs": row["needs"]} for row in candidates if row.get("needs")],
        "follows": [
            {"covariate": row["covariate"], "table": _table_of(row["covariate"]), "p": f"{row['p_value']:.1g}"}
            for row in follows
        ],
        "next": [{"do": row["do"], "separates": row["separates"]} for row in document.get("next", [])],
    }


def _advised(command: str) -> str:
    """Return which step the command of a diagnosis is: add, group, next, explain, export; empty where it is none."""
    step = re.search(r"stitch (add|next|explain|export)\b", command)
    return "" if step is None else "group" if "--group" in command else step[1]


# What a diagnosis calls otherwise than a comparison does.
_TABLES = {"view order": "order", "time_s": "time"}


def _table_of(covariate: str) -> str:
    """Return the table of compare.json that shows a covariate."""
    joint = re.fullmatch(r"(j\d+)_deg", covariate)
    return joint[1] if joint else _TABLES.get(covariate, covariate)


def predicted_fields(document: dict[str, Any], um: float) -> dict[str, Any] | None:
    """Return the fields of the candidates of diagnosis.json for the part's viewer; None where there are none."""
    screen = document.get("screen") or {}
    if not screen.get("places"):
        return None
    return {key: screen[key] for key in ("places", "now", "candidates")} | {"um": um}


def _candidate(row: dict[str, Any], um: float) -> dict[str, Any]:
    def in_um(value: float | None) -> float | None:
        return None if value is None else value * um

    return {
        "effect": row["effect"],
        "is": effect_description(row["effect"]),
        "p": "–" if row["p_value"] is None else f"{row['p_value']:.1g}",
        "rms_if_added": in_um(row["rms_if_added"]),
        "heldout_if_added": in_um(row["heldout_rms_if_added"]),
        "amounts": row.get("amounts", ""),
        "aliases": [f"{alias['effect']} {alias['correlation']:.2f}" for alias in row["aliases"][:2]],
        "own": row.get("tier") == "user",
    }


# What the page shows comes from these; a change of one is a change of the run.
_FILES = ("result.json", "ledger.json", "compare.json", "diagnosis.json", "report.html", "residuals.parquet")
_TRIES = 3
_Told = TypeVar("_Told")


@dataclass(frozen=True)
class Snapshot:
    """A run folder as it stood; all of it of one model."""

    version: str
    model: str  # changes with the model alone, not with a remark
    state: dict[str, Any]  # plain data for the browser, lengths of the error in µm
    part: str | None  # JSON of the viewer's data, as report.html holds it
    predicted: str | None  # JSON of the fields of candidate effects
    result: dict[str, Any]  # result.json
    comparison: dict[str, Any] | None  # compare.json


def read_snapshot(run: Path) -> Snapshot:
    """Read a run folder; one that is rewritten meanwhile is read again.

    Raises:
        InputError: no run folder, or a damaged file in it.
    """
    for _ in range(_TRIES):
        before = version_of(run)
        try:
            found = _read(run, before)
        except InputError:
            if version_of(run) == before:
                raise
            continue
        if version_of(run) == before:
            return found
    raise InputError(f"{run}: is rewritten again and again; to fix: wait until what writes there has ended")


def version_of(run: Path, files: tuple[str, ...] = _FILES) -> str:
    """Changes when a file of the run does."""
    marks = []
    for name in files:
        try:
            found = (run / name).stat()
            marks.append(f"{found.st_ino:x}.{found.st_mtime_ns:x}.{found.st_size:x}")
        except OSError:
            marks.append("-")
    return "_".join(marks)


def _read(run: Path, version: str) -> Snapshot:
    result, ledger = read_documents(run)
    um = MICROMETRES[result["length_unit"]]
    comparison = _told(run / "compare.json", lambda document: (document, _tables(document, um)))
    diagnosis = _told(
        run / "diagnosis.json", lambda document: (told_diagnosis(document, um), predicted_fields(document, um))
    )
    told, predicted = (None, None) if diagnosis is None else diagnosis
    part = _script(_text(run / "report.html"), "part-data")
    steps = (result.get("disagreement") or {}).get("steps", [])
    model = version_of(run, ("result.json",))
    # A run without clouds says null; an older one says nothing.
    labelled = result.get("disagreement", {}) is None
    doubts = result.get("doubts", [])
    state = {
        "version": version,
        "model": model,
        "run": str(run),
        "name": result.get("name", Path(result["session"]).name),
        "sentence": shorten_doubts(result.get("plain") or result["verdict"], doubts),
        "evidence": " ".join([*doubts, result["verdict"]]),
        "length_unit": result["length_unit"],
        "labelled": labelled,
        "carried": result["mount"] == "eye_to_hand",
        "residual": result["residual_rms"] * um,
        "heldout": None if result["heldout_rms"] is None else result["heldout_rms"] * um,
        "floor": result["noise_floor"] * um,
        "steps": [{"step": s["step"], "mean": s["mean"] * um, "noise": s["of_noise"] * um} for s in steps],
        "ledger": [_step(ledger, i, um) for i in range(len(ledger))],
        "effects": _effects(result),
        "in_words": [effect_in_words(effect) for effect in result["effects"]],
        "diagnosis": told,
        "um": um,
        "view_names": [row["view"] for row in result.get("views", [])],
        "comparison": None if comparison is None else comparison[1],
        "history": undo_history([step.effects for step in ledger]),
        "part": part is not None,
        # Written by an older version, or taken away.
        "outdated": part is None or ("marks" if labelled else "byView") not in part,
        "pictured": [] if predicted is None else [row["effect"] for row in predicted["candidates"]],
        "recording": (run / "recording.rrd").is_file(),
        "notes": [*result["notes"], *(f"Not observable from these motions: {x}." for x in result["unobservable"])],
    }
    document = None if comparison is None else comparison[0]
    fields = None if predicted is None else json.dumps(predicted)
    return Snapshot(version, model, state, part, fields, result=result, comparison=document)


def _step(ledger: tuple[LedgerStep, ...], i: int, um: float) -> dict[str, Any]:
    step = ledger[i]
    return {
        "step": i,
        "change": effect_changes(ledger, i),
        "effects": list(step.effects),
        "residual": step.residual_rms * um,
        "heldout": step.heldout_rms * um if step.heldout_rms == step.heldout_rms else None,
        "floor": step.noise_floor * um,
        "notes": [{"at": note.at, "by": note.by, "text": note.text} for note in step.notes],
    }


def _effects(result: dict[str, Any]) -> list[dict[str, str]]:
    """Fitted parameters of the effects in use."""
    return [
        {"effect": effect, "parameter": name, "value": told.value, "sigma": told.sigma, "unit": told.unit}
        for effect, own in result["effects"].items()
        for name, p in own.items()
        if p.get("sigma") is not None
        for told in [format_amount(p["value"], p["sigma"], p.get("unit", ""))]
    ]


def _tables(comparison: dict[str, Any], um: float) -> list[dict[str, Any]]:
    """Tables of compare.json with errors in µm; pairs are too many to choose from."""

    def scaled(values: list[float | None]) -> list[float | None]:
        return [None if x is None else x * um for x in values]

    return [
        table | {key: scaled(table[key]) for key in ("mean", "mean_sigma", "rms", "rms_sigma")}
        for table in comparison.get("tables", [])
        if table["name"] != "pair"
    ]


def _told(path: Path, tell: Callable[[dict[str, Any]], _Told]) -> _Told | None:
    """Read a document; None where there is none.

    Raises:
        InputError: it is damaged.
    """
    text = _text(path)
    if not text:
        return None
    try:
        return tell(json.loads(text))
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: damaged ({shortened(repr(error))}); run its command again") from None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def _script(page: str, name: str) -> str | None:
    found = re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', page, re.S)
    return found[1] if found else None
