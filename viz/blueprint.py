"""Lay out the viewer: before and after side by side, the model's history and the cell on further tabs."""

import os

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from stitch.numerics.frames import Array
from viz.colours import UNSEEN, unsigned_colours
from viz.course_recording import WHERE, X_RANGE, Y_RANGE
from viz.model_timeline import ModelScene, shown_steps
from viz.part_surface import Camera

os.environ.setdefault("RERUN_ANALYTICS", "off")

_LENGTH, _HEIGHT = 256, 14
# All of it with its words, which are as large in any window.
WIDE, HIGH = (-28.0, _LENGTH + 44.0), (-4.0, _HEIGHT + 54.0)


def log_colour_bar(recording: rr.RecordingStream, path: str, ticks: list[str], grey: str) -> None:
    """The colours of the field with labels at equal distances below them, and below these what grey means."""
    row = unsigned_colours(np.linspace(0, 1, _LENGTH), 1.0)
    recording.log(f"{path}/colours", rr.Image(np.tile(row, (_HEIGHT, 1, 1))), static=True)
    places = np.column_stack([np.linspace(0, _LENGTH, len(ticks)), np.full(len(ticks), _HEIGHT + 6.0)])
    marks = rr.Points2D(places, labels=ticks, radii=0.4, colors=[(128, 128, 128)], show_labels=True)
    recording.log(f"{path}/ticks", marks, static=True)
    below = [(_LENGTH / 2, _HEIGHT + 27.0)]
    unseen = rr.Points2D(below, labels=[f"grey: {grey}"], radii=0.4, colors=[UNSEEN], show_labels=True)
    recording.log(f"{path}/grey", unseen, static=True)


# Tangent of half the viewer's field, 55 degrees high, with a margin.
_HIGH = 0.47


def eye_for(points: Array, axes: Array, up: Array, aspect: float) -> rrb.EyeControls3D:
    """The nearest eye that sees all points (N, 3).

    Args:
        axes: (3, 3) rows right, up, and from the points to the eye: unit vectors.
        up: (3,) about which the picture is turned.
        aspect: width of the window over its height.
    """
    middle, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.array([aspect * _HIGH, _HIGH])
    for _ in range(4):
        x, y, z = axes @ (points - middle).T
        away = float(np.max(z + np.maximum(np.abs(x) / half[0], np.abs(y) / half[1])))
        seen = np.array([x, y]) / (away - z)
        middle = middle + 0.5 * away * (seen.min(axis=1) + seen.max(axis=1)) @ axes[:2]
    return rrb.EyeControls3D(position=middle + away * axes[2], look_target=middle, eye_up=up)


# Width over height, in an ordinary window, of a picture of the part, of all scans and of the cell.
_OF_PART, _OF_CLOUDS, _OF_CELL = 0.68, 1.0, 1.5
_GROUND = [24, 27, 31]
_COS, _SIN = np.cos(np.radians(35.0)), np.sin(np.radians(35.0))


def model_blueprint(scene: ModelScene, camera: Camera, raw: Array, moments: int) -> rrb.Blueprint:
    """Before and after, and why | the model step by step | every iteration | what is missing | the cell.

    It plays from the coarse hand-eye on: where it stands, something shows.

    Args:
        raw: (N, 3) places that the raw scans take, reference frame.
        moments: their number.
    """
    before, after = shown_steps(scene.history)
    # The same eye for all views of the part.
    eye = eye_for(scene.surface.vertices, camera.axes, camera.up, _OF_PART)
    unit = "" if len(scene.history.models) > 1 else " (single views moved)"
    parts = rrb.Horizontal(
        _scene("part/before", scene.title(before), eye),
        _scene("part/after", scene.title(after) + unit, eye),
        rrb.Vertical(
            _missing(),
            rrb.TextDocumentView(origin="verdict", name="What the run found"),
            _colour_bar(),
            row_shares=[12, 13, 5],
        ),
        column_shares=[3, 3, 2],
    )
    compare = rrb.Vertical(parts, _why(), row_shares=[5, 2], name="Before | after")
    steps = rrb.Horizontal(
        _scene("part/now", f"Where the views disagree; full colour at {scene.limit * scene.um:.3g} µm", eye),
        _scene(
            "/",
            f"Views farthest off, displaced {scene.fitted:g} times as far (coarse: {scene.coarse:g})",
            eye,
            ["stitched", "scans/**", "displacements"],
        ),
        rrb.Vertical(
            rrb.TextDocumentView(origin="now", name="Step of the model"),
            _bars("bars", "Each view off the others (µm)", "bars/first", "bars/views"),
            _colour_bar(),
            row_shares=[6, 10, 3],
        ),
        column_shares=[3, 3, 2],
        name="The model, step by step",
    )
    time = rrb.TimePanel(
        state="collapsed",
        timeline="iteration",
        play_state="playing",
        fps=1.0,
        loop_mode="selection",
        time_selection=rrb.components.AbsoluteTimeRange(min=1, max=moments - 1),
    )
    far = f"{scene.fitted:g} times as far from the stitched part (coarse: {scene.coarse:g})"
    everything = eye_for(np.concatenate([scene.surface.vertices, raw]), camera.axes, camera.up, _OF_CLOUDS)
    tabs = rrb.Tabs(
        compare,
        steps,
        _moments(everything, f"Every scan, {far}; timeline view: as they come"),
        _diagnosis(),
        _cell(scene.cell),
        active_tab=0,
    )
    return rrb.Blueprint(tabs, time, collapse_panels=True)


