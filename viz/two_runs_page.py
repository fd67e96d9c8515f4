"""The page of two runs side by side: one file that needs nothing beside it."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.comparison.disagreement_field import full_colour_distance
from stitch.comparison.run_verdict import ToleranceVerdict, run_light, run_verdict
from stitch.comparison.two_runs import ComparedRun, TwoRuns, comparison_sentence
from stitch.units import MICROMETRES, length_text
from viz import captions
from viz.filled_templates import script_json
from viz.history_figures import two_bars
from viz.identity import identity
from viz.page_head import Head, Subject, write_page
from viz.page_parts import png, svg
from viz.part_camera import Camera, camera_for
from viz.part_data import Extent, extent_of, part_data
from viz.part_picture import DISAGREE, part_picture, step_shown
from viz.part_surface import PartSurface, part_surface
from viz.two_runs_tables import error_rows, facts, hand_eye_change_rows, parameter_rows, view_change_rows

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
        "bars": svg(two_bars(both.a.run, both.b.run)),
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
    um = MICROMETRES[both.a.run.session.length_unit]
    histories, sides = (both.a.history, both.b.history), (both.a, both.b)
    surfaces = [part_surface(side.run.fused, own.patches) for side, own in zip(sides, histories, strict=True)]
    upright = both.a.run.session.mount == "eye_in_hand"
    cameras = [camera_for(surface.vertices, surface.normals, upright) for surface in surfaces]
    if both.same_data:
        cameras[1] = cameras[0]
    extents = _extents(surfaces, cameras, both.same_data)
    data = [
        part_data(surface, camera, own, side.run.session.names, side.run.session.length_unit, extent)
        for surface, camera, own, side, extent in zip(surfaces, cameras, histories, sides, extents, strict=True)
    ]
    limit = max(full_colour_distance(own.models[0].field) for own in histories) * um
    signed = max(own["fullSigned"] for own in data)
    out = []
    for i, letter in enumerate("AB"):
        shown = [step_shown(step, um) for step in histories[i].steps[-2:]]
        out.append(
            {
                "id": f"part-{letter.lower()}",
                "name": f"{letter}: {sides[i].name}",
                "data": script_json(data[i] | {"full": limit, "fullSigned": signed}),
                "still": png(part_picture(surfaces[i], cameras[i], shown, limit, DISAGREE), 100),
            }
        )
    return out


def _extents(surfaces: list[PartSurface], cameras: list[Camera], one_place: bool) -> list[Extent]:
    """So large that the larger part has room; about one middle for both if they lie in one place."""
    if one_place:
        return [extent_of(np.vstack([surface.vertices for surface in surfaces]), cameras[0])] * len(surfaces)
    own = [extent_of(surface.vertices, camera) for surface, camera in zip(surfaces, cameras, strict=True)]
    sides = np.maximum(own[0].sides, own[1].sides)
    return [Extent(extent.centre, sides) for extent in own]
