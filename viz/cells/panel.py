"""Page and recording of a panel held by several robots: contact points, shape before and after, forces, residuals."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.output.comparison.run_verdict import ToleranceVerdict
from stitch.plugins.cells.panel import PanelJob, PanelResult, leg_sentence, shape_sentence
from stitch.plugins.cells.panel_model import MotionErrors
from viz.cells import stage
from viz.cells.page import Page, Picture, Table, write
from viz.colours import BLUE, DARK, GREEN, ORANGE, SIGNED, YELLOW, signed_colours
from viz.figures import above, colormap, save_figure, subplots
from viz.page_parts import Row


def expected_after(job: PanelJob, result: PanelResult) -> Array:
    """(K,) deviation across the surface, mm, that the commanded twists of the clamps leave at the control points."""
    assert result.shape is not None and job.control is not None
    after = np.zeros(len(job.control.clamp))
    for i, T in enumerate(result.contacts.T_panel_contact):
        beside = job.control.clamp == i
        local = frames.transform(frames.inverse(T), job.control.nominal[beside])
        twist = result.shape.twists[i]
        moved = twist[3:] + np.cross(twist[:3], local)
        after[beside] = -(result.shape.deviations[beside] @ T[:3, 2]) - moved[:, 2]
    return after


def deviation_before(job: PanelJob, result: PanelResult) -> Array:
    """(K,) deviation across the surface, mm, outwards positive: a clamp's z looks into the panel."""
    assert result.shape is not None and job.control is not None
    inward = result.contacts.T_panel_contact[job.control.clamp][:, :3, 2]
    return np.asarray(-np.einsum("ki,ki->k", result.shape.deviations, inward))


def shape(job: PanelJob, result: PanelResult) -> Figure:
    """Control points on the unrolled panel, coloured by their deviation, before and after."""
    assert job.control is not None
    figure, axes = subplots(10.5, 3.5, 1, 2, sharex=True, sharey=True)
    before = deviation_before(job, result)
    limit = max(float(np.abs(before).max()), job.tolerance)
    shown = (("measured", before), ("expected after the correction", expected_after(job, result)))
    for ax, (title, values) in zip(axes, shown, strict=True):
        _draw_panel(ax, job, result)
        at = _unrolled(job, job.control.nominal)
        drawn = ax.scatter(
            *at.T, c=values, s=70, cmap=colormap(SIGNED), vmin=-limit, vmax=limit, edgecolor="0.3", zorder=3
        )
        _write_values(ax, at, values, job.control.clamp)
        ax.set(title=f"{title}: {np.abs(values).max():.2f} mm at most", xlabel="along the panel's axis (mm)")
    axes[0].set_ylabel("around it (mm)")
    figure.colorbar(drawn, ax=axes, label="outside (+) or inside (−) its target (mm)", shrink=0.9)
    return figure


def _write_values(ax: Axes, at: Array, values: Array, clamp: Indices) -> None:
    """Each value on the side of its point that looks away from its clamp."""
    for place, value, i in zip(at, values, clamp, strict=True):
        away = np.sign(place - at[clamp == i].mean(axis=0))
        align = {"ha": "left" if away[0] > 0 else "right", "va": "center"}
        ax.annotate(_signed(value), place, xytext=7 * away * [1, 0], textcoords="offset points", fontsize=7, **align)


def _signed(value: float) -> str:
    """With its sign, which nothing has not."""
    text = f"{value:+.2f}".replace("-", "−")
    return text[1:] if text[1:] == "0.00" else text


def _draw_panel(ax: Axes, job: PanelJob, result: PanelResult) -> None:
    for name, pads in zip(job.robots, result.contacts.pads, strict=True):
        at = _unrolled(job, pads)
        ax.fill(*at.T, facecolor="0.93", edgecolor="0.6")
        aside = at.mean(axis=0) * [0.22, 1.0]
        ax.annotate(name, aside, ha="center", va="center", fontsize=13, color="0.45", weight="bold")
    half = job.layout.length / 2
    ax.set(aspect="equal", xlim=(-half - 330, half + 330))


