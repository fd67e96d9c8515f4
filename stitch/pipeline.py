"""The run: coarse → correct → register → fuse, for one session or several of one rig."""

import time
from collections.abc import Sequence

import numpy as np

from stitch.capture import Capture, capture
from stitch.errors import InputError
from stitch.frames import Array
from stitch.match import sample
from stitch.model import Model, in_unit
from stitch.noise import noise_floor
from stitch.observability import unobservable
from stitch.overlaps import Overlaps, collect
from stitch.recorder import Recorder, Silent
from stitch.repeatability import Repeatability
from stitch.result import Run, StageResult
from stitch.session import Session
from stitch.solve import RMS_GATE
from stitch.stages.coarse import Coarse, coarse, given
from stitch.stages.correct import COARSE_SAMPLES, Correction, correct
from stitch.stages.fuse import fuse, view_residuals
from stitch.stages.register import register
from stitch.stages.reuse import reuse
from stitch.threads import library_threads_off
from stitch.verdict import coarse_note, correct_note, sentence, warnings


def run(session: Session, model: Model | None = None, recorder: Recorder | None = None) -> Run:
    """Stitch one session; with `model`, use its hand-eye as it is instead of correcting.

    Raises:
        InputError: the model belongs to another mount.
        NoResultError: no hand-eye was found, or the views do not overlap.
    """
    return run_rig([session], model, [recorder or Silent()])[0]


def run_rig(
    sessions: Sequence[Session], model: Model | None = None, recorders: Sequence[Recorder] | None = None
) -> list[Run]:
    """Stitch several sessions of one rig with one common hand-eye; one run per session."""
    _same_rig(sessions, model)
    with library_threads_off():
        return _run_rig(sessions, model, recorders)


def _run_rig(sessions: Sequence[Session], model: Model | None, recorders: Sequence[Recorder] | None) -> list[Run]:
    recorders = recorders or [Silent() for _ in sessions]
    for session, recorder in zip(sessions, recorders, strict=True):
        recorder.start(session)
    clock = _Clock()
    captures = [capture(session) for session in sessions]
    if model:
        model = in_unit(model, sessions[0].length_unit)
        start = given(captures, model.T_mount)
    else:
        known = next((s.scanner.T_mount for s in sessions if s.scanner.T_mount is not None), None)
        start = coarse(captures) if known is None else given(captures, known)
    seconds = clock.lap()
    before = [_begin(c, start, seconds, r) for c, r in zip(captures, recorders, strict=True)]
    clock.lap()
    if model:
        correction = reuse(captures, model)
    else:
        correction = correct(captures, start.T_mount, start.gate, recorders[0])
    seconds = clock.lap()
    return [
        _finish(session, captures[i], i, start, before[i], correction, captures, recorders[i], seconds)
        for i, session in enumerate(sessions)
    ]


def _begin(own: Capture, start: Coarse, seconds: float, recorder: Recorder) -> StageResult:
    """How well the views of one session meet under the coarse hand-eye."""
    poses = own.poses(start.T_mount)
    g = collect(own, poses, start.gate, [sample(scan, COARSE_SAMPLES) for scan in own.scans]).gram
    stage = StageResult("coarse", g.rms, int(g.count.sum()), len(start.candidates), seconds, coarse_note(start))
    _show(recorder, stage, own, poses, g.rms)
    return stage


