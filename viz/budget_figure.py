"""Where the error comes from, as bars: the variance budget, or shares of the mean square where there is none."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import NOT_REPEATING, BudgetLine
from stitch.units import MICROMETRES, length_text
from stitch.writing.diagnosis_document import OTHER_SOURCES, largest_error_sources, share_text
from viz.colours import BLUE, DARK, GREEN, ORANGE
from viz.drawing import above, plain

# What kinds of sources are called beside the bars, and their colours.
_MISSING, _CORRECTED, _REPEATS, _CHANCE = (
    ("named above as missing", ORANGE),
    ("in the model, corrected", GREEN),
    ("repeats, without a name", BLUE),
    ("noise, scatter and the scanner", DARK),
)


def budget(found: Diagnosis, length_unit: str) -> Figure:
    """A bar for each source of what the poses leave, in per cent of the variance, with its size beside it."""
    told = largest_error_sources(found.budget)
    if not told:
        return mean_squares(found, length_unit)
    figure = Figure(figsize=(7, 0.95 + 0.3 * len(told)), layout=ConstrainedLayoutEngine(w_pad=0.12))
    axes = figure.subplots()
    kinds = [_kind(found, line) for line in told]
    shares = [100 * line.variance_share for line in told]
    axes.barh([line.source for line in told], shares, color=[colour for _, colour in kinds], height=0.7)
    for k, line in enumerate(told):
        words = f"{share_text(line)}, {length_text(line.sigma, length_unit, 2)}"
        axes.text(shares[k] + 0.02 * max(shares), k, words, va="center", fontsize=9)
    axes.invert_yaxis()
    # Room for the words beside the longest bar.
    axes.set(xlim=(0, 1.3 * max(shares)), xlabel="share of the variance (%)")
    axes.set_xticks([at for at in axes.get_xticks() if 0 <= at <= min(100, 1.3 * max(shares))])
    axes.tick_params(axis="y", length=0)
    shown = [Patch(color=colour, label=name) for name, colour in dict.fromkeys(kinds)]
    place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 2, "frameon": False, "fontsize": 9}
    axes.legend(handles=shown, **place)
    return plain(figure)


def _kind(found: Diagnosis, line: BudgetLine) -> tuple[str, str]:
    """What a source is called in the legend, and its colour."""
    if line.source in found.effects:
        return _MISSING
    if line.source in {term.name for term in found.linear.model.terms}:
        return _CORRECTED
    return _CHANCE if line.source in (*NOT_REPEATING, OTHER_SOURCES) else _REPEATS


def mean_squares(found: Diagnosis, length_unit: str) -> Figure:
    """Mean squares between the views: sensor noise, what the named effects explain, the rest."""
    um = MICROMETRES[length_unit]
    total, noise = (found.residual_rms * um) ** 2, (found.noise_floor * um) ** 2
    validations = [s.cross_validation for s in found.candidates if s.name in found.effects]
    share = next((v.inside for v in validations if v is not None), 1.0)
    explained = max(total * (1 - share), 0.0)
    parts = [
        ("sensor noise", min(noise, total), DARK),
        (", ".join(found.effects) or "explained", explained, ORANGE),
        ("scatter of the poses and the rest", max(total - noise - explained, 0.0), BLUE),
    ]
    figure = Figure(figsize=(7, 1.3), layout="constrained")
    axes = figure.subplots()
    start = 0.0
    for name, size, colour in parts:
        if size > 0:
            axes.barh([0], [size / total * 100], left=[start], color=colour, label=name)
            start += size / total * 100
    axes.set_yticks([])
    axes.set_xlabel(f"share of the mean square, {np.sqrt(total):.1f} µm rms (%)")
    above(axes)
    return plain(figure)
