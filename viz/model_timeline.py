"""What the model does at every moment of a recording: the part fades, the scans move and the bars fall.

Where a moment is a step of the model's history, its field is that of the history; else it is computed from where the
moment has the views.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import rerun as rr

from stitch.model.forward import true_geometry
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, length_text
from stitch.observations.surfaces.matching import Match, signed_distances
from stitch.output.comparison.disagreement_field import DisagreementField, full_colour_distance
from stitch.output.comparison.model_history import ModelHistory, ModelStep
from stitch.run_data import RunData
from stitch.session.scan import even_indices
from stitch.system.threads import parallel, take_mapped
from viz.colours import COLOURS_OF_FEW, GREY, unsigned_colours
from viz.part_surface import PartSurface
from viz.rrd_file import words
from viz.run_numbers import shown_points

# Views whose scans are shown displaced: those farthest off under the first model.
_FEW = 4
# The largest displacement is shown as this share of the part's size.
_SHOWN_SHARE = 0.08
# What would be shown farther off than this share is an earlier stage, to be magnified less.
_FARTHEST = 0.5


@dataclass(frozen=True)
class ModelScene:
    """The steps ready to be drawn; V views. Lengths in length_unit."""

    history: ModelHistory
    surface: PartSurface
    names: tuple[str, ...]
    um: float
    limit: float  # full colour of the field
    centre: Array  # (3,) of the part
    at_rest: Array  # (V, 4, 4) about the centre, where register puts the views
    coarse: float  # how many times farther than they are views are displaced at the coarse hand-eye
    fitted: float  # and afterwards
    farthest: tuple[int, ...]  # views that are off most under the first model
    cell: Array  # (N, 3) some points of the cell, base frame

    def title(self, step: ModelStep) -> str:
        """Name of a step and how far the views disagree there."""
        return f"{step.name}: views disagree by {length_text(step.field.mean_abs * self.um / 1e3, 'mm')} on average"


def model_scene(run: RunData, history: ModelHistory, surface: PartSurface, cell: Array) -> ModelScene:
    """Return what all moments share, and the magnification that makes the motions of the views visible."""
    centre = surface.vertices.mean(axis=0)
    at_rest = frames.make(np.eye(3), -centre) @ history.steps[-1].poses
    size = float(np.ptp(surface.vertices, axis=0).max())
    far = []
    for step in history.steps[:-1]:
        twists = _twists(step.poses, at_rest, centre)
        moved = np.linalg.norm(twists[:, 3:], axis=1) + 0.3 * size * np.linalg.norm(twists[:, :3], axis=1)
        far.append(size * _SHOWN_SHARE / max(float(moved.max()), 1e-12))
    first = history.models[0].field
    return ModelScene(
        history=history,
        surface=surface,
        names=tuple(run.session.names),
        um=MICROMETRES[run.session.length_unit],
        limit=full_colour_distance(first, run.session),
        centre=centre,
        at_rest=at_rest,
        # One factor for all that is fitted, its own for the coarse step, which is so much farther off.
        coarse=_round(far[0]),
        fitted=_round(min(far[1:])),
        farthest=tuple(int(v) for v in np.argsort(-mean_sizes(first.values), kind="stable")[:_FEW]),
        cell=cell,
    )


def factor_of(scene: ModelScene, poses: Array) -> float:
    """Return how many times farther than it is the motion of views at poses (V, 4, 4) is shown: less where they are as
    far off as at the coarse hand-eye."""
    moved = displaced(scene, poses, scene.fitted)[:, :3, 3]
    size = float(np.ptp(scene.surface.vertices, axis=0).max())
    return scene.fitted if np.linalg.norm(moved, axis=1).max() < _FARTHEST * size else scene.coarse


def displaced(scene: ModelScene, poses: Array, factor: float) -> Array:
    """Return (V, 4, 4) by which views that register has put in place move where poses (V, 4, 4) put them, so many times
    as far; about the part's centre, less what all views share."""
    return frames.exp(factor * _twists(poses, scene.at_rest, scene.centre))


