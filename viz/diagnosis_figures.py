"""Draw the diagnosis: evidence, unnamed errors over joints and time, the scanner's field, the variance budget."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from stitch.comparison.residual_tables import ResidualTable, ResidualTables
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.residual_structure import NOT_REPEATING, BudgetLine
from stitch.diagnosis.unnamed_joint_laws import JointCurve
from stitch.diagnosis.unnamed_time_laws import ROTATION_PART, TRANSLATION_PART, TimeCurve
from stitch.frames import Array
from stitch.observations.pose_errors import time_in_steps
from stitch.observations.surfaces.scanner_errors import FieldMap
from stitch.units import MICROMETRES, length_text
from stitch.writing.diagnosis_document import OTHER_SOURCES, largest_error_sources, share_text
from viz.colours import BLUE, DARK, FIELD, GREEN, ORANGE, SIGNED, above, covariate, plain

_AXES = tuple(zip("xyz", (ORANGE, GREEN, BLUE), strict=True))
_HOURS_FROM = 7200.0  # s that are better told in hours than in minutes


def joint_courses(found: Diagnosis, at_most: int = 3) -> Figure:
    """Draw the errors of joints that match no effect along what they follow, with two sigmas."""
    shown = found.curves[:at_most]
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for ax, c in zip(axes, shown, strict=False):
        error, sigma = 1e3 * c.error, 1e3 * c.sigma
        label, at, stood = _along(c)
        ax.fill_between(at, error - 2 * sigma, error + 2 * sigma, color=BLUE, alpha=0.25, lw=0)
        ax.plot(at, error, color=BLUE)
        ax.plot(stood, np.zeros(len(stood)), "|", color="k", ms=8)
        ax.axhline(0, color="k", lw=0.6)
        ax.set_title(f"{c.share:.0%} of what it does", fontsize=9)
        ax.set(xlabel=label, ylabel=f"joint {c.joint} off by (mrad)")
    return plain(figure)


def _along(c: JointCurve) -> tuple[str, Array, Array]:
    """The axis of a joint's course, where the course is told and where the views stood along it."""
    if c.covariate != "time_s":
        return covariate(c.covariate), c.at, c.view_values
    first = float(c.view_values.min())
    unit, of_second = _unit_of(float(np.ptp(c.view_values)))
    return unit, (c.at - first) * of_second, (c.view_values - first) * of_second


