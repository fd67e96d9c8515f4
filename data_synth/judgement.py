"""A run and its diagnosis against the truth of its cell."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.nature import LAWS
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.units import format_amount


def judge(run: Path, truth: Path) -> dict[str, Any]:
    """Hidden, named and fitted effects, and the hand-eye's true error (mm at 400 mm before the scanner).

    Raises:
        InputError: a file is missing, not JSON or without what belongs there.
    """
    told = _read(truth, "hidden", "hand_eye")
    result = _read(run / "result.json", "length_unit", "hand_eye", "hand_eye_coarse")
    diagnosis = _read(run / "diagnosis.json") if (run / "diagnosis.json").is_file() else {}
    hidden, fitted = told["hidden"], result.get("effects", {})
    place = np.array([[0.0, 0.0, 400.0]])
    scale = {"mm": 1.0, "m": 1000.0}[result["length_unit"]]

    def off(T: Any) -> float:
        T = np.array(T)
        T[:3, 3] *= scale
        difference = frames.transform(T, place) - frames.transform(np.array(told["hand_eye"]), place)
        return round(float(np.linalg.norm(difference)), 4)

    named = set(diagnosis.get("effects", []))
    judged: dict[str, Any] = {
        "hidden": hidden,
        "in_the_model": sorted(fitted),
        "verdict": diagnosis.get("verdict", "not diagnosed"),
        "named": sorted(named),
        "judgement": _judgement(hidden, diagnosis.get("verdict"), named, fitted),
        "hand_eye_error_coarse_mm": off(result["hand_eye_coarse"]),
        "hand_eye_error_mm": off(result["hand_eye"]),
    }
    if (run / "ledger.json").is_file() and len(steps := _steps(run)) > 1:
        judged["hand_eye_error_by_step_mm"] = [off(step["hand_eye"]) for step in steps]
    for effect, parameters in hidden.items():
        for name, value in parameters.items():
            got = fitted.get(effect, {}).get(name)
            if got:
                found, true = (
                    format_amount(got["value"], got["sigma"], got["unit"]),
                    format_amount(value, None, got["unit"]),
                )
                judged[f"{effect}.{name}"] = f"{found}, true {true}"
    return judged


def _judgement(hidden: dict[str, Any], verdict: str | None, named: set[str], fitted: dict[str, Any]) -> str:
    """One line: what was added, what was said, and what of the truth neither holds."""
    invented = sorted(set(fitted) - set(hidden))
    own = [name for name in invented if name not in LAWS]
    if own:
        return f"{', '.join(own)}: an effect of your own, its name says nothing here; judge it by the hand-eye's error"
    if invented:
        return f"wrong: {', '.join(invented)} was added and is not there"
    left = set(hidden) - set(fitted)
    lacking = _lacking(hidden, fitted)
    if verdict is None:
        found = f"not found yet: {', '.join(sorted(left))}" if left else "complete"
    elif verdict == "adequate":
        found = f"missed: {', '.join(sorted(left))}" if left else "right"
    elif verdict == "unknown_effect":
        found = "right: something is there" if left or lacking else "wrong: nothing is left"
    elif named & left:
        found = "right" if verdict == "missing_effect" else "right: among those that cannot be told apart"
    else:
        found = "wrong name"
    return f"{found}, but {', '.join(lacking)} stayed at zero" if lacking and found in ("complete", "right") else found


def _lacking(hidden: dict[str, Any], fitted: dict[str, Any]) -> list[str]:
    """True coefficients of fitted effects that the fit holds at zero."""
    return [
        f"{effect}.{name} (true {value:.3g})"
        for effect, parameters in hidden.items()
        # A law that is written in other numbers than its effect, as a beam's is, has none in common with it.
        if effect in fitted and not parameters.keys().isdisjoint(fitted[effect])
        for name, value in parameters.items()
        if value and not fitted[effect].get(name, {"value": 0.0})["value"]
    ]


def _steps(run: Path) -> list[dict[str, Any]]:
    steps: list[dict[str, Any]] = json.loads((run / "ledger.json").read_text(encoding="utf-8"))
    return steps


def _read(path: Path, *needed: str) -> dict[str, Any]:
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: not found") from None
    except (json.JSONDecodeError, UnicodeDecodeError, IsADirectoryError) as error:
        raise InputError(f"{path}: not a JSON file: {error}") from None
    for key in needed:
        if not isinstance(document, dict) or key not in document:
            raise InputError(f"{path}: {key} is missing; is it the right file?")
    return document
