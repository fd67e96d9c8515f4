"""The timelines `iteration` and `view` of a recording: every scan once, moved by every stage and every iteration.

`iteration` begins with the raw scans, then coarse, the models before the present one, each iteration of correct, fit
and register, and what was fused. `view` has the stitched scans as they come, one after another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.model_history import COARSE, REGISTER, ModelHistory
from stitch.run_data import RunData, StageResult
from stitch.session.scan import even_indices
from stitch.session.session import SessionData
from stitch.system.threads import take_mapped
from viz.colours import UNSEEN, robust_limit, unsigned_colours, view_colours
from viz.model_timeline import FRAMES
from viz.page_parts import unbroken
from viz.rrd_file import words
from viz.run_numbers import shown_points

# What the picture begins with holds so many points of every raw scan.
_OF_EYE = 50
# Points of a view, of all views together, and of what was fused; views, evenly over the session.
_OF_VIEW, _OF_ALL, _OF_FUSED, _VIEWS = 10_000, 400_000, 40_000, 400
_CLOUD, _TARGETS = rr.Radius.ui_points(1.3), rr.Radius.ui_points(4.0)
RAW, FUSE, MODEL = "raw", "fuse", "model"


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

    @property
    def whole(self) -> SessionData | None:
        """The session with the views that were left out; None before the start."""
        return self.sessions[0] if self.sessions else None

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

    def with_models(self, run: RunData, history: ModelHistory | None) -> tuple[Moment, ...]:
        """Return all moments: the raw scans first, models of the history where they belong."""
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
        before = [
            Moment(MODEL, f"model: {step.name}", tuple(run.session.names), step.poses, step=k)
            for k, step in enumerate(history.steps[1:-2], start=1)
        ]
        return (raw, replace(first, step=0), *before, *rest)


def steps_reached(moments: Sequence[Moment]) -> dict[int, int]:
    """Return where on `iteration` the run reached each step of the model's history."""
    return {moment.step: i for i, moment in enumerate(moments) if moment.step is not None}


def log_moments(rec: rr.RecordingStream, run: RunData, moments: Sequence[Moment], whole: SessionData) -> Array:
    """Log clouds, their motions, and what is said of them, and return places (N, 3) that the raw scans take.

    Args:
        whole: the session with the views that were left out.
    """
    if not moments:
        return np.zeros((0, 3))
    shown = [whole.names[v] for v in even_indices(len(whole.names), _VIEWS)]
    each = min(_OF_VIEW, _OF_ALL // len(shown))
    _log_clouds(rec, run, whole, shown, each)
    for name in shown:
        _log_motion(rec, name, moments)
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
            rec.set_time("model", sequence=0)
            rec.set_time("view", sequence=run.session.names.index(name))
        rec.log(["views", name], rr.Points3D(points, colors=[colours.get(name, UNSEEN)], radii=radius))
        rec.reset_time()
    for v, (name, pose) in enumerate(zip(run.session.names, run.poses, strict=True)):
        if name in shown:
            rec.send_columns(_path(name), [rr.TimeColumn("view", sequence=[v])], _transforms(pose[None]))


def _log_motion(rec: rr.RecordingStream, name: str, moments: Sequence[Moment]) -> None:
    """Where every moment has a view; nothing from where it was left out."""
    here = [(i, m, m.poses[m.names.index(name)]) for i, m in enumerate(moments) if name in m.names]
    poses = np.array([pose for _, _, pose in here])
    rec.send_columns(_path(name), [rr.TimeColumn("iteration", sequence=[i for i, _, _ in here])], _transforms(poses))
    steps = [(m.step, pose) for _, m, pose in here if m.step is not None]
    if name in moments[-1].names and steps:
        at = [FRAMES * step for step, _ in steps]
        poses = np.array([pose for _, pose in steps])
        rec.send_columns(_path(name), [rr.TimeColumn("model", sequence=at)], _transforms(poses))
    if here[-1][0] < len(moments) - 1:
        _clear(rec, name, here[-1][0] + 1)


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
        if moment.step is not None:
            rec.set_time("model", sequence=FRAMES * moment.step)
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
    by_stage = {stage: [(i, m.rms) for i, m in enumerate(moments) if m.stage == stage] for stage in _stages(moments)}
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


def _stages(moments: Sequence[Moment]) -> list[str]:
    return list(dict.fromkeys(moment.stage for moment in moments))