def _twists(poses: Array, at_rest: Array, centre: Array) -> Array:
    """Return (V, 6) from where register puts the views to poses (V, 4, 4), about a centre."""
    twists = frames.log(frames.make(np.eye(3), -centre) @ poses @ frames.inverse(at_rest))
    # A motion that all views share moves the part, and nothing against anything.
    return twists - twists.mean(axis=0, keepdims=True)


class Shown(NamedTuple):
    """One moment as the model's pictures have it."""

    at: int  # on the timeline
    title: str
    poses: Array  # (V, 4, 4) T_reference_scanner
    factor: float  # by which motions are magnified
    step: int | None  # of the history


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


# What a screen can show; the run folder keeps everything.
_POINTS, _STILL = 5_000, 15_000
_THICK = rr.Radius.ui_points(3.0)
_BAR = (244, 114, 43)
# Share of a view's points whose middle carries its name.
_NAMED = 0.02


def log_model(
    recording: rr.RecordingStream, run: RunData, scene: ModelScene, up: Array, shown: Sequence[Shown]
) -> None:
    """Everything that stands still, and what every moment shows.

    Args:
        up: (3,) of the picture, reference frame.
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
        points = own[even_indices(len(own), _POINTS)] - scene.centre
        scan = rr.Points3D(points.astype(np.float32), colors=[colour])
        recording.log(["scans", scene.names[v]], scan, static=True)
    places = one_above_the_other(at_rest, up)
    first = mean_sizes(scene.history.models[0].field.values) * scene.um
    recording.log("bars/first", rr.BarChart(first, color=GREY), static=True)
    assert run.registered is not None
    # Effects of the scanner move points by micrometres: those of the present model.
    points = true_geometry(run.measurement, run.model)[1]
    fields = parallel(partial(_field_at, scene.history, run.registered.matches, points), shown)
    for moment, field in zip(shown, fields, strict=True):
        recording.set_time("iteration", sequence=moment.at)
        _log_moment(recording, scene, moment, field, places)
        recording.reset_time()


def _field_at(
    history: ModelHistory, matches: Sequence[Match], points: Sequence[Array], moment: Shown
) -> DisagreementField:
    """The field of a step of the history, or of where a moment has the views.

    Args:
        points: per view (N, 3), scanner frame.
    """
    if moment.step is not None:
        return history.steps[moment.step].field
    return history.patches.field(signed_distances(matches, moment.poses, points))


def one_above_the_other(views: Sequence[Array], up: Array) -> Array:
    """(F, 3) a place on each of F views (N, 3), at equal distances along `up`: so no name covers another."""
    heights = [points @ up for points in views]
    low, high = min(h.min() for h in heights), max(h.max() for h in heights)
    places = np.empty((len(views), 3))
    for rank, v in enumerate(np.argsort([h.mean() for h in heights], kind="stable")):
        away = np.abs(heights[v] - (low + (rank + 0.5) / len(views) * (high - low)))
        places[v] = views[v][away <= np.quantile(away, _NAMED)].mean(axis=0)
    return places


def _log_moment(
    recording: rr.RecordingStream, scene: ModelScene, moment: Shown, field: DisagreementField, places: Array
) -> None:
    """Log one moment with its field; `places` (F, 3) carry the names of the farthest."""
    recording.log("part/now", _colours(scene, field.overall))
    T = displaced(scene, moment.poses, moment.factor)
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
    recording.log("bars/views", rr.BarChart(mean_sizes(field.values) * scene.um, color=_BAR))
    recording.log("now", words(_told(scene, moment, field.mean_abs)))


def _told(scene: ModelScene, moment: Shown, mean: float) -> str:
    """Describe the picture at a moment."""
    first = scene.history.models[0].name
    off = length_text(mean * scene.um / 1e3, "mm")
    shown = f"Bars: the views in their order, from 0; behind them in grey those of {first}, darker where a view is "
    shown += "farther off than there."
    times = f"Scans are displaced {moment.factor:g} times as far." if moment.factor > 1 else ""
    return f"## {moment.title}\nviews disagree by {off} on average. {times}\n\n{shown}"


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
