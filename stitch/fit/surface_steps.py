"""A run from clouds, with labelled points beside them or without: how it starts, fits, goes on and ends."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from stitch.fit.coarse import ALONE, REUSED, STATED, CoarseHandEye, find_coarse_hand_eye, use_given_hand_eye
from stitch.fit.correct import Correction, apply_given_hand_eye, correct
from stitch.fit.fit import FitStart, FittedRig, fit_without_outliers
from stitch.fit.sentences import mixed_notes, register_note, support_note, surface_sentence, warnings
from stitch.fit.surface_fit import fit_surfaces
from stitch.fit.target_fit import locate_targets
from stitch.fusion.fuse import RegisteredSession, fuse_every_point, has_whole_clouds
from stitch.fusion.register import METHODS, Registration, register, unseen_moves
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.normal_equations import RMS_GATE, Overlaps
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, noise_floor, unconstrained_poses
from stitch.observations.targets.target_model import TargetModelFit
from stitch.recorder import Recorder
from stitch.run_data import Fit, Fusion, StageResult
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData
from stitch.system.threads import Clock, begin, take_mapped

# Places of the fused cloud that tell its rms to a part in a thousand.
_RMS_SAMPLES = 2_000_000


def start(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile | None
) -> list[CoarseHandEye]:
    """Return the hand-eye to begin with, one per session and all the same: of a model, stated, or searched.

    Args:
        file: model of another run, whose hand-eye goes before one stated in session.toml; None: there is none.

    Raises:
        NoResultError: no hand-eye makes the views overlap.
    """
    captures = [measurement.capture for measurement in measurements]
    stated = next((s.scanner.T_mount for s in sessions if s.scanner.T_mount is not None), None)
    if file:
        hand_eye = use_given_hand_eye(captures, file.T_mount, REUSED)
    elif stated is not None:
        hand_eye = use_given_hand_eye(captures, stated, ALONE if sessions[0].parts else STATED)
    else:
        hand_eye = find_coarse_hand_eye(captures)
    return [hand_eye] * len(sessions)


def fit(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], start: FitStart, recorder: Recorder
) -> FittedRig:
    """Return the fit of hand-eye, and effects if there are any, to the scans of all sessions of a rig.

    It is repeated without labelled points that contradict the rest. At the end the measurements get the noise factor
    that the fit found.

    Args:
        start: what the fit begins from, see `fit_once`.
        recorder: is shown every step of the first session.
    """

    def fit_once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        """Return the fit of all sessions: by a given model, from a model, or by correction and then effects."""
        if start.given is not None:
            model = bind_to_session(start.given, measurements[0])
            return apply_given_hand_eye([corrected_capture(m, model) for m in measurements], model)
        if start.model is not None:
            return fit_surfaces(measurements, start.model, [start.gate] * len(measurements), recorder)
        correction = _correct_hand_eye(measurements, start.hand_eyes[0], recorder)
        if start.effects is None:
            return correction
        gates = [overlaps.gate for overlaps in correction.overlaps]
        weighed = _weighed(measurements, correction)
        # The time of an event is common to the rig: the first session decides where its search begins.
        model = start.effects(weighed[0], Model(correction.geometry.T_mount), gates[0])
        return fit_surfaces(weighed, model, gates, recorder)

    correction, fitted = fit_without_outliers(measurements, fit_once, _locate_targets)
    weighed = _weighed([session.measurement for session in fitted], correction)
    return FittedRig([replace(s, measurement=m) for s, m in zip(fitted, weighed, strict=True)], correction)


def _correct_hand_eye(measurements: Sequence[Measurement], hand_eye: CoarseHandEye, recorder: Recorder) -> Correction:
    """Return the correction of the hand-eye that all sessions share, from all their scans."""
    captures = [measurement.capture for measurement in measurements]

    def pose_error_prior(unconstrained: Sequence[UnconstrainedPoses], T_mount: Array) -> PoseErrors:
        """Return the prior of pose errors at a hand-eye (4, 4), about the centre of each session's overlaps."""
        return prior_pose_errors(measurements, Model(T_mount), [f.overlaps.gram.centre for f in unconstrained])

    return correct(
        captures,
        hand_eye.T_mount,
        hand_eye.gate,
        recorder,
        scanner_errors=partial(rig_scanner_errors, measurements),
        pose_error_prior=pose_error_prior,
        met=[hand_eye.overlaps(capture) for capture in captures],
    )


