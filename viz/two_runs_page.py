"""The page of two runs side by side: one file that needs nothing beside it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, length_text, value_uncertainty_text
from stitch.output.comparison.run_verdict import ToleranceVerdict, run_light, run_verdict
from stitch.output.comparison.two_runs import ComparedRun, TwoRuns, comparison_sentence
from stitch.run_data import RunData
from viz import captions
from viz.page_parts import Head, Subject, identity, script_json, write_page
from viz.part_data import Extent, extent_of, part_data
from viz.part_surface import Camera, PartSurface, camera_for, part_surface


class Fact(NamedTuple):
    """Hold one property of both runs."""

    name: str
    a: str
    b: str

    @property
    def differs(self) -> bool:
        return self.a != self.b


def facts(both: TwoRuns) -> list[Fact]:
    """Return properties of data and settings; those that differ first."""
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


def _begun(run: RunData) -> str:
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


def _parameters(run: RunData) -> dict[tuple[str, str, str], str]:
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


# Views that are listed before the others are folded.
_FIRST = 8


def write_two_runs(both: TwoRuns, path: Path, tolerance: float | None = None) -> None:
    """Write the page of two runs.

    Args:
        tolerance: within which the views have to agree on the part, length_unit.
    """
    write_page(path, "two_runs.html.j2", _head(both, tolerance), **_content(both))


def _head(both: TwoRuns, tolerance: float | None) -> Head:
    letters = (("A", both.a), ("B", both.b))
    return Head(
        title=f"A: {both.a.name} · B: {both.b.name}",
        verdict=comparison_sentence(both),
        lights=[light for letter, side in letters for light in _light(letter, side, tolerance)],
        evidence="Both read the same data: what differs is the models' doing."
        if both.same_data
        else "The data are not the same: what differs is not the models' doing alone.",
        subjects=[Subject(identity(side.run), f"{letter}: {side.name}", _found(side)) for letter, side in letters],
    )


def _light(letter: str, side: ComparedRun, tolerance: float | None) -> list[ToleranceVerdict]:
    own = None if tolerance is None else run_light(side.run, side.history, tolerance)
    if own is None:
        return []
    return [own._replace(sentence=f"{letter}: {own.sentence}")]


def _found(side: ComparedRun) -> list[str]:
    """The verdict of one run, for everybody and with its evidence."""
    return [run_verdict(side.run, side.history), side.run.verdict]


def _content(both: TwoRuns) -> dict[str, object]:
    known, rows = facts(both), view_change_rows(both)
    return {
        "parts": _parts(both),
        "caption": captions.TWO_FIELDS,
        "handling": captions.HANDLING_OF_TWO,
        "errors": error_rows(both),
        "differing": [row for row in known if row.differs],
        "alike": [row for row in known if not row.differs],
        "parameters": parameter_rows(both),
        "hand_eye": hand_eye_change_rows(both),
        "hand_eye_words": _hand_eye_words(both),
        "off": "rms" if both.a.history is None else "off the others",
        "views_first": rows[:_FIRST],
        "views_rest": rows[_FIRST:],
    }


def _hand_eye_words(both: TwoRuns) -> str:
    change, unit = both.hand_eye, both.a.run.session.length_unit
    if not change.twist.any():
        return "Both have the same hand-eye."
    told = (
        f"T_A⁻¹·T_B as a twist. The points of B's views lie {length_text(change.at_part, unit)} (rms) from where A's "
        f"hand-eye puts them; the covariances of both make {length_text(change.U_at_part, unit)} of it (k = 2)."
    )
    if np.isfinite(change.p_value):
        told += f" Chance alone would make the six numbers this large with p = {change.p_value:.2g}."
    if both.same_data:
        told += " Both were fitted to the same data and err alike: U of their difference is stated too large."
    return told


def _parts(both: TwoRuns) -> list[dict[str, Any]]:
    """Data of both viewers, in one scale of colours and of lengths; empty without clouds."""
    if both.a.history is None or both.b.history is None:
        return []
    histories, sides = (both.a.history, both.b.history), (both.a, both.b)
    surfaces = [part_surface(side.run.fused, own.patches) for side, own in zip(sides, histories, strict=True)]
    upright = both.a.run.session.mount == "eye_in_hand"
    cameras = [camera_for(surface.vertices, surface.normals, upright) for surface in surfaces]
    if both.same_data:
        cameras[1] = cameras[0]
    extents = _extents(surfaces, cameras, both.same_data)
    data = [
        part_data(surface, camera, own, side.run.session, extent)
        for surface, camera, own, side, extent in zip(surfaces, cameras, histories, sides, extents, strict=True)
    ]
    limit = max(own["full"] for own in data)
    signed = max(own["fullSigned"] for own in data)
    return [
        {
            "id": f"part-{letter.lower()}",
            "name": f"{letter}: {side.name}",
            "data": script_json(own | {"full": limit, "fullSigned": signed}),
        }
        for letter, side, own in zip("AB", sides, data, strict=True)
    ]


def _extents(surfaces: list[PartSurface], cameras: list[Camera], one_place: bool) -> list[Extent]:
    """So large that the larger part has room; about one middle for both if they lie in one place."""
    if one_place:
        return [extent_of(np.vstack([surface.vertices for surface in surfaces]), cameras[0])] * len(surfaces)
    own = [extent_of(surface.vertices, camera) for surface, camera in zip(surfaces, cameras, strict=True)]
    sides = np.maximum(own[0].sides, own[1].sides)
    return [Extent(extent.centre, sides) for extent in own]
