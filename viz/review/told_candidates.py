"""A diagnosis as rows for people: candidate effects with what they should leave if added."""

from typing import Any

from stitch.units import format_amount
from stitch.writing.diagnosis_document import effect_description

# The clearest parameters of an effect that are told.
_TOLD = 3


def told_diagnosis(document: dict[str, Any], um: float) -> dict[str, Any]:
    """diagnosis.json for the browser.

    Args:
        um: micrometres in one length_unit.

    An older diagnosis has one sentence for everything: it stands once.
    """
    plain = document.get("plain")
    candidates = document.get("candidates", [])
    follows = [row for row in document.get("depends_on", []) if row["p_value"] is not None and row["p_value"] < 0.05]
    return {
        "verdict": document["verdict"],
        "named": document["effects"],
        "plain": plain or document["sentence"],
        "sentence": document["sentence"] if plain else "",
        "candidates": [_candidate(row, um) for row in candidates if row["observable"]],
        "unseen": [row["effect"] for row in candidates if not row["observable"] and not row.get("needs")],
        "untested": [{"effect": row["effect"], "needs": row["needs"]} for row in candidates if row.get("needs")],
        "follows": [{"covariate": row["covariate"], "p": f"{row['p_value']:.1g}"} for row in follows],
        "next": [{"do": row["do"], "separates": row["separates"]} for row in document.get("next", [])],
        "budget": [
            {"source": row["source"], "share": row["variance_share"]}
            for row in document.get("budget", [])
            if row["variance_share"] and row["variance_share"] > 0.005
        ],
    }


def _candidate(row: dict[str, Any], um: float) -> dict[str, Any]:
    def in_um(value: float | None) -> float | None:
        return None if value is None else value * um

    return {
        "effect": row["effect"],
        "is": effect_description(row["effect"]),
        "p": "–" if row["p_value"] is None else f"{row['p_value']:.1g}",
        "posterior": row["posterior"],
        "rms_if_added": in_um(row["rms_if_added"]),
        "heldout_if_added": in_um(row["heldout_rms_if_added"]),
        "amounts": _amounts(row["parameters"]),
        "aliases": [f"{alias['effect']} {alias['correlation']:.2f}" for alias in row["aliases"][:2]],
        "own": row.get("tier") == "user",
    }


def _amounts(parameters: dict[str, dict[str, Any]]) -> str:
    """The clearest parameters: c2 = 0.44 ± 0.04 µrad/(N m)."""
    tried = [
        f"{name} = {p.get('view') or format_amount(p['value'], None, p['unit'])}"
        for name, p in parameters.items()
        if p["sigma"] is None
    ]
    fitted = {name: p for name, p in parameters.items() if p["sigma"]}
    clearest = sorted(fitted, key=lambda name: -abs(fitted[name]["value"]) / fitted[name]["sigma"])[:_TOLD]
    told = [
        f"{name} = {format_amount(p['value'], p['sigma'], p['unit'])}" for name, p in fitted.items() if name in clearest
    ]
    return ", ".join(tried + told)