def _weighed(measurements: Sequence[Measurement], correction: Correction) -> list[Measurement]:
    """Return the measurements with the noise factor that the correction found: by it labelled points are weighted."""
    return [
        replace(m, capture=replace(m.capture, noise_factor=corrected.noise_factor))
        for m, corrected in zip(measurements, correction.captures, strict=True)
    ]


def _locate_targets(measurements: Sequence[Measurement], correction: Correction) -> list[TargetModelFit | None]:
    """Return per session the places of its labelled points under the corrected model; None where it has none."""
    # `correction.hand_eye` computes a covariance: only where targets need it.
    return [
        None if m.capture.sightings is None else locate_targets(m, correction.model, correction.hand_eye.inflation)
        for m in measurements
    ]


def linearise(session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Return the linear model of a session's surfaces about `model`: its views are moved by the overlaps alone.

    Args:
        gate: largest distance between corresponding points at first, length_unit.

    Raises:
        NoResultError: no two views overlap.
    """
    capture = corrected_capture(measurement, model)
    return surface_model(measurement, model, capture, unconstrained_poses(capture, capture.poses(model.T_mount), gate))


def register_session(
    session: SessionData,
    fitted: FittedRig,
    index: int,
    coarse: StageResult,
    recorder: Recorder,
    *,
    seconds: float,
    method: str,
    until_screened: Callable[[], None],
) -> tuple[Fit, float]:
    """Return the result of session `index` of a rig, its views registered, and its noise floor, length_unit.

    A further thread fuses the views: the result's `fusion` waits for it.

    Args:
        fitted: all sessions of the rig with their common model.
        coarse: result of the stage before the fit.
        recorder: is shown the stages correct, register and, by that thread, fuse.
        seconds: time that the fit has taken.
        method: by which surfaces are registered: dpwvm, gicp or vmm.
        until_screened: blocks until the screening has left all views in.
    """
    correction, measurement = fitted.correction, fitted.sessions[index].measurement
    assert correction is not None
    model, capture, overlaps = correction.geometry, correction.captures[index], correction.overlaps[index]
    poses_model = capture.poses(model.T_mount)
    is_noisy = overlaps.gram.rms > coarse.rms and not correction.given
    note = "the robot's poses are noisy, so the fit trusts the average of all views rather than each overlap"
    corrected = _overlap_stage("correct", overlaps, len(correction.history), seconds, note if is_noisy else "")
    recorder.stage(corrected, poses_model)
    registration, registered = _register_views(session, correction, index, recorder, method)
    # Nothing that people wait for needs the cloud.
    placed = RegisteredSession(session, measurement, model, capture, registration.poses)
    fusing = begin(partial(_fuse_views, placed, recorder, until_screened))
    floor = noise_floor(capture, registration.overlaps, session.scanner.noise)
    scatter = correction.scatter[index]
    fit = Fit(
        stages_before=(coarse, corrected, registered),
        poses_model=poses_model,
        poses=registration.poses,
        corrections=frames.log(registration.poses @ frames.inverse(poses_model)),
        view_rms=per_view_rms(registration.overlaps, len(capture.scans)),
        fusion_source=fusing.result,
        repeatability=scatter,
        verdict=surface_sentence(corrected.rms, registered.rms, floor, scatter, session.length_unit, model.effects),
        convergence={"correct": list(correction.history), "register": list(registration.history)},
        # The state of the search is not needed any more, and large.
        overlaps=replace(overlaps, searched=None),
        registered=replace(registration.overlaps, searched=None),
    )
    return fit, floor


def _register_views(
    session: SessionData, correction: Correction, index: int, recorder: Recorder, method: str
) -> tuple[Registration, StageResult]:
    """Return the registration of one session's views, each with a correction of its own, and its stage for the report.

    Args:
        index: number of the session in the rig.
        method: dpwvm, gicp or vmm.
    """
    clock = Clock()
    capture, overlaps = correction.captures[index], correction.overlaps[index]
    poses_model = capture.poses(correction.geometry.T_mount)
    registration = register(
        capture,
        poses_model,
        correction.scatter[index],
        overlaps.gate,
        recorder,
        correction.unconstrained[index].poses,
        method=METHODS[method],
        before=overlaps,
    )
    note = register_note(registration, session, unseen_moves(registration, poses_model))
    stage = _overlap_stage("register", registration.overlaps, len(registration.history), clock.lap(), note)
    stage = replace(stage, method=method)
    recorder.stage(stage, registration.poses)
    return registration, stage


def _fuse_views(placed: RegisteredSession, recorder: Recorder, until_screened: Callable[[], None]) -> Fusion:
    """Return the registered views of a session fused, which a recorder is shown.

    Raises:
        InputError: a scan changed on disk since it was read.
    """
    if has_whole_clouds(placed.session):
        # Every point is then read from the files again, which takes time and memory: only for views that stay.
        until_screened()
    clock = Clock()
    cloud, unsupported = fuse_every_point(placed)
    several = int((cloud.count > 1).sum())
    rms, note = _fused_rms(cloud.residual), support_note(unsupported)
    stage = StageResult("fuse", rms, several, iterations=1, seconds=clock.lap(), note=note)
    recorder.stage(stage, placed.poses)
    return Fusion(cloud, unsupported, stage)


def _overlap_stage(name: str, overlaps: Overlaps, iterations: int, seconds: float, note: str) -> StageResult:
    """Return a stage of the report with the rms and the number of the correspondences of some overlaps."""
    return StageResult(name, overlaps.gram.rms, int(overlaps.gram.count.sum()), iterations, seconds, note)


def _fused_rms(residual: Array) -> float:
    """Return the rms (length_unit) of a fused cloud's residuals (N,), length_unit, without edges; NaN if all are NaN.

    Of a large cloud every k-th residual is read, `_RMS_SAMPLES` at most.
    """
    sample = take_mapped(residual, np.arange(0, len(residual), -(-len(residual) // _RMS_SAMPLES)))
    distances = sample[np.isfinite(sample)]
    if not len(distances):
        return float("nan")
    # As in the overlaps: what lies beyond 4 robust sigmas is an edge, not a distance of surfaces.
    return float(np.sqrt(np.mean(distances[distances < RMS_GATE * MAD_TO_SIGMA * np.median(distances)] ** 2)))


def per_view_rms(overlaps: Overlaps, views: int) -> Array:
    """Return per view (V,) the rms residual, length_unit, over all pairs that it is in; NaN for a view in none.

    Residuals beyond the robust gate do not count.
    """
    square = np.zeros(views)
    count = np.zeros(views)
    for (v, w), s, n in zip(overlaps.gram.pairs, overlaps.gram.raw_square, overlaps.gram.count, strict=True):
        square[[v, w]] += s
        count[[v, w]] += n
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan)


def notes(session: SessionData, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
    """Return warnings and notes on session `index` for the report, about hand-eye and labelled points."""
    assert fitted.correction is not None
    targets, outliers = fitted.sessions[index].targets, fitted.sessions[index].outliers
    of_targets = () if targets is None else mixed_notes(targets, outliers, session)
    return (*warnings(start, fitted.correction.hand_eye), *of_targets)