def time_course(found: Diagnosis, curve: TimeCurve, length_unit: str) -> Figure:
    """Draw rotation and displacement of the flange in time along its own axes, with two sigmas."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    unit, of_step = _times(curve)
    stood = time_in_steps(found.linear.measurement)
    for ax, of, factor in ((axes[0], ROTATION_PART, 1e3), (axes[1], TRANSLATION_PART, MICROMETRES[length_unit])):
        _banded(ax, (curve.steps - curve.steps[0]) * of_step, factor * curve.error[:, of], factor * curve.sigma[:, of])
        ax.plot((stood - stood.min()) * of_step, np.zeros(len(stood)), "|", color="k", ms=8)
        ax.axhline(0, color="k", lw=0.6)
    axes[0].set_ylabel("turned (mrad)")
    axes[1].set(ylabel="moved (µm)", xlabel=unit)
    above(axes[0])
    return plain(figure)


def _times(curve: TimeCurve) -> tuple[str, float]:
    """Return the label of the time axis and its units per step."""
    if not curve.seconds:
        return "view", 1.0
    unit, of_second = _unit_of(curve.seconds * float(np.ptp(curve.steps)))
    return unit, curve.seconds * of_second


def _unit_of(whole: float) -> tuple[str, float]:
    """Return the unit of time for a session of so many seconds, and its units per second."""
    return ("hours", 1 / 3600) if whole > _HOURS_FROM else ("minutes", 1 / 60)


def _banded(ax: Axes, time: Array, error: Array, sigma: Array) -> None:
    """One line with its band for each axis of the flange."""
    for k, (name, colour) in enumerate(_AXES):
        ax.fill_between(
            time, error[:, k] - 2 * sigma[:, k], error[:, k] + 2 * sigma[:, k], color=colour, alpha=0.18, lw=0
        )
        ax.plot(time, error[:, k], color=colour, label=f"axis {name}")


_NO_POINTS = "#d0d3d7"


def scanner_field(found: FieldMap, length_unit: str) -> Figure:
    """Error along the ray (µm) by the direction of the ray, blue too near, red too far; beside it its sigma."""
    um = MICROMETRES[length_unit]
    # As high as the field is beside its width, so that little is empty around the maps.
    across, down = (np.ptp(np.degrees(np.arctan(way))) for way in (found.x, found.y))
    figure = Figure(figsize=(7.4, 1.8 + 3.2 * float(np.clip(down / across, 0.4, 1.6))), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    limit = float(np.nanmax(np.abs(found.error))) * um
    _map(
        left,
        found,
        found.error * um,
        (-limit, limit),
        SIGNED,
        "error along the ray (µm)\nblue: seen too near, red: too far",
    )
    highest = float(np.nanmax(found.sigma)) * um
    _map(right, found, found.sigma * um, (0, highest), FIELD, "standard uncertainty of it (µm)\n")
    left.set_ylabel("direction along the scanner's y (°)")
    return figure


def _map(axes: Axes, found: FieldMap, values: Array, limits: tuple[float, float], colours: str, label: str) -> None:
    """One map of values (Y, X), grey where there are none."""
    x, y = (np.degrees(np.arctan(_edges(way))) for way in (found.x, found.y))
    axes.set_facecolor(_NO_POINTS)
    image = axes.pcolormesh(x, y, np.ma.masked_invalid(values), cmap=colormaps[colours], vmin=limits[0], vmax=limits[1])
    image.set_rasterized(True)
    axes.set_aspect("equal")
    axes.set_xlabel("direction along the scanner's x (°)")
    axes.figure.colorbar(image, ax=axes, location="top", label=label, shrink=0.9)


def _edges(places: Array) -> Array:
    """(n + 1,) half-way between places (n,) at equal distances."""
    step = places[1] - places[0]
    return np.append(places, places[-1] + step) - step / 2


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
    """Return name and colour of a source in the legend."""
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


def comparison(found: ResidualTables, length_unit: str, at_most: int = 9) -> Figure:
    """Signed mean of the distance between the views against the clearest properties, with ± 2 sigma."""
    um = MICROMETRES[length_unit]
    shown = found.places[:at_most]
    rows = -(-len(shown) // 3)
    figure = Figure(figsize=(9, 2.1 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, 3, squeeze=False)).ravel()
    for ax, table in zip(axes, shown, strict=False):
        _against(ax, table, um)
    for ax in axes[len(shown) :]:
        ax.axis("off")
    for ax in axes[::3]:
        ax.set_ylabel("mean (µm)")
    return plain(figure)


def _against(ax: Axes, table: ResidualTable, um: float) -> None:
    x = (table.low + table.high) / 2
    ax.errorbar(x, table.mean * um, 2 * table.mean_sigma * um, color=BLUE, marker="o", ms=3, lw=1, capsize=2)
    ax.axhline(0, color="k", lw=0.6)
    ax.set_xlabel(f"{table.name}{f' ({table.unit})' if table.unit else ''}", fontsize=8)
    ax.tick_params(labelsize=7)


# More names of views than these cannot be read along an axis.
_NAMED = 40


def candidates(found: Diagnosis) -> Figure:
    """Log Bayes factors of the best candidate effects, named ones in orange."""
    shown = [s for s in found.candidates if s.ranked.score.observable][:8][::-1]
    figure = Figure(figsize=(7, 0.4 + 0.3 * max(len(shown), 1)), layout="constrained")
    axes = figure.subplots()
    colours = [ORANGE if s.name in found.effects else BLUE for s in shown]
    axes.barh([s.name for s in shown], [s.ranked.score.log_bayes_factor for s in shown], color=colours)
    axes.axvline(0, color="k", lw=0.8)
    axes.set_xlabel('log Bayes factor over "nothing is missing"')
    return plain(figure)


def added_variable(found: Diagnosis, at_most: int = 3) -> Figure | None:
    """Draw observed against predicted numbers of each candidate effect, hand-eye and model taken out of both.

    Points are numbers of the pose channel in units of their scatter; a straight line through zero of slope 1
    is an effect that is there as fitted. None where no candidate effect explains anything.
    """
    # Of candidates that gain nothing no amplitude was fitted.
    shown = [s for s in found.candidates if s.ranked.score.observable and s.ranked.score.p_value < 1.0][:at_most]
    if not shown:
        return None
    figure = Figure(figsize=(7, 3.0), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for ax, candidate in zip(axes, shown, strict=True):
        _added(ax, found, candidate)
    reach = 1.08 * max(float(np.abs(ax.dataLim.get_points()).max()) for ax in axes)
    for ax in axes:
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1)
    axes[0].set_ylabel("seen (sigma)")
    return plain(figure)


def _added(ax: Axes, found: Diagnosis, candidate: CandidateEffect) -> None:
    s = candidate.ranked.score
    # Among what every arm may do wrong the effect itself would count as scatter.
    linear = s.base_model or found.linear
    predicted = linear.residual(s.form.columns) @ s.values
    ax.scatter(predicted, linear.white_residual, s=6, color=BLUE, alpha=0.7, lw=0)
    ax.axline((0, 0), slope=1, color=ORANGE, lw=1)
    ax.set_title(f"{candidate.name}, p = {candidate.ranked.adjusted:.1g}", fontsize=9)
    ax.set_xlabel("predicted (sigma)")


def alias_picture(found: Diagnosis, at_most: int = 12) -> Figure:
    """Draw the share of each candidate effect's pattern that the others can imitate."""
    keep = [k for k, s in enumerate(found.candidates) if s.ranked.score.observable][:at_most]
    names = [found.candidates[k].name for k in keep]
    figure = Figure(figsize=(7, 5.6), layout="constrained")
    axes = figure.subplots()
    matrix = found.matrix[np.ix_(keep, keep)]
    image = axes.imshow(matrix, vmin=0, vmax=1, cmap="Blues")
    for i, j in np.argwhere(matrix >= 0.5):
        colour = "w" if matrix[i, j] > 0.6 else "k"
        axes.text(j, i, f"{matrix[i, j]:.2f}", ha="center", va="center", fontsize=6.5, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlabel("… can be imitated by")
    axes.set_ylabel("what this effect does …")
    figure.colorbar(image, label="correlation", shrink=0.7)
    return figure


def shape(found: Diagnosis, length_unit: str, at_most: int = 3) -> Figure:
    """Unexplained displacement of the views against the covariates that they follow most."""
    um = MICROMETRES[length_unit]
    shown = found.depends_on[:at_most]
    figure = Figure(figsize=(7, 2.5), layout="constrained")
    axes = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for ax, d in zip(axes, shown, strict=False):
        ax.errorbar(d.bins, d.mean * um, 2 * d.sigma * um, color=BLUE, marker="o", ms=4, lw=1, capsize=2)
        ax.axhline(0, color="k", lw=0.6)
        ax.set_title(f"p = {d.p_value:.1g}" + ("" if d.p_value < 0.05 else ": chance"), fontsize=9)
        ax.set_xlabel(covariate(d.covariate))
    axes[0].set_ylabel("displaced (µm)")
    return plain(figure)


def view_arrows(found: Diagnosis, length_unit: str) -> Figure:
    """Draw the distance of every view from its place under the model."""
    um = MICROMETRES[length_unit]
    moved = found.linear.view_displacements() * um
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots()
    for i, (axis, colour, marker) in enumerate(zip("xyz", (ORANGE, GREEN, BLUE), "osv", strict=True)):
        axes.plot(moved[:, i], marker=marker, ms=4, lw=0.8, color=colour, label=axis)
    axes.axhline(0, color="k", lw=0.6)
    names = [scan.name for scan in found.linear.measurement.capture.scans]
    if 0 < len(names) <= _NAMED:
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_ylabel("displaced (µm)")
    above(axes)
    return plain(figure)
