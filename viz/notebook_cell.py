"""A run in a cell of a notebook: its page in a frame, and the part as a picture."""

import html

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from stitch.output.comparison.model_history import model_history
from stitch.run_data import RunData
from viz.colours import BLUE, ORANGE
from viz.figures import subplots
from viz.part_picture import error_falling, part_picture
from viz.run_numbers import residual_vectors
from viz.run_page import page_with_diagnosis, report_html

# Steps of the model side by side, the last ones.
_STEPS = 4
_HEIGHT = 980


def notebook_view(run: RunData) -> str:
    """Return HTML for a cell: the screen of report.html in a frame, so that neither styles nor names of a notebook's
    other cells come into it. It asks no server."""
    name, folder = html.escape(run.session.name), getattr(run, "folder", None)
    page = report_html(run) if folder is None else page_with_diagnosis(run, folder / "report.html")
    return (
        f'<iframe srcdoc="{html.escape(page)}" sandbox="allow-scripts" title="{name}" '
        f'style="width: 100%; height: {_HEIGHT}px; border: 0"></iframe>'
    )


def plot(run: RunData, of: str = "part") -> Figure:
    """Return the part at the last steps of the model, coloured by how far its views disagree (µm).

    Of labelled points alone it is the targets as every view puts them.

    Args:
        of: "error": how the error falls from step to step, in place of that.
    """
    history = model_history(run)
    if history is None:
        return _sticks(run)
    if of == "error":
        return error_falling(run, history)
    # Coarse is so far off that all would be red.
    return part_picture(run, history, history.steps[1:][-_STEPS:])


# The longest stick covers this share of the targets' spread.
_SHARE = 0.25
_PLANES = ((0, 1), (0, 2), (1, 2))


def _sticks(run: RunData) -> Figure:
    """Draw each target as seen by every view: magnified sticks from the target's place, in three planes."""
    assert run.targets is not None
    target, residual = residual_vectors(run)
    place, unit = run.targets.landmarks.positions, run.session.length_unit
    size = float(np.nanmax(np.ptp(place[target], axis=0))) or 1.0
    magnified = _SHARE * size / max(float(np.quantile(np.linalg.norm(residual, axis=1), 0.99)), 1e-300)
    figure, planes = subplots(9, 3.4, 1, 3)
    for axes, (a, b) in zip(planes, _PLANES, strict=True):
        ends = np.stack([place[target], place[target] + magnified * residual], axis=1)[:, :, [a, b]]
        axes.add_collection(LineCollection(ends.tolist(), colors=BLUE, linewidths=0.4, alpha=0.35))
        axes.plot(place[:, a], place[:, b], "o", ms=4, color=ORANGE)
        axes.set(aspect="equal", xlabel=f"{'xyz'[a]} ({unit})", ylabel=f"{'xyz'[b]} ({unit})")
    figure.suptitle(f"sticks {magnified:.0f} times longer than they are", fontsize=9)
    return figure