def _unrolled(job: PanelJob, points: Array) -> Array:
    """(N, 2) along the axis and around it, mm, of points (N, 3) of the panel frame."""
    R = job.layout.radius
    return np.column_stack([points[:, 0], R * np.arctan2(points[:, 1], points[:, 2] + R)])


def forces(job: PanelJob) -> Figure:
    """Size along z and across it at every clamp."""
    assert job.forces is not None
    figure, ax = subplots(7, 2.6)
    place = np.arange(len(job.robots))
    ax.bar(place - 0.2, job.forces[:, 5], 0.38, color=BLUE, label="along z, into the panel")
    ax.bar(place + 0.2, np.linalg.norm(job.forces[:, 3:5], axis=1), 0.38, color=ORANGE, label="in its plane")
    ax.set_xticks(place, job.robots)
    ax.set(ylabel="force (N)", xlabel="clamp")
    ax.axhline(0, color="k", lw=0.6)
    ax.legend(frameon=False)
    return figure


def misfit(job: PanelJob, result: PanelResult) -> Figure:
    """Root mean square of the weighted residuals of each robot."""
    figure, ax = subplots(7, 2.4)
    sizes = [np.sqrt(m.chi_square / m.redundancy) for m in result.models]
    ax.bar(job.robots, sizes, color=GREEN)
    ax.axhline(1.0, color="0.4", ls="--", lw=1, label="tracker's sigma")
    ax.set(ylabel="rms (sigmas)", xlabel="robot")
    above(ax)
    return figure


# Lines that lie upon one another still tell by their marks; nobody has to tell red from green.
_STYLES: list[dict[str, Any]] = [
    {"color": colour, "marker": marker, "ms": 5, "mfc": "none"}
    for colour, marker in zip((BLUE, ORANGE, GREEN, YELLOW, DARK, "black"), "osD^vx", strict=True)
]


def write_pictures(job: PanelJob, result: PanelResult, folder: Path) -> list[str]:
    """Write the errors to expect along a motion as PNG and SVG; returns the files' names."""
    names = ["errors.png", "errors.svg"]
    figure = errors_figure(job.robots, job.master, result.shift_errors, result.turn_errors)
    for name in names:
        save_figure(figure, folder / name, dpi=110)
    return names


def errors_figure(names: Sequence[str], master: int, shift: MotionErrors, turn: MotionErrors) -> Figure:
    """Error against distance and angle, one line per slave: the worst of the three axes."""
    figure, axes = subplots(9, 6, 2, 2, sharex="row", squeeze=False)
    rows = ((shift, shift.steps, "distance moved (mm)"), (turn, np.degrees(turn.steps), "angle turned (°)"))
    for row, (errors, steps, label) in enumerate(rows):
        microns, millidegrees = errors.position * 1e3, np.degrees(errors.angle) * 1e3
        columns = ((microns, "position error (µm)"), (millidegrees, "angle error (0.001°)"))
        for ax, (sizes, size_label) in zip(axes[row], columns, strict=True):
            _draw_slaves(ax, steps, sizes, names, master=master)
            ax.set(xlabel=label, ylabel=size_label)
    axes[0, 0].legend(title=f"slaves of {names[master]}", fontsize="small")
    figure.suptitle("Slave against master, rms expected from the global model's covariance, worst axis")
    return figure


def _draw_slaves(ax: Axes, steps: Array, sizes: Array, names: Sequence[str], *, master: int) -> None:
    """Errors (3, D, N) over D steps, the worst axis of each slave."""
    for i, name in enumerate(names):
        if i != master:
            ax.plot(steps, sizes[:, :, i].max(axis=0), label=name, **_STYLES[i % len(_STYLES)])
    # An error of zero shall look like zero, not like magnified rounding.
    ax.set_ylim(0, max(0.05, 1.05 * sizes.max()))
    if np.allclose(sizes, 0.0, atol=1e-6):
        ax.text(0.5, 0.5, "none: what is only moved does not turn", transform=ax.transAxes, ha="center", color=DARK)
    ax.grid(alpha=0.3)


