"""The page of a run: one file, report.html, that needs nothing beside it."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.comparison.disagreement_field import ModelHistory, effect_changes, full_colour_distance, model_history
from stitch.comparison.run_verdict import run_headline, run_light
from stitch.model.model import expanded_uncertainty, uncertainty_scope
from stitch.runs.run import Run
from stitch.units import MICROMETRES, value_uncertainty_text
from viz import captions, run_figures
from viz.history_figures import waterfall
from viz.page_parts import Head, Subject, identity, png, script_json, svg, write_page
from viz.part_data import part_data
from viz.part_picture import DISAGREE, part_picture, step_shown
from viz.part_surface import camera_for, part_surface
from viz.run_figures import shown_points, view_shifts
from viz.target_scene import target_scene

# Tables of the page of a run, as rows of plain values.

# Of more views than this the page lists those to look at first.
_VIEWS = 60


def view_rows(run: Run, history: ModelHistory | None) -> list[dict[str, Any]]:
    """A row for every view, those that disagree most first."""
    um = MICROMETRES[run.session.length_unit]
    apart = np.full(len(run.poses), np.nan)
    if history is not None:
        apart = history.models[-1].field.by_view
    by_view = zip(run.session.views, apart, run.view_rms, view_shifts(run), run.corrections, strict=True)
    rows = [
        {
            "view": view.name,
            "points": len(shown_points(view)),
            "apart": off * um,
            "rms": rms * um,
            "shift": np.linalg.norm(moved) * um,
            "turn": np.linalg.norm(twist[:3]) * 1e3,
        }
        for view, off, rms, moved, twist in by_view
    ]
    key = "rms" if history is None else "apart"
    rows.sort(key=lambda row: -np.nan_to_num(row[key]))
    largest = max((np.nan_to_num(row[key]) for row in rows), default=1.0) or 1.0
    return [row | {"share": 100 * np.nan_to_num(row[key]) / largest} for row in rows[:_VIEWS]]


def target_rows(run: Run) -> list[dict[str, object]]:
    """A row for every target: name, views that see it, rms, position."""
    sightings = run.measurement.capture.sightings
    if run.targets is None or sightings is None:
        return []
    um = MICROMETRES[run.session.length_unit]
    columns = (sightings.targets, sightings.view_counts, run.targets.target_rms, run.targets.landmarks.positions)
    return [
        {"name": name, "seen": int(n), "rms": rms * um, "position": position}
        for name, n, rms, position in zip(*columns, strict=True)
    ]


def effect_rows(run: Run) -> list[dict[str, str]]:
    """Parameters that were fitted or tried; those that the views do not show are left out."""
    return [
        {
            "effect": term.name,
            "name": p.name,
            "value": told.value if p.discrete else told.value.replace("-", "−"),
            "sigma": told.sigma.replace("-", "−"),
            "unit": told.unit,
        }
        for term in run.terms
        for p in term.parameters
        if p.fitted or p.grid
        for told in [p.formatted]
    ]


def note_rows(run: Run) -> list[dict[str, str]]:
    """Return the remarks of reviewers on the steps of the ledger."""
    return [
        {
            "step": effect_changes(run.ledger, i),
            "text": note.text,
            "signed": ", ".join(x for x in (note.by, note.at[:10]) if x),
        }
        for i, step in enumerate(run.ledger)
        for note in step.notes
    ]


def hand_eye_rows(run: Run) -> list[dict[str, str]]:
    """Name, coarse, corrected, U (k = 2) and unit of every number of the hand-eye; all in the mount frame."""
    mm = MICROMETRES[run.session.length_unit] / 1e3
    values = []
    for T in (run.T_mount_coarse, run.T_mount):
        values.append([*(T[:3, 3] * mm), *(Rotation.from_matrix(T[:3, :3]).as_rotvec() * 1e3)])
    U = expanded_uncertainty(run.T_mount, run.mount_covariance)
    units = [*(U[3:] * mm), *(U[:3] * 1e3)]
    names = [(f"translation {axis}", "mm") for axis in "xyz"] + [(f"rotation vector {axis}", "mrad") for axis in "xyz"]
    return [
        {"name": name, "unit": unit} | _told(coarse, corrected, u)
        for (name, unit), coarse, corrected, u in zip(names, values[0], values[1], units, strict=True)
    ]


def _told(coarse: float, corrected: float, U: float) -> dict[str, str]:
    """Three numbers with the digits that U knows, as the terminal has them."""
    value, _, U_text = value_uncertainty_text(corrected, U).partition(" ± ")
    begun = f"{coarse:.{len(value.partition('.')[2])}f}"
    return {name: text.replace("-", "−") for name, text in (("coarse", begun), ("corrected", value), ("U", U_text))}


def matrix(run: Run) -> str:
    """The corrected hand-eye as four rows to copy, in the form of session.toml."""
    return "pose = " + "[\n  " + ",\n  ".join(str([float(f"{x:.12g}") for x in row]) for row in run.T_mount) + ",\n]"


# Views that are listed before the others are folded.
_FIRST = 6


def write_report(run: Run, path: Path, tolerance: float | None = None) -> None:
    """Write the page of a run; it needs nothing beside it.

    Args:
        tolerance: within which the views have to agree on the part, length_unit.
    """
    history = model_history(run)
    write_page(path, "report.html.j2", _head(run, history, tolerance), **_content(run, history))


def _head(run: Run, history: ModelHistory | None, tolerance: float | None) -> Head:
    light = None if tolerance is None else run_light(run, history, tolerance)
    gone = [f"View {item.view} does not fit its robot pose and was left out: {item.why}." for item in run.left_out]
    hidden = [f"Not observable from these motions: {direction}." for direction in run.unobservable]
    return Head(
        title=run.session.name,
        verdict=run_headline(run, history),
        doubts=run.doubts,
        subjects=[Subject(identity(run))],
        lights=[] if light is None else [light],
        evidence=run.verdict,
        notes=[*gone, *hidden],
    )


def _content(run: Run, history: ModelHistory | None) -> dict[str, object]:
    unit = run.session.length_unit
    rows = view_rows(run, history)
    return {
        "run": run,
        "um": MICROMETRES[unit],
        "part": shown_part(run, history),
        "surfaces": history is not None,
        "first": rows[:_FIRST],
        "rest": rows[_FIRST:],
        "hand_eye": hand_eye_rows(run),
        "uncertainty": uncertainty_scope(None),
        "hand_eye_matrix": matrix(run),
        "mount_frame": "base" if run.session.mount == "eye_to_hand" else "flange",
        "effects": effect_rows(run),
        "waterfall": (svg(waterfall(run.ledger, unit)), captions.WATERFALL) if len(run.ledger) > 1 else None,
        "steps": [] if history is None else history.steps,
        "notes": note_rows(run),
        "pictures": _pictures(run),
        "targets": target_rows(run),
    }


def shown_part(run: Run, history: ModelHistory | None) -> dict[str, Any] | None:
    """Return what the viewer of a page shows: the part, or the labelled points; None where there is neither."""
    return _targets(run) if history is None else _part(run, history)


def _part(run: Run, history: ModelHistory) -> dict[str, Any]:
    """Data of the viewer, and the still picture in its place."""
    um, steps = MICROMETRES[run.session.length_unit], history.steps
    surface = part_surface(run.fused, history.patches)
    camera = camera_for(surface.vertices, surface.normals, upright=run.session.mount == "eye_in_hand")
    names = run.session.names
    data = part_data(surface, camera, history, names, run.session.length_unit)
    # Coarse is so far off that all would be red.
    shown = [step_shown(step, um) for step in steps[1:]]
    still = part_picture(surface, camera, shown[-4:], full_colour_distance(history.models[0].field) * um, DISAGREE)
    words = {"title": "Where the views disagree", "caption": captions.FIELD, "handling": captions.HANDLING}
    words |= {"alt": "The part, coloured by how far the views disagree, at every step of the model"}
    return {"data": script_json(data), "still": png(still, 110), **words}


def _targets(run: Run) -> dict[str, Any] | None:
    """The same of labelled points; None where there are none."""
    scene = target_scene(run)
    caption = captions.CARRIED_TARGETS if run.session.mount == "eye_to_hand" else captions.SEEN_TARGETS
    words = {"title": "Where the targets lie off", "caption": caption, "handling": captions.HANDLING}
    words |= {"alt": "The targets, coloured by how far the views see them off their place, at every step of the model"}
    return None if scene is None else scene | words


def _pictures(run: Run) -> list[tuple[str, str, str]]:
    """Return the pictures of a run: those of overlaps or those of targets."""
    out = []
    if run.targets is not None:
        out += [
            ("Targets, as every view puts them", png(run_figures.sticks(run), 130), captions.STICKS),
            ("Distance of the targets", svg(run_figures.errors(run)), captions.TARGETS),
        ]
    if run.overlaps is not None:
        out += [
            ("What register did to every view", svg(run_figures.per_view(run)), captions.PER_VIEW),
            ("The error, iteration by iteration", svg(run_figures.convergence(run)), captions.CONVERGENCE),
        ]
    return out
