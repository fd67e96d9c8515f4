"""The timelines `iteration` and `view` of a recording: every scan once, moved by every stage and every iteration.

`iteration` is the one of the run: the raw scans, coarse, each iteration of every model so far, register, and what was
fused. Motions are magnified from where register puts the views. `view` has the stitched scans as they come, one after
another. A recording keeps its moments, so that one that takes its place has those of the models before.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.chunk import RrdReader

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.model_history import COARSE, REGISTER, ModelHistory
from stitch.run_data import RunData, StageResult
from stitch.session.scan import even_indices
from stitch.session.session import SessionData
from stitch.system.threads import take_mapped
from viz.colours import UNSEEN, robust_limit, unsigned_colours, view_colours
from viz.model_timeline import ModelScene, Shown, displaced, factor_of
from viz.page_parts import unbroken
from viz.rrd_file import words
from viz.run_numbers import shown_points

# What the picture begins with holds so many points of every raw scan.
_OF_EYE = 50
# Points of a view, of all views together, and of what was fused; views, evenly over the session.
_OF_VIEW, _OF_ALL, _OF_FUSED, _VIEWS = 10_000, 400_000, 40_000, 400
_CLOUD, _TARGETS = rr.Radius.ui_points(1.3), rr.Radius.ui_points(4.0)
RAW, FUSE, MODEL = "raw", "fuse", "model"
_KEPT = "kept"


@dataclass(frozen=True)
class Moment:
    """One place of the timeline `iteration`: where a stage or an iteration has the views."""

    stage: str  # raw | coarse | model | correct | fit | register | fuse
    title: str
    names: tuple[str, ...]  # of the V views that count there
    poses: Array  # (V, 4, 4) T_reference_scanner
    rms: float = float("nan")  # length_unit
    gate: float = float("nan")  # largest distance between partners, length_unit
    told: str = ""  # what the stage remarks
    step: int | None = None  # of the model's history


class Moments:
    """What a run told of its stages and iterations."""

    def __init__(self) -> None:
        self.sessions: list[SessionData] = []  # with all views, and after each round that left some out
        self.found: list[Moment] = []

    def start(self, session: SessionData) -> None:
        """Keep the views that count from here on."""
        self.sessions.append(session)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Keep one iteration."""
        self._keep(stage, f"{stage}, iteration {index + 1}", poses, rms, gate)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Keep the end of a stage."""
        ended = "" if result.name in (COARSE, FUSE) else " ended"
        self._keep(result.name, f"{result.name}{ended}", poses, result.rms, told=result.remark)

    def _keep(
        self, stage: str, title: str, poses: Array, rms: float, gate: float = float("nan"), told: str = ""
    ) -> None:
        names = tuple(self.sessions[-1].names)
        self.found.append(Moment(stage, title, names, np.array(poses), rms, gate, told))

    def with_models(
        self, run: RunData, history: ModelHistory | None, kept: Sequence[Moment] = ()
    ) -> tuple[Moment, ...]:
        """Return all moments: the raw scans first, those of the models before the present one, and their ends.

        Args:
            kept: of the recording whose place this one takes, where it shows the same views.
        """
        if not self.found:
            return ()
        first, *rest = self.found
        raw = replace(
            first,
            stage=RAW,
            title="raw scans",
            poses=np.broadcast_to(first.poses[0], first.poses.shape),
            rms=float("nan"),
            told="Every scan as the scanner saw it, as if the robot had never left the first view.",
        )
        if history is None:
            return (raw, first, *rest)
        last = {"correct": len(history.steps) - 2, REGISTER: len(history.steps) - 1}
        ends = {moment.stage: i for i, moment in enumerate(rest) if moment.stage in last}
        for stage, i in ends.items():
            rest[i] = replace(rest[i], step=last[stage])
        names = tuple(run.session.names)
        before = [moment for moment in kept if moment.names == names and moment.stage not in (RAW, COARSE)]
        before = [moment for moment in before if moment.step is None or 0 < moment.step < last["correct"]]
        reached = {moment.step for moment in before}
        before += [
            Moment(MODEL, f"model: {step.name}", names, step.poses, step=k)
            for k, step in enumerate(history.steps[1:-2], start=1)
            if k not in reached
        ]
        if before:
            added = history.steps[-2].name
            rest = [replace(moment, title=f"{added}: {moment.title}") if _is_fit(moment) else moment for moment in rest]
        return (raw, replace(first, step=0), *before, *rest)


def _is_fit(moment: Moment) -> bool:
    return moment.stage not in (REGISTER, FUSE)


def keep_moments(rec: rr.RecordingStream, moments: Sequence[Moment]) -> None:
    """Let a recording keep what the next model's recording shows of this one: all but register and what follows it."""
    told = [asdict(moment) | {"poses": moment.poses.tolist()} for moment in moments if _is_fit(moment)]
    rec.log(_KEPT, rr.TextDocument(json.dumps(told)), static=True)