def shape_figure(names: Sequence[str], steps: Sequence[Array], tolerance: float, forces: Array) -> Figure:
    """Largest deviation at each clamp, step by step (each (N,) mm), and the largest force (steps,) N."""
    figure, (deviations, bars) = subplots(9, 3.6, 1, 2)
    table = np.array(steps)
    for i, name in enumerate(names):
        deviations.plot(range(len(table)), table[:, i], label=name, **_STYLES[i % len(_STYLES)])
    deviations.axhline(tolerance, color="0.4", linestyle="--", label="tolerance")
    deviations.set(xlabel="corrections made", ylabel="largest deviation at the clamp (mm)", xticks=range(len(table)))
    deviations.set_ylim(0, None)
    deviations.legend(fontsize="small", ncols=2)
    bars.bar(range(len(forces)), forces, color=BLUE)
    bars.set(xlabel="corrections made", ylabel="largest change of force (N)", xticks=range(len(forces)))
    return figure


# mm of arrow for a newton, and for a millimetre out of shape, beside a panel of three metres.
_PER_NEWTON, _PER_MM = 4.0, 60.0


def write_page(job: PanelJob, result: PanelResult, path: Path) -> None:
    """Sentence, shape, forces, errors along a motion, residuals of the robots; tables."""
    pictures = []
    if result.shape is not None:
        caption = (
            "The panel unrolled, seen from outside; triangles are the clamps' pads. Colour: how far a control point "
            "stands outside (red) or inside (blue) its target. Right: what the commanded motion of the clamps leaves "
            "if the panel follows them exactly; with three points a clamp that is next to nothing, and what a stiff "
            "panel really leaves the next measurement shows."
        )
        pictures.append(Picture("Shape before and after", shape(job, result), caption))
    if job.forces is not None:
        caption = "Change since the panel was laid on; along z of a clamp, and across it in the panel's plane."
        pictures.append(Picture("Forces at the clamps", forces(job), caption))
    caption = "Reflectors seen by the tracker against the fitted model, every bar one robot; 1 is the tracker's sigma."
    pictures.append(Picture("What the model of each robot leaves", misfit(job, result), caption))
    caption = "What the uncertainty of the model does to the slaves when the master moves."
    figure = errors_figure(job.robots, job.master, result.shift_errors, result.turn_errors)
    pictures.append(Picture("Errors to expect along a motion", figure, caption))
    words = (sentence(job, result), job.file, _about(job))
    tables, notes, light = _tables(job, result), _notes(result), _light(job, result)
    write(Page("Panel held by robots", *words, pictures, tables, notes=notes, light=light), path)


def _light(job: PanelJob, result: PanelResult) -> ToleranceVerdict | None:
    """Return the verdict on the shape against the job's tolerance."""
    if result.shape_largest is None:
        return None
    worst, beyond = float(result.shape_largest.max()), int((result.shape_largest > job.tolerance).sum())
    if not beyond:
        return ToleranceVerdict(
            "good", f"The shape is within {job.tolerance:g} mm at all clamps: {worst:.2f} mm at most."
        )
    return ToleranceVerdict(
        "bad",
        f"The shape is not within {job.tolerance:g} mm at {beyond} of {len(job.robots)} clamps: {worst:.2f} mm at "
        "most, before the commanded motion.",
    )


def _about(job: PanelJob) -> list[Row]:
    readings = sum(own.reflectors.shape[0] * own.reflectors.shape[1] for own in job.calibration)
    control = "" if job.control is None else f", {len(job.control.nominal)} control points of the panel"
    tracker, legs = job.tracker, "" if job.legs is None else " of six legs each"
    return [
        ("Measured", f"{readings:,} readings of reflectors on the robots{control}"),
        ("Arm", f"{len(job.robots)} robots{legs}: {', '.join(job.robots)}; master {job.robots[job.master]}"),
        ("Sensor", f"laser tracker, sigma {tracker.constant * 1e3:g} µm and {tracker.per_length * 1e6:g} µm a metre"),
    ]


def sentence(job: PanelJob, result: PanelResult) -> str:
    """Pose and shape in one."""
    parts = []
    if result.pose_error is not None:
        off, turn = np.linalg.norm(result.pose_error[3:]), np.degrees(np.linalg.norm(result.pose_error[:3]))
        parts.append(f"The panel stands {off:.2f} mm and {turn:.3f}° off its target.")
    if (shape := shape_sentence(job, result)) is not None:
        parts.append(shape)
    return " ".join(parts) or f"{len(job.robots)} robots and the tracker are joined in one model."


