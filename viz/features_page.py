"""The pages of measured features and of a verification, from the documents that stand beside them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stitch.system.files import whole_file
from viz.page_parts import page_written, render, versions

# Sources of a budget that a row shows by name.
_SHOWN = 3
_WORDS = ("error", "verdict", "what brings U", "answers to", "why")
# Classes of a verdict: kept, not kept, and undecided.
_MARKS = {True: "good", False: "bad", None: "check"}
_LIMIT_HEADINGS = ("limit", "verdict")


def write_features(document: Mapping[str, Any], path: Path) -> None:
    """Write the numbers of a run with U, and the bar of every budget."""
    rows = [
        {
            "cells": [
                f"{n['feature']}.{n['quantity']}",
                _rounded(n["value"], n["U"]),
                _rounded(n["value"] - n["nominal"], n["U"], "+"),
                _rounded(n["U"], n["U"]),
                n["unit"],
                _degrees(n),
                _conformity(n),
            ],
            "mark": _MARKS[n["conforms"]],
            "budget": [b for b in n["budget"] if b["variance_share"] > 0.005],
            "told": ", ".join(
                f"{b['source']} {100 * b['variance_share']:.0f} %" for b in n["budget"][:_SHOWN] if n["U"]
            ),
        }
        for n in document["numbers"]
    ]
    headings = ("feature", "value", "off nominal", "U", "unit", "ν", "verdict", "what brings U")
    tables = [
        {"name": "Numbers and their budgets", "headings": headings, "rows": rows},
        _unseen_table(document.get("not_measured", {})),
    ]
    _write(
        path,
        title="Features",
        sentence=f"{len(rows)} numbers, each with U (k = 2)",
        tables=[table for table in tables if table["rows"]],
        facts=[("Run", document["run"]), ("ν", "degrees of freedom that U rests on")],
        outside_name="Not in U",
        outside=document["not_included"],
    )


def write_certificate(document: Mapping[str, Any], path: Path) -> None:
    """Write what an artefact says of a model: passes or fails, on what conditions, until when."""
    unit = document["length_unit"]
    tables = [
        _number_table(document["numbers"], unit),
        _hand_eye_table(document["hand_eye"], unit),
        _form_table(document["forms"], unit),
        _unseen_table(document.get("not_measured", {})),
    ]
    standards = ", ".join(document["in_the_manner_of"])
    _write(
        path,
        title="Certificate",
        sentence=document["sentence"],
        mark={True: "light good", False: "light bad", None: "light check"}[document["passed"]],
        tables=[table for table in tables if table["rows"]],
        facts=[
            ("Model", document["run"]),
            ("Artefact", document["session"]),
            ("Answers to", ", ".join(document["answers_to"]).replace("_", "-") or "nothing of the cell"),
            *(("Doubt", doubt) for doubt in document["doubts"] if doubt not in document["sentence"]),
            *(("Left out", f"{item['view']}: {item['why']}") for item in document["left_out"]),
            ("Valid until", document["valid_until"] or "not known: the cell's history was not named"),
            ("In the manner of", f"{standards}; these exclude scanners that an arm positions"),
        ],
        outside_name="Conditional on what U does not hold",
        outside=document["conditional_on"],
    )


def _number_table(numbers: Sequence[Mapping[str, Any]], unit: str) -> dict[str, Any]:
    rows = [
        {
            "cells": [
                n["feature"],
                n["error"],
                *(_rounded(n[key], n["U"]) for key in ("calibrated", "measured")),
                _rounded(n["deviation"], n["U"], "+"),
                *(_rounded(n[key], n["U"]) for key in ("U", "U_calibrated")),
                f"{n['E_n']:+.2f}",
                *_kept(n),
                ", ".join(n["answers_to"]).replace("_", "-") or "the artefact alone",
            ],
            "mark": _MARKS[n["passes"]],
        }
        for n in numbers
    ]
    measured = ("feature", "error", "calibrated", "measured", "off", "U", "U cal.", "Eₙ")
    headings = (*measured, *_LIMIT_HEADINGS, "answers to")
    return {"name": f"Sizes, distances and places, {unit} (k = 2)", "headings": headings, "rows": rows}


def _hand_eye_table(hand_eye: Mapping[str, Any], unit: str) -> dict[str, Any]:
    apart = [_rounded(hand_eye[key], hand_eye["U"]) for key in ("distance", "U", "U_given")]
    verdict = "agrees" if hand_eye["agrees"] else "does not agree"
    cells = ["hand-eye of the model", *apart, f"{hand_eye['ratio']:.2f}", verdict]
    asked = ("against the views", "apart at the part", "U of both", "U of the model", "over what U allows", "verdict")
    rows = [{"cells": cells, "mark": _MARKS[hand_eye["agrees"]]}]
    return {"name": f"Hand-eye, {unit} (k = 2)", "headings": asked, "rows": rows}


def _form_table(forms: Sequence[Mapping[str, Any]], unit: str) -> dict[str, Any]:
    rows = [
        {"cells": [f["feature"], f"{f['form_95']:.2g}", *_kept(f)], "mark": "good" if f["passes"] else "bad"}
        for f in forms
    ]
    headings = ("feature", "band of 95 % of the points", *_LIMIT_HEADINGS)
    return {"name": f"Form, {unit}", "headings": headings, "rows": rows}


def _unseen_table(not_measured: Mapping[str, str]) -> dict[str, Any]:
    rows = [{"cells": [name, why.removeprefix(f"{name}: ")]} for name, why in not_measured.items()]
    return {"name": "Not measured", "headings": ("feature", "why"), "rows": rows}


def _write(path: Path, facts: list[tuple[str, str]], **content: Any) -> None:
    facts = [*facts, page_written(), versions()]
    with whole_file(path) as file:
        file.write_text(render("features.html.j2", facts=facts, words=_WORDS, zip=zip, **content), encoding="utf-8")


def _rounded(x: float, U: float, sign: str = "") -> str:
    """A number with as many places as U has with two digits; four where it is a datum's, which has none."""
    places = int(np.clip(1 - np.floor(np.log10(U or 1e-3)), 0, 12))
    return f"{x:{sign}.{places}f}"


def _degrees(number: Mapping[str, Any]) -> str:
    degrees = number["degrees_of_freedom"]
    return "∞" if degrees is None or degrees > 1e4 else f"{degrees:.0f}"


def _conformity(number: Mapping[str, Any]) -> str:
    if number["limits"] is None:
        return ""
    return {True: "conforms", False: "does not conform", None: "U reaches over a limit"}[number["conforms"]]


def _kept(error: Mapping[str, Any]) -> tuple[str, str]:
    """The limit of an error, and whether it is kept."""
    passes, limit = error["passes"], error["limit"]
    if limit is None:
        return "–", "agrees" if passes else "does not agree"
    return f"{limit:g}", {True: "within", False: "beyond", None: "U is too large to say"}[passes]