def _finish(
    session: Session, own: Capture, index: int, start: Coarse, before: StageResult, correction: Correction,
    captures: Sequence[Capture], recorder: Recorder, seconds: float,
) -> Run:  # fmt: skip
    """Register and fuse one session under the common hand-eye, and tell the recorder."""
    clock = _Clock()
    hand_eye, overlaps = correction.hand_eye, correction.overlaps[index]
    scatter: Repeatability = hand_eye.repeatability[index]
    poses_model = own.poses(hand_eye.T_mount)
    g, iterations = overlaps.gram, len(correction.history)
    note = correct_note(before.rms, g.rms)
    stages = [before, StageResult("correct", g.rms, int(g.count.sum()), iterations, seconds, note)]
    _show(recorder, stages[1], own, poses_model, g.rms)
    clock.lap()
    registration = register(own, poses_model, scatter, overlaps.gate, recorder, correction.freed[index])
    final = registration.overlaps
    stages.append(
        StageResult("register", final.gram.rms, int(final.gram.count.sum()), len(registration.history), clock.lap())
    )
    fused = fuse(own, registration.poses)
    stages.append(StageResult("fuse", _fused_rms(fused.residual), int((fused.count > 1).sum()), 1, clock.lap()))
    _show(recorder, stages[2], own, registration.poses, final.gram.rms)
    floor = noise_floor(own, final, session.scanner.noise)
    joints = None if any(v.joints is None for v in session.views) else np.array([v.joints for v in session.views])
    result = Run(
        session=session, T_mount=hand_eye.T_mount, T_mount_coarse=start.T_mount,
        mount_covariance=hand_eye.covariance,
        unobservable=unobservable(captures, hand_eye.T_mount, session.robot, joints if len(captures) == 1 else None),
        stages=tuple(stages), poses_model=poses_model, poses=registration.poses,
        corrections=registration.corrections, view_rms=per_view_rms(final, len(own.scans)),
        residual_rms=overlaps.gram.rms, heldout_rms=overlaps.gram.rms * hand_eye.heldout_ratio,
        noise_floor=floor, fused=fused, repeatability=scatter, overlaps=overlaps,
        verdict=sentence(overlaps.gram.rms, final.gram.rms, floor, scatter, session.length_unit),
        convergence={"correct": list(correction.history), "register": list(registration.history)},
        notes=warnings(start, hand_eye.inflation),
    )  # fmt: skip
    recorder.finish(result)
    return result


def per_view_rms(overlaps: Overlaps, views: int) -> Array:
    """(V,) rms of the residuals that touch a view, inside the robust gate."""
    square, count = np.zeros(views), np.zeros(views)
    for (v, w), s, n in zip(overlaps.gram.pairs, overlaps.gram.raw_square, overlaps.gram.count, strict=True):
        square[[v, w]] += s
        count[[v, w]] += n
    return np.sqrt(square / np.maximum(count, 1))


def _show(recorder: Recorder, stage: StageResult, own: Capture, poses: Array, rms: float) -> None:
    # The cell of the residual map must hold the step between the views.
    if not isinstance(recorder, Silent):
        recorder.stage(stage, poses, view_residuals(own, poses, max(2 * own.spacing, 3 * min(rms, own.spacing * 3))))


def _fused_rms(residual: Array) -> float:
    seen = residual[np.isfinite(residual)]
    if not len(seen):
        return float("nan")
    # As in the overlaps: what lies beyond 4 robust sigmas is an edge, not a distance of surfaces.
    return float(np.sqrt(np.mean(seen[seen < RMS_GATE * 1.4826 * np.median(seen)] ** 2)))


def _same_rig(sessions: Sequence[Session], model: Model | None) -> None:
    first = sessions[0]
    for other in sessions[1:]:
        if (other.mount, other.length_unit) != (first.mount, first.length_unit):
            raise InputError(
                f"{other.path}: mount {other.mount} in {other.length_unit}, but {first.path} has {first.mount} "
                f"in {first.length_unit}; only sessions of one rig share a hand-eye"
            )
    if model and model.mount != first.mount:
        raise InputError(
            f"the model's mount is {model.mount}, that of {first.path} is {first.mount}; use a run of the same rig"
        )
    for session in sessions:
        if any(view.cloud is None for view in session.views):
            raise InputError(f"{session.path}: views without clouds; `stitch run` stitches cloud sessions")
        if len(session.views) < 2:
            raise InputError(f"{session.path}/views.csv: one view only; stitching needs at least 2")


class _Clock:
    """Seconds between calls."""

    def __init__(self) -> None:
        self.last = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        self.last, before = now, self.last
        return now - before
