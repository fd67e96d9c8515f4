"""Tables of the page of two runs, as rows of plain values."""

from typing import Any, NamedTuple

import numpy as np

from stitch.comparison.two_runs import ComparedRun, TwoRuns
from stitch.frames import Array
from stitch.runs.run import Run
from stitch.units import MICROMETRES, length_text, value_uncertainty_text


class Fact(NamedTuple):
    """What is known of both runs."""

    name: str
    a: str
    b: str

    @property
    def differs(self) -> bool:
        return self.a != self.b


def facts(both: TwoRuns) -> list[Fact]:
    """What was measured and asked for; those that differ first."""
    told = [_facts(side) for side in (both.a, both.b)]
    rows = [Fact(name, told[0][name], told[1][name]) for name in told[0]]
    return sorted(rows, key=lambda row: not row.differs)


def _facts(side: ComparedRun) -> dict[str, str]:
    run, unit = side.run, side.run.session.length_unit
    session, stated = run.session, run.session.repeatability
    position = "position not stated" if stated.position is None else f"position {length_text(stated.position, unit)}"
    turn = "angle not stated" if stated.rotation is None else f"angle {np.degrees(stated.rotation):.3g}°"
    noise = session.scanner.noise
    return {
        "effects in the model": ", ".join(run.effects) or "none",
        "file of own effects": run.effects_file or "none",
        "hand-eye to begin with": _begun(run),
        "data (SHA-256)": side.data,
        "session": session.name,
        "views": str(len(session.views)),
        "views left out": ", ".join(item.view for item in run.left_out) or "none",
        "arm": "not stated" if session.robot is None else session.robot.name or "without a name",
        "stated repeatability": f"{position}, {turn}",
        "stated noise of the scanner": "not stated" if noise is None else length_text(noise, unit),
        "not observable": "; ".join(run.unobservable) or "nothing",
    }


def _begun(run: Run) -> str:
    x, y, z = run.T_mount_coarse[:3, 3]
    source = run.stages[0].note if run.stages else ""
    return f"at {x:.6g}, {y:.6g}, {z:.6g} {run.session.length_unit}{f' ({source})' if source else ''}"


def error_rows(both: TwoRuns) -> list[dict[str, Any]]:
    """The errors of both, µm, and by how much that of B is larger or smaller."""
    columns = [_errors(side) for side in (both.a, both.b)]
    return [
        {"name": name, "a": a, "b": columns[1][name], "change": 100 * (columns[1][name] / a - 1) if a else float("nan")}
        for name, a in columns[0].items()
    ]


def _errors(side: ComparedRun) -> dict[str, float]:
    run, um = side.run, MICROMETRES[side.run.session.length_unit]
    out = {}
    if side.history is not None:
        model, cloud = side.history.models[-1].field, side.history.steps[-1].field
        out |= {
            "views disagree under the model, mean on the part": model.mean_abs * um,
            "  95 % of the part below": model.quantile() * um,
            "  of it by noise alone": model.noise * um,
            "views disagree in the stitched cloud, mean on the part": cloud.mean_abs * um,
        }
    return out | {
        "rms in the fit": run.residual_rms * um,
        "rms on views left out": run.heldout_rms * um,
        "noise floor of the sensor": run.noise_floor * um,
        "scatter of the robot's poses": run.repeatability.translation * um,
    }


def hand_eye_change_rows(both: TwoRuns) -> list[dict[str, Any]]:
    """Components of the twist ± U (k = 2) and their ratio; mrad and µm, scanner frame of A."""
    change = both.hand_eye
    sizes = np.repeat([1e3, MICROMETRES[both.a.run.session.length_unit]], 3)
    names = [(f"turn about {axis}", "mrad") for axis in "xyz"] + [(f"shift along {axis}", "µm") for axis in "xyz"]
    rows = zip(names, change.twist * sizes, change.U * sizes, strict=True)
    return [
        {
            "name": name,
            "unit": unit,
            "value": value_uncertainty_text(x, U),
            "ratio": abs(x) / U if U > 0 else float("nan"),
        }
        for (name, unit), x, U in rows
    ]


def parameter_rows(both: TwoRuns) -> list[dict[str, str]]:
    """Every fitted parameter of an effect that one of them has."""
    own = [_parameters(side.run) for side in (both.a, both.b)]
    keys = list(dict.fromkeys([*own[0], *own[1]]))
    return [
        {"effect": key[0], "name": key[1], "unit": key[2], "a": own[0].get(key, "–"), "b": own[1].get(key, "–")}
        for key in keys
    ]


def _parameters(run: Run) -> dict[tuple[str, str, str], str]:
    return {
        (term.name, p.name, told.unit): str(told._replace(unit=""))
        for term in run.terms
        for p in term.parameters
        if p.fitted or p.grid
        for told in [p.formatted]
    }


def view_change_rows(both: TwoRuns) -> list[dict[str, Any]]:
    """A row for every view of either, µm; those that changed most first."""
    apart = [_by_view(side, _apart(side)) for side in (both.a, both.b)]
    after = [_by_view(side, side.run.view_rms) for side in (both.a, both.b)]
    names = list(dict.fromkeys([*apart[0], *apart[1]]))
    unknown = float("nan")
    rows = [
        {
            "view": name,
            "a": apart[0].get(name, unknown),
            "b": apart[1].get(name, unknown),
            "change": apart[1].get(name, unknown) - apart[0].get(name, unknown),
            "rms_a": after[0].get(name, unknown),
            "rms_b": after[1].get(name, unknown),
        }
        for name in names
    ]
    rows.sort(key=lambda row: -np.nan_to_num(abs(row["change"]), nan=np.inf))
    most = max((abs(row["change"]) for row in rows if np.isfinite(row["change"])), default=1.0) or 1.0
    return [row | {"share": 100 * np.nan_to_num(abs(row["change"])) / most} for row in rows]


def _by_view(side: ComparedRun, values: Array) -> dict[str, float]:
    um = MICROMETRES[side.run.session.length_unit]
    return {view.name: float(x) * um for view, x in zip(side.run.session.views, values, strict=True)}


def _apart(side: ComparedRun) -> Array:
    """(V,) how far each view is off the others under the model: mean on the part, or its rms without clouds."""
    return side.run.view_rms if side.history is None else side.history.models[-1].field.by_view
