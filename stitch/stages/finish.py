"""The last steps of a run: register single views, fuse them, collect the result."""

import numpy as np

from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.observations.surfaces.gram import RMS_GATE
from stitch.observations.surfaces.noise_floor import noise_floor
from stitch.observations.surfaces.overlaps import Overlaps
from stitch.runs.recorder import Recorder, Silent
from stitch.runs.run import Run, StageResult
from stitch.runs.sentences import correct_note, sentence, warnings
from stitch.stages.coarse import Coarse
from stitch.stages.correct import Correction
from stitch.stages.fuse import fuse, view_residuals
from stitch.stages.observability import unobservable
from stitch.stages.register import register
from stitch.system.threads import Clock


def finish(
    session: Session, measurement: Measurement, index: int, start: Coarse, correction: Correction, before: StageResult,
    recorder: Recorder, seconds: float,
) -> Run:  # fmt: skip
    """Register and fuse session `index` of a rig under the common model, and show it to the recorder."""
    clock = Clock()
    own, hand_eye, overlaps = correction.captures[index], correction.hand_eye, correction.overlaps[index]
    scatter = hand_eye.repeatability[index]
    poses_model = own.poses(hand_eye.T_mount)
    g, iterations = overlaps.gram, len(correction.history)
    note = correct_note(before.rms, g.rms)
    stages = [before, StageResult("correct", g.rms, int(g.count.sum()), iterations, seconds, note)]
    show(recorder, stages[1], own, poses_model, g.rms)
    clock.lap()
    registration = register(own, poses_model, scatter, overlaps.gate, recorder, correction.freed[index])
    final = registration.overlaps
    stages.append(
        StageResult("register", final.gram.rms, int(final.gram.count.sum()), len(registration.history), clock.lap())
    )
    fused = fuse(own, registration.poses)
    stages.append(StageResult("fuse", _fused_rms(fused.residual), int((fused.count > 1).sum()), 1, clock.lap()))
    show(recorder, stages[2], own, registration.poses, final.gram.rms)
    floor = noise_floor(own, final, session.scanner.noise)
    joints = None if any(v.joints is None for v in session.views) else np.array([v.joints for v in session.views])
    alone = len(correction.captures) == 1
    return Run(
        session=session, measurement=measurement, T_mount=hand_eye.T_mount, T_mount_coarse=start.T_mount,
        mount_covariance=hand_eye.covariance,
        unobservable=unobservable(correction.captures, hand_eye.T_mount, session.robot, joints if alone else None),
        stages=tuple(stages), poses_model=poses_model, poses=registration.poses,
        corrections=registration.corrections, view_rms=per_view_rms(final, len(own.scans)),
        residual_rms=overlaps.gram.rms, heldout_rms=overlaps.gram.rms * hand_eye.heldout_ratio,
        noise_floor=floor, fused=fused, repeatability=scatter, overlaps=overlaps,
        verdict=sentence(overlaps.gram.rms, final.gram.rms, floor, scatter, session.length_unit),
        terms=correction.terms, sigmas=correction.sigmas,
        convergence={"correct": list(correction.history), "register": list(registration.history)},
        notes=warnings(start, hand_eye.inflation),
    )  # fmt: skip


def per_view_rms(overlaps: Overlaps, views: int) -> Array:
    """(V,) rms of the residuals that touch a view, inside the robust gate."""
    square, count = np.zeros(views), np.zeros(views)
    for (v, w), s, n in zip(overlaps.gram.pairs, overlaps.gram.raw_square, overlaps.gram.count, strict=True):
        square[[v, w]] += s
        count[[v, w]] += n
    return np.sqrt(square / np.maximum(count, 1))


def show(recorder: Recorder, stage: StageResult, own: Capture, poses: Array, rms: float) -> None:
    """Hand a stage to the recorder with the distances between the views."""
    # The cell of the residual map must hold the step between the views.
    if not isinstance(recorder, Silent):
        recorder.stage(stage, poses, view_residuals(own, poses, max(2 * own.spacing, 3 * min(rms, own.spacing * 3))))


def _fused_rms(residual: Array) -> float:
    seen = residual[np.isfinite(residual)]
    if not len(seen):
        return float("nan")
    # As in the overlaps: what lies beyond 4 robust sigmas is an edge, not a distance of surfaces.
    return float(np.sqrt(np.mean(seen[seen < RMS_GATE * 1.4826 * np.median(seen)] ** 2)))
