"""A run in a cell of a notebook: the viewer of its page in a frame of its own, and the same as a picture."""

import html

from matplotlib.figure import Figure

from stitch.comparison.disagreement_field import full_colour_distance, model_history
from stitch.comparison.run_verdict import run_headline
from stitch.runs.run import Run
from stitch.units import MICROMETRES
from viz import run_figures
from viz.page_parts import render
from viz.part_picture import DISAGREE, part_picture, step_shown
from viz.part_surface import camera_for, part_surface
from viz.run_page import shown_part

# Steps of the model side by side, the last ones.
_STEPS = 4
_HEIGHT = 760


def notebook_view(run: Run) -> str:
    """Return HTML for a cell: headline and viewer as report.html has them, in a frame, so that neither styles nor names
    of a notebook's other cells come into it. It asks no server."""
    history = model_history(run)
    part = shown_part(run, history)
    page = render("notebook.html.j2", title=run.session.name, verdict=run_headline(run, history), part=part)
    height = 220 if part is None else _HEIGHT
    return (
        f'<iframe srcdoc="{html.escape(page)}" sandbox="allow-scripts" title="{html.escape(run.session.name)}" '
        f'style="width: 100%; height: {height}px; border: 0"></iframe>'
    )


def plot(run: Run) -> Figure:
    """Return the part at the last steps of the model, coloured by how far its views disagree (µm); of labelled points
    alone, the targets as every view puts them."""
    history, um = model_history(run), MICROMETRES[run.session.length_unit]
    if history is None:
        return run_figures.sticks(run)
    surface = part_surface(run.fused, history.patches)
    camera = camera_for(surface.vertices, surface.normals, upright=run.session.mount == "eye_in_hand")
    # Coarse is so far off that all would be red.
    shown = [step_shown(step, um) for step in history.steps[1:]]
    return part_picture(surface, camera, shown[-_STEPS:], full_colour_distance(history.models[0].field) * um, DISAGREE)
