"""The timeline `model` of a recording: the part fades, the scans move and the bars fall from step to step of the model.

Step k stands at 10·k; between two steps colours and places run over evenly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.disagreement_field import full_colour_distance
from stitch.output.comparison.model_history import ModelHistory, ModelStep
from stitch.run_data import RunData
from stitch.session.scan import even_indices
from stitch.system.threads import take_mapped
from viz.colours import COLOURS_OF_FEW, GREY, unsigned_colours
from viz.part_surface import PartSurface
from viz.rrd_file import words
from viz.run_numbers import shown_points

# What the timeline `model` of a recording shows: the part, where every step puts the views, and what is magnified.

# Views whose scans are shown displaced: those farthest off under the first model.
_FEW = 4
# The largest displacement is shown as this share of the part's size.
_SHOWN_SHARE = 0.08


@dataclass(frozen=True)
class ModelScene:
    """The steps ready to be drawn; V views. Lengths in length_unit."""

    history: ModelHistory
    surface: PartSurface
    names: tuple[str, ...]
    um: float
    limit: float  # full colour of the field
    centre: Array  # (3,) of the part
    twists: Array  # (S, V, 6) about the centre: from where register puts a view to where the step puts it
    magnified: Array  # (S,)
    farthest: tuple[int, ...]  # views that are off most under the first model
    cell: Array  # (N, 3) some points of the cell, base frame

    def title(self, step: ModelStep) -> str:
        """Name of a step and how far the views disagree there."""
        return f"{step.name}: views disagree by {length_text(step.field.mean_abs * self.um / 1e3, 'mm')} on average"


def model_scene(run: RunData, history: ModelHistory, surface: PartSurface, cell: Array) -> ModelScene:
    """Return the poses of the views at every step, and the magnification that makes them visible."""
    centre = surface.vertices.mean(axis=0)
    to_centre = frames.make(np.eye(3), -centre)
    at_rest = frames.inverse(to_centre @ history.steps[-1].poses)
    twists = np.array([frames.log(to_centre @ s.poses @ at_rest) for s in history.steps])
    # A motion that all views share moves the part, and nothing against anything.
    twists -= twists.mean(axis=1, keepdims=True)
    size = float(np.ptp(surface.vertices, axis=0).max())
    far = np.linalg.norm(twists[..., 3:], axis=2) + 0.3 * size * np.linalg.norm(twists[..., :3], axis=2)
    first = history.models[0].field
    models = np.array([size * _SHOWN_SHARE / max(x, 1e-12) for x in far.max(axis=1)])
    # One factor for all that is fitted, its own for the coarse step, which is so much farther off.
    factors = np.array([_round(models[0]), *[_round(models[1:-1].min())] * (len(models) - 1)])
    return ModelScene(
        history=history,
        surface=surface,
        names=tuple(run.session.names),
        um=MICROMETRES[run.session.length_unit],
        limit=full_colour_distance(first, run.session),
        centre=centre,
        twists=twists,
        magnified=factors,
        farthest=tuple(int(v) for v in np.argsort(-mean_sizes(first.values), kind="stable")[:_FEW]),
        cell=cell,
    )


def shown_steps(history: ModelHistory) -> tuple[ModelStep, ModelStep]:
    """Before and after: the first model and the last, or the only one and register."""
    models = history.models
    return models[0], models[-1] if len(models) > 1 else history.steps[-1]


def mean_sizes(values: Array) -> Array:
    """(V,) mean size of the values (V, K) that are known; 0 where none is."""
    known = np.isfinite(values)
    return np.where(known, np.abs(np.nan_to_num(values)), 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)


def _round(factor: float) -> float:
    """The next smaller of 1, 2, 5, 10, …"""
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(x * power for x in (1, 2, 5) if x * power <= factor * (1 + 1e-9)))


FRAMES = 10  # of the timeline from one step to the next
_BETWEEN = 2  # frames between two that are kept
# What a screen can show; the run folder keeps everything.
_POINTS, _STILL = 5_000, 15_000
_THICK = rr.Radius.ui_points(3.0)
_BAR = (244, 114, 43)
# Share of a view's points whose middle carries its name.
_NAMED = 0.02


def log_model(
    recording: rr.RecordingStream, run: RunData, scene: ModelScene, up: Array, reached: dict[int, int]
) -> None:
    """Everything that stands still, and all frames of the timeline.

    Args:
        up: (3,) of the picture, reference frame.
        reached: by step, where the timeline `iteration` has it.
    """
    for name in ("now", "before", "after"):
        _log_part(recording, f"part/{name}", scene)
    before, after = shown_steps(scene.history)
    for name, step in (("before", before), ("after", after)):
        recording.log(f"part/{name}", _colours(scene, step.field.overall), static=True)
    rest = take_mapped(run.fused.points, even_indices(len(run.fused.points), _STILL))
    recording.log("stitched", rr.Points3D(rest.astype(np.float32), colors=[GREY]), static=True)
    at_rest = [frames.transform(run.poses[v], shown_points(run.session.views[v])) for v in scene.farthest]
    for v, own, colour in zip(scene.farthest, at_rest, COLOURS_OF_FEW, strict=False):
        points = own[np.linspace(0, len(own) - 1, min(len(own), _POINTS)).astype(int)] - scene.centre
        shown = rr.Points3D(points.astype(np.float32), colors=[colour])
        recording.log(["scans", scene.names[v]], shown, static=True)
    places = one_above_the_other(at_rest, up)
    first = mean_sizes(scene.history.models[0].field.values) * scene.um
    recording.log("bars/first", rr.BarChart(first, color=GREY), static=True)
    for frame in range(0, FRAMES * (len(scene.history.steps) - 1) + 1, _BETWEEN):
        recording.set_time("model", sequence=frame)
        if frame % FRAMES == 0 and frame // FRAMES in reached:
            recording.set_time("iteration", sequence=reached[frame // FRAMES])
        _log_frame(recording, scene, frame / FRAMES, places)
        recording.reset_time()


def one_above_the_other(views: Sequence[Array], up: Array) -> Array:
    """(F, 3) a place on each of F views (N, 3), at equal distances along `up`: so no name covers another."""
    heights = [points @ up for points in views]
    low, high = min(h.min() for h in heights), max(h.max() for h in heights)
    places = np.empty((len(views), 3))
    for rank, v in enumerate(np.argsort([h.mean() for h in heights], kind="stable")):
        away = np.abs(heights[v] - (low + (rank + 0.5) / len(views) * (high - low)))
        places[v] = views[v][away <= np.quantile(away, _NAMED)].mean(axis=0)
    return places


def _log_frame(recording: rr.RecordingStream, scene: ModelScene, at: float, places: Array) -> None:
    """A moment between two steps: their values in proportion; `places` (F, 3) carry the names of the farthest."""
    steps, k = scene.history.steps, min(int(at), len(scene.history.steps) - 2)
    share = at - k
    one, other = steps[k].field, steps[k + 1].field
    recording.log("part/now", _colours(scene, (1 - share) * one.overall + share * other.overall))
    moved = (1 - share) * scene.magnified[k] * scene.twists[k] + share * scene.magnified[k + 1] * scene.twists[k + 1]
    T = frames.exp(moved)
    for v in scene.farthest:
        placed = rr.Transform3D(translation=T[v, :3, 3] + scene.centre, mat3x3=T[v, :3, :3])
        recording.log(["scans", scene.names[v]], placed)
    few, from_centre = list(scene.farthest), places - scene.centre
    ends = np.einsum("vij,vj->vi", T[few, :3, :3], from_centre) + T[few, :3, 3]
    arrows = rr.Arrows3D(
        origins=places,
        vectors=ends - from_centre,
        labels=[scene.names[v] for v in few],
        # Lighter than the points on which name and arrow stand.
        colors=[tuple((c + 255) // 2 for c in colour) for colour in COLOURS_OF_FEW[: len(few)]],
        radii=_THICK,
        show_labels=True,
    )
    recording.log("displacements", arrows)
    means = mean_sizes((1 - share) * one.values + share * other.values) * scene.um
    recording.log("bars/views", rr.BarChart(means, color=_BAR))
    recording.log("now", words(_told(scene, k, share)))


def _told(scene: ModelScene, k: int, share: float) -> str:
    """Describe the picture at a step, or on the way from step k to the next."""
    steps = scene.history.steps
    if 0 < share < 1:
        told = "Nothing is fitted in between: colours, places and bars are drawn in proportion."
        return f"## {steps[k].name} → {steps[k + 1].name}\n{100 * share:.0f} % of the way. {told}"
    now = k + round(share)
    first = scene.history.models[0].name
    shown = f"Bars: the views in their order, from 0; behind them in grey those of {first}, darker where a view is "
    shown += "farther off than there."
    return f"## {steps[now].name}\n{scene.title(steps[now]).partition(': ')[2]}.\n\n{shown}"


def _log_part(recording: rr.RecordingStream, path: str, scene: ModelScene) -> None:
    s = scene.surface
    if len(s.triangles):
        mesh = rr.Mesh3D.from_fields(
            vertex_positions=s.vertices.astype(np.float32),
            vertex_normals=s.normals.astype(np.float32),
            triangle_indices=s.triangles.astype(np.uint32),
        )
        recording.log(path, mesh, static=True)
    else:
        recording.log(path, rr.Points3D.from_fields(positions=s.vertices.astype(np.float32)), static=True)


def _colours(scene: ModelScene, values: Array) -> rr.Mesh3D | rr.Points3D:
    colours = unsigned_colours(scene.surface.coloured(values), scene.limit)
    if len(scene.surface.triangles):
        return rr.Mesh3D.from_fields(vertex_colors=colours)
    return rr.Points3D.from_fields(colors=colours)
