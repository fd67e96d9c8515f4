"""The page of a run: one file, report.html, that needs nothing beside it."""

from pathlib import Path
from typing import Any

from stitch.comparison.disagreement_field import ModelHistory, full_colour_distance, model_history
from stitch.comparison.run_verdict import run_headline, run_light
from stitch.model.model import uncertainty_scope
from stitch.runs.run import Run
from stitch.units import MICROMETRES
from viz import captions, run_figures, target_figures
from viz.filled_templates import script_json
from viz.history_figures import waterfall
from viz.identity import identity
from viz.page_head import Head, Subject, write_page
from viz.page_parts import png, svg
from viz.page_tables import effect_rows, hand_eye_rows, matrix, note_rows, target_rows, view_rows
from viz.part_camera import camera_for
from viz.part_data import part_data
from viz.part_picture import DISAGREE, part_picture, step_shown
from viz.part_surface import part_surface
from viz.target_scene import target_scene

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
    """What the views have in common decides what can be drawn: overlaps or targets."""
    out = []
    if run.targets is not None:
        out += [
            ("Targets, as every view puts them", png(target_figures.sticks(run), 130), captions.STICKS),
            ("Distance of the targets", svg(target_figures.errors(run)), captions.TARGETS),
        ]
    if run.overlaps is not None:
        out += [
            ("What register did to every view", svg(run_figures.per_view(run)), captions.PER_VIEW),
            ("How the error fell, iteration by iteration", svg(run_figures.convergence(run)), captions.CONVERGENCE),
        ]
    return out