def kept_moments(path: Path) -> list[Moment]:
    """Return the moments that a recording keeps; none where there is none, or it is of another version."""
    if not path.is_file():
        return []
    try:
        for chunk in RrdReader(str(path)).stream():
            if chunk.entity_path == f"/{_KEPT}":
                (text,) = chunk.to_record_batch().column("TextDocument:text").to_pylist()[0]
                rows = json.loads(text)
                return [Moment(**row | {"names": tuple(row["names"]), "poses": np.array(row["poses"])}) for row in rows]
    except (OSError, RuntimeError, ValueError, LookupError, TypeError):
        return []
    return []


def shown_moments(moments: Sequence[Moment], scene: ModelScene) -> list[Shown]:
    """Return the moments that have all views of the scene as the model's pictures show them; raw scans as coarse."""
    shown = []
    for at, moment in enumerate(moments):
        if moment.names != scene.names or moment.stage == FUSE:
            continue
        raw = moment.stage == RAW
        poses, step = (moments[at + 1].poses, 0) if raw else (moment.poses, moment.step)
        shown.append(Shown(at, moment.title, poses, factor_of(scene, poses), step))
    return shown


def log_moments(
    rec: rr.RecordingStream, run: RunData, moments: Sequence[Moment], whole: SessionData, scene: ModelScene | None
) -> Array:
    """Log clouds, their motions, and what is said of them, and return places (N, 3) that the raw scans take.

    Args:
        whole: the session with the views that were left out.
        scene: by which motions are magnified; None: they are shown as they are.
    """
    if not moments:
        return np.zeros((0, 3))
    shown = [whole.names[v] for v in even_indices(len(whole.names), _VIEWS)]
    magnified = [moment.poses if scene is None else _magnified(moment, scene) for moment in moments]
    each = min(_OF_VIEW, _OF_ALL // len(shown))
    _log_clouds(rec, run, whole, shown, each)
    for name in shown:
        _log_motion(rec, name, moments, magnified)
    fused = [i for i, moment in enumerate(moments) if moment.stage == FUSE]
    if fused:
        _log_fused(rec, run, shown, fused[-1])
    _log_words(rec, run, moments, _bound_in_words(run, len(shown), len(whole.names), each))
    _log_rms(rec, run, moments)
    seen = [shown_points(view) for view in whole.views]
    return frames.transform(
        moments[0].poses[0], np.concatenate([points[even_indices(len(points), _OF_EYE)] for points in seen])
    )


def _log_clouds(rec: rr.RecordingStream, run: RunData, whole: SessionData, shown: Sequence[str], each: int) -> None:
    """Every cloud once, in the scanner's frame; grey, and on `iteration` alone, where the view was left out."""
    colours = dict(zip(run.session.names, view_colours(len(run.session.views)), strict=True))
    radius = _CLOUD if whole.has_clouds else _TARGETS
    views = {view.name: view for view in whole.views}
    for name in shown:
        points = shown_points(views[name])
        points = points[even_indices(len(points), each)].astype(np.float32)
        rec.set_time("iteration", sequence=0)
        if name in colours:
            rec.set_time("view", sequence=run.session.names.index(name))
        rec.log(["views", name], rr.Points3D(points, colors=[colours.get(name, UNSEEN)], radii=radius))
        rec.reset_time()
    for v, (name, pose) in enumerate(zip(run.session.names, run.poses, strict=True)):
        if name in shown:
            rec.send_columns(_path(name), [rr.TimeColumn("view", sequence=[v])], _transforms(pose[None]))


def _magnified(moment: Moment, scene: ModelScene) -> Array:
    """Return (V, 4, 4) where a moment's views are shown: their motion magnified."""
    if moment.names != scene.names or moment.stage == RAW:
        return moment.poses
    T = displaced(scene, moment.poses, factor_of(scene, moment.poses))
    return np.asarray(frames.make(np.eye(3), scene.centre) @ T @ scene.at_rest)


def _log_motion(rec: rr.RecordingStream, name: str, moments: Sequence[Moment], magnified: Sequence[Array]) -> None:
    """Where every moment shows a view; nothing from where it was left out."""
    here = [i for i, moment in enumerate(moments) if name in moment.names]
    poses = np.array([magnified[i][moments[i].names.index(name)] for i in here])
    rec.send_columns(_path(name), [rr.TimeColumn("iteration", sequence=here)], _transforms(poses))
    if here[-1] < len(moments) - 1:
        _clear(rec, name, here[-1] + 1)


def _log_fused(rec: rr.RecordingStream, run: RunData, shown: Sequence[str], at: int) -> None:
    """What was fused, in place of the scans."""
    some = even_indices(len(run.fused.points), _OF_FUSED)
    colours = unsigned_colours(take_mapped(run.fused.residual, some), _full(run))
    for name in shown:
        _clear(rec, name, at)
    rec.set_time("iteration", sequence=at)
    rec.log("fused", rr.Points3D(take_mapped(run.fused.points, some).astype(np.float32), colors=colours, radii=_CLOUD))
    rec.reset_time()


def _full(run: RunData) -> float:
    return robust_limit(run.fused.residual)


def _clear(rec: rr.RecordingStream, name: str, at: int) -> None:
    rec.set_time("iteration", sequence=at)
    rec.log(["views", name], rr.Clear(recursive=False))
    rec.reset_time()


def _transforms(poses: Array) -> rr.ComponentColumnList:
    places, turns = poses[:, :3, 3].astype(np.float32), poses[:, :3, :3].astype(np.float32)
    return rr.Transform3D.columns(translation=places, mat3x3=turns)


def _path(name: str) -> str:
    return f"views/{rr.escape_entity_path_part(name)}"


# What is said beside the clouds.


def _bound_in_words(run: RunData, views: int, of: int, each: int) -> str:
    bound = f"At most {each:,} points of a view are shown."
    if views < of:
        bound += f" {views} of the {of} views are shown."
    if run.left_out:
        bound += " Grey scans are left out later on."
    return bound


def _log_words(rec: rr.RecordingStream, run: RunData, moments: Sequence[Moment], bound: str) -> None:
    """A text for every moment, every model and every view, and a table of all moments."""
    unit = run.session.length_unit
    for i, moment in enumerate(moments):
        rec.set_time("iteration", sequence=i)
        lines = [f"## {moment.title}", f"Moment {i} of {len(moments) - 1} on the timeline `iteration`.", ""]
        if np.isfinite(moment.rms):
            lines += [f"Distance between views: {length_text(moment.rms, unit, 4)} rms.", ""]
        if np.isfinite(moment.gate):
            lines += [f"Partners lie within {length_text(moment.gate, unit)}.", ""]
        if moment.stage == FUSE:
            lines += [f"Colours: rms distance of the views; darkest from {length_text(_full(run), unit)} on.", ""]
        rec.log("moment", words("\n".join([*lines, moment.told, "", bound])))
        rec.reset_time()
    texts = []
    for v, (view, rms) in enumerate(zip(run.session.views, run.view_rms, strict=True)):
        lies = f" It lies {length_text(float(rms), unit)} rms off the others." if np.isfinite(rms) else ""
        lines = [
            f"## {view.name}",
            f"View {v + 1} of {len(run.session.views)}, {len(shown_points(view)):,} points.{lies}",
        ]
        texts.append(unbroken("\n".join([*lines, "", bound])))
    of_views = rr.TextDocument.columns(text=texts, media_type=[rr.MediaType.MARKDOWN] * len(texts))
    rec.send_columns("moment", [rr.TimeColumn("view", sequence=range(len(texts)))], of_views)
    rows = [
        f"| {i} | {m.title} | {len(m.names)} | {_number(m.rms, unit)} | {_number(m.gate, unit)} |"
        for i, m in enumerate(moments)
    ]
    table = ["| iteration | | views | rms | partners within |", "|---:|---|---:|---:|---:|", *rows]
    rec.log("moments", words("\n".join(table)), static=True)


def _number(length: float, unit: str) -> str:
    return length_text(length, unit, 4) if np.isfinite(length) else ""


def _log_rms(rec: rr.RecordingStream, run: RunData, moments: Sequence[Moment]) -> None:
    """The rms of each kind of moment, and that of every view, as series."""
    by_stage = dict[str, list[tuple[int, float]]]()
    for i, moment in enumerate(moments):
        by_stage.setdefault(moment.stage, []).append((i, moment.rms))
    of_views = {"view": list(enumerate(run.view_rms.tolist()))}
    for timeline, every in (("iteration", by_stage), ("view", of_views)):
        for name, series in every.items():
            known = np.array([(at, rms) for at, rms in series if rms > 0])
            if len(known):
                # In powers of ten: it falls by factors.
                values = np.log10(known[:, 1] * MICROMETRES[run.session.length_unit])
                path, at = f"rms/{name}", rr.TimeColumn(timeline, sequence=known[:, 0].astype(np.int64))
                rec.log(path, rr.SeriesPoints(marker_sizes=4.0, names=name), static=True)
                rec.send_columns(path, [at], rr.Scalars.columns(scalars=values))
