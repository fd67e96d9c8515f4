"""The pages of measured features and of a verification, from the documents that stand beside them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stitch.system.files import whole_file
from viz.page_parts import page_written, render, versions

# Sources of a budget that a row shows by name.
_SHOWN = 3


def write_features(document: Mapping[str, Any], path: Path) -> None:
    """Write the numbers of a run with U, and the bar of every budget."""
    rows = [
        {
            "name": f"{n['feature']}.{n['quantity']}",
            "cells": [f"{n['value']:.5g}", f"{n['value'] - n['nominal']:+.2g}", f"{n['U']:.2g}", _degrees(n)],
            "words": _conformity(n),
            "bar": [b for b in n["budget"] if b["variance_share"] > 0.005],
            "told": ", ".join(f"{b['source']} {100 * b['variance_share']:.0f} %" for b in n["budget"][:_SHOWN]),
        }
        for n in document["numbers"]
    ]
    sentence = f"{len(rows)} numbers in {document['length_unit']} and rad, each with U (k = 2)."
    headings = ("value", "off nominal", "U", "ν")
    _write(path, "Features", sentence, headings, rows, document["not_included"], ())


def write_certificate(document: Mapping[str, Any], path: Path) -> None:
    """Write what an artefact says of a model: passes or fails, on what conditions, until when."""
    rows = [
        {
            "name": n["feature"],
            "cells": [f"{n['calibrated']:.5g}", f"{n['deviation']:+.2g}", f"{n['U']:.2g}", f"{n['E_n']:+.2f}"],
            "words": f"{n['error']}: " + _kept(n["passes"], n["limit"]),
            "bar": (),
            "told": "",
        }
        for n in document["numbers"]
    ]
    rows += [
        {
            "name": form["feature"],
            "cells": ["", f"{form['form_95']:.2g}", "", ""],
            "words": "form of 95 % of the points: " + _kept(form["passes"], form["limit"]),
            "bar": (),
            "told": "",
        }
        for form in document["forms"]
    ]
    facts = [
        ("Model", document["run"]),
        ("Artefact", document["session"]),
        ("Valid until", document["valid_until"] or "not known: the cell's history was not named"),
        (
            "In the manner of",
            ", ".join(document["in_the_manner_of"]) + "; these exclude scanners that an arm positions",
        ),
    ]
    headings = ("calibrated", "deviation", "U", "Eₙ")
    _write(path, "Certificate", document["sentence"], headings, rows, document["conditional_on"], facts)


def _write(
    path: Path,
    title: str,
    sentence: str,
    headings: tuple[str, ...],
    rows: list[dict[str, Any]],
    outside: list[str],
    facts: Any,
) -> None:
    facts = [*facts, page_written(), versions()]
    page = render(
        "features.html.j2", title=title, sentence=sentence, headings=headings, rows=rows, outside=outside, facts=facts
    )
    with whole_file(path) as file:
        file.write_text(page, encoding="utf-8")


def _degrees(number: Mapping[str, Any]) -> str:
    degrees = number["degrees_of_freedom"]
    return "∞" if degrees is None or degrees > 1e4 else f"{degrees:.0f}"


def _conformity(number: Mapping[str, Any]) -> str:
    if number["limits"] is None:
        return ""
    return {True: "conforms", False: "does not conform", None: "U reaches over a limit"}[number["conforms"]]


def _kept(passes: bool, limit: float | None) -> str:
    if limit is None:
        return "no limit stated" if passes else "does not agree"
    return f"{'within' if passes else 'beyond'} {limit:g}"