def target_blueprint(cell: Array) -> rrb.Blueprint:
    """Targets, what was found and why | every iteration | what is missing | the cell (points, (N, 3))."""
    targets = rrb.Horizontal(
        _scene("targets", "Targets by the rms of their views; sticks magnified"),
        rrb.Vertical(
            _missing(),
            rrb.TextDocumentView(origin="verdict", name="What the run found"),
            rrb.TextDocumentView(origin="now", name="Sticks"),
            row_shares=[5, 6, 2],
        ),
        column_shares=[3, 2],
    )
    result = rrb.Vertical(targets, _why(), row_shares=[5, 2], name="Targets")
    time = rrb.TimePanel(state="collapsed", timeline="iteration", play_state="paused", fps=1.0)
    tabs = rrb.Tabs(
        result,
        _moments(None, "Every target where the run had it (timeline iteration), and as views come (timeline view)"),
        _diagnosis(),
        _cell(cell),
        active_tab=0,
    )
    return rrb.Blueprint(tabs, time, collapse_panels=True)


def _moments(eye: rrb.EyeControls3D | None, name: str) -> rrb.Horizontal:
    """The scans as every iteration has them | what is said of it, and the rms of all."""
    clouds = _scene("/", name, eye, ["views/**", "fused"])
    said = rrb.Vertical(
        rrb.TextDocumentView(origin="moment", name="Here"),
        rrb.TimeSeriesView(
            origin="rms",
            name="rms, powers of ten of a µm: 1 is 10 µm, 2 is 100 µm",
            # The rms falls: there the plot is empty.
            plot_legend=rrb.Corner2D.RightTop,
        ),
        rrb.TextDocumentView(origin="moments", name="All stages and iterations"),
        row_shares=[3, 3, 4],
    )
    return rrb.Horizontal(clouds, said, column_shares=[3, 2], name="Every iteration")


def _scene(
    origin: str,
    name: str,
    eye: rrb.EyeControls3D | None = None,
    contents: list[str] | None = None,
    *,
    grid: bool = False,
) -> rrb.Spatial3DView:
    """A picture in space on the ground of all others; what is below its origin where no contents are given."""
    return rrb.Spatial3DView(
        origin=origin,
        contents=contents or ["$origin/**"],
        name=name,
        eye_controls=eye,
        background=_GROUND,
        line_grid=grid,
    )


def _colour_bar() -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=WIDE, y_range=HIGH)
    return rrb.Spatial2DView(origin="colours/field", name="Views disagree by (µm)", visual_bounds=bounds)


def _bars(origin: str, name: str, *contents: str) -> rrb.BarChartView:
    """Without a legend: it would name paths, and cover bars."""
    legend = rrb.PlotLegend(visible=False)
    return rrb.BarChartView(origin=origin, contents=list(contents) or [origin], name=name, plot_legend=legend)


def _cell(points: Array) -> rrb.Vertical:
    """Everything in the picture, from the side and a little from above."""
    across = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][-1]
    # Turned a little: the shortest way through a cell is often along the scanner's rays.
    across = np.array([[_COS, -_SIN, 0], [_SIN, _COS, 0], [0, 0, 1]]) @ across
    level = np.array([across[0], across[1], 0.0]) / max(float(np.hypot(*across[:2])), 1e-9)
    towards = np.array([level[0], level[1], 0.3]) / np.hypot(1.0, 0.3)
    up = np.array([0.0, 0.0, 1.0])
    aside = np.cross(up, level)
    axes = np.array([aside, np.cross(towards, aside), towards])
    name = "Arm at every view (red or blue: off, as Why measures it), scanner (pyramids), part (points); base frame"
    return rrb.Vertical(_scene("robot", name, eye_for(points, axes, up, _OF_CELL), grid=True), name="The cell")


def _why() -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=X_RANGE, y_range=Y_RANGE)
    name = "Why: dots measured ± 2σ, the line predicted"
    return rrb.Spatial2DView(origin=WHERE, name=name, visual_bounds=bounds, background=_GROUND)


def _missing() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin="diagnosis/plain", name="What is missing")


def _diagnosis() -> rrb.Horizontal:
    """Verdict with candidate effects | their evidence, and where the overlaps put the views."""
    verdict = rrb.TextDocumentView(origin="diagnosis/verdict", name="Verdict and candidate effects, best first")
    evidence = _bars("diagnosis/evidence", "Log Bayes factor of each row of the table: above 0 speaks for the effect")
    moved = _bars("diagnosis/displaced", "Each view, from 0 on, off where the model puts it (µm)")
    return rrb.Horizontal(verdict, rrb.Vertical(evidence, moved), column_shares=[3, 2], name="What is missing")