def _notes(result: PanelResult) -> list[str]:
    return [leg_sentence(o) for o in result.legs if o.found]


def _tables(job: PanelJob, result: PanelResult) -> list[Table]:
    rows = []
    for model in result.models:
        sigma = np.sqrt(np.diag(model.covariance)).reshape(4, 3).max(axis=1)
        base = " ".join(f"{x:.2f}" for x in model.T_world_base[:3, 3])
        degrees = np.degrees(sigma)
        base_sigma, clamp_sigma = ((f"{sigma[k]:.3f}", f"{degrees[k - 1]:.4f}") for k in (1, 3))
        rows.append((model.name, base, *base_sigma, *clamp_sigma, f"{model.p_value:.2g}"))
    header = ("robot", "base in the world (mm)", "σ (mm)", "σ (°)", "clamp σ (mm)", "σ (°)", "misfit p")
    return [Table("Global model", header, rows)]


def record(job: PanelJob, result: PanelResult, path: Path) -> None:
    """World frame: tracker, robots with flanges and clamps, the panel's control points by deviation, forces."""
    words = "\n\n".join(["# Panel", sentence(job, result), *_notes(result), _LEGEND])
    to_world = job.T_world_target
    with stage.stage(path, "Panel", words) as recording:
        stage.frame(recording, "tracker", frames.make(np.eye(3), job.tracker.position), 300.0)
        stage.frame(recording, "panel", to_world, 300.0)
        stands = result.preposition if job.flanges is None else job.flanges
        for i, (model, T) in enumerate(zip(result.models, stands, strict=True)):
            T_world_flange = model.T_world_base @ T
            stage.frame(recording, f"robots/base {model.name}", model.T_world_base, 250.0)
            stage.frame(recording, f"robots/flange {model.name}", T_world_flange, 120.0)
            _record_legs(recording, job, model.name, model.T_world_base, T_world_flange)
            pads = frames.transform(to_world, result.contacts.pads[i])
            stage.line(recording, f"clamps/{model.name}", pads[[0, 1, 2, 0]], stage.GREY, 6.0)
            if job.forces is not None:
                R = (T_world_flange @ model.T_flange_contact)[:3, :3]
                force = (R @ job.forces[i, 3:])[None] * _PER_NEWTON
                stage.arrows(recording, f"forces/{model.name}", pads.mean(axis=0)[None], force, stage.BLUE, 8.0)
        if result.shape is not None and job.control is not None:
            _record_shape(recording, job, result)


_LEGEND = (
    "Bases with their legs, flanges, clamps as triangles. Control points: red outside, blue inside the target; arrows "
    f"show how far, {_PER_MM:g} times larger, once as measured and once as expected after the correction. Blue arrows "
    f"at the clamps: forces, {_PER_NEWTON:g} mm a newton."
)


def _record_legs(recording: stage.Recording, job: PanelJob, name: str, T_base: Array, T_flange: Array) -> None:
    if job.legs is None:
        return
    feet, ends = frames.transform(T_base, job.legs.base), frames.transform(T_flange, job.legs.platform)
    for name_of, ring in (("foot", feet), ("platform", ends)):
        stage.line(recording, f"robots/{name_of} {name}", np.vstack([ring, ring[:1]]), stage.BLUE, 12.0)
    for k in range(6):
        stage.line(recording, f"robots/legs {name}/{k + 1}", np.array([feet[k], ends[k]]), stage.GREY, 10.0)


def _record_shape(recording: stage.Recording, job: PanelJob, result: PanelResult) -> None:
    assert job.control is not None
    places = frames.transform(job.T_world_target, job.control.nominal)
    outward = -(job.T_world_target @ result.contacts.T_panel_contact[job.control.clamp])[:, :3, 2]
    before = deviation_before(job, result)
    limit = float(np.abs(before).max())
    for name, values in (("before", before), ("after", expected_after(job, result))):
        stage.points(recording, f"shape/{name}", places, signed_colours(values, limit), 25.0)
        arrows = outward * values[:, None] * _PER_MM
        colour = stage.RED if name == "before" else stage.GREEN
        stage.arrows(recording, f"shape/{name}/error", places, arrows, colour, 8.0)
