"""A run from clouds, with labelled points beside them or without: how it starts, fits, goes on and ends."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from stitch.fit.coarse import REUSED, STATED, CoarseHandEye, find_coarse_hand_eye, use_given_hand_eye
from stitch.fit.correct import Correction, apply_given_hand_eye, correct
from stitch.fit.register_and_fuse import FittedRig, InitialModel, begin_to_register_views, finish_surfaces
from stitch.fit.sentences import coarse_note, mixed_notes, warnings
from stitch.fit.surface_fit import fit_surfaces
from stitch.fit.target_fit import FittedSession, fit_without_outliers, locate_targets
from stitch.fusion.register import METHODS
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.observations.targets.target_model import TargetModelFit
from stitch.recorder import Recorder
from stitch.run_data import Fit, LedgerStep, StageResult
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData


def initial_hand_eyes(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile | None
) -> list[CoarseHandEye]:
    """The hand-eye to begin with, one for all sessions: of a model, stated in session.toml, or searched.

    Raises:
        NoResultError: no hand-eye makes the views overlap.
    """
    return [_initial_hand_eye(sessions, [m.capture for m in measurements], file)] * len(sessions)


def _initial_hand_eye(
    sessions: Sequence[SessionData], captures: Sequence[Capture], file: ModelFile | None
) -> CoarseHandEye:
    if file:
        return use_given_hand_eye(captures, file.T_mount, REUSED)
    stated = next((s.scanner.T_mount for s in sessions if s.scanner.T_mount is not None), None)
    return find_coarse_hand_eye(captures) if stated is None else use_given_hand_eye(captures, stated, STATED)


def initial_stage(measurement: Measurement, start: CoarseHandEye, seconds: float, recorder: Recorder) -> StageResult:
    """How well the views of one session meet under the coarse hand-eye."""
    g, poses = start.overlaps(measurement.capture).gram, measurement.capture.poses(start.T_mount)
    stage = StageResult("coarse", g.rms, int(g.count.sum()), len(start.candidates), seconds, coarse_note(start))
    recorder.stage(stage, poses)
    return stage


def fit(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    starts: Sequence[CoarseHandEye],
    initial_model: InitialModel | None,
    recorder: Recorder,
) -> FittedRig:
    """The hand-eye from the scans; with effects, both."""

    def once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        repeating = partial(rig_scanner_errors, measurements)
        captures = [m.capture for m in measurements]

        def pose_error_prior(unconstrained: Sequence[UnconstrainedPoses], T_mount: Array) -> PoseErrors:
            return prior_pose_errors(measurements, Model(T_mount), [f.overlaps.gram.centre for f in unconstrained])

        met = [starts[0].overlaps(capture) for capture in captures]
        first = correct(captures, starts[0].T_mount, starts[0].gate, recorder, repeating, pose_error_prior, met)
        if initial_model is None:
            return first
        gates = [overlaps.gate for overlaps in first.overlaps]
        weighed = [_with_noise_factor(m, own.noise_factor) for m, own in zip(measurements, first.captures, strict=True)]
        # An event or a time constant is one for the whole rig: the first session says where it begins.
        return fit_surfaces(weighed, initial_model(weighed[0], Model(first.model.T_mount), gates[0]), gates, recorder)

    return _fitted_rig(*fit_without_outliers(measurements, once, _locate_targets))


def refit(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    model: Model,
    gates: Sequence[float],
    recorder: Recorder,
) -> FittedRig:
    """Hand-eye and the effects of a model fitted anew, matched anew."""

    def once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        return fit_surfaces(measurements, model, gates, recorder)

    return _fitted_rig(*fit_without_outliers(measurements, once, _locate_targets))


def apply(sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile) -> FittedRig:
    """The sessions under a model of another run, neither hand-eye nor effects changed."""

    def once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        model = bind_to_session(file, measurements[0])
        return apply_given_hand_eye([corrected_capture(m, model) for m in measurements], model)

    return _fitted_rig(*fit_without_outliers(measurements, once, _locate_targets))


def linearise(session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Views freed under the model by their overlaps and common targets.

    Raises:
        NoResultError: no two views overlap.
    """
    own = corrected_capture(measurement, model)
    return surface_model(measurement, model, own, unconstrained_poses(own, own.poses(model.T_mount), gate))


def begin_to_register(fitted: FittedRig, sessions: Sequence[SessionData], register: str) -> FittedRig:
    """The same, with the views of all sessions being registered by a method, and fused."""
    return replace(fitted, begun=begin_to_register_views(fitted, sessions, METHODS[register]))


def finish(
    session: SessionData,
    fitted: FittedRig,
    index: int,
    before: StageResult,
    recorder: Recorder,
    seconds: float,
) -> tuple[Fit, LedgerStep]:
    """Register and fuse session `index` under the common model."""
    assert fitted.correction is not None
    return finish_surfaces(
        session,
        fitted.sessions[index].measurement,
        fitted.correction,
        index=index,
        before=before,
        recorder=recorder,
        seconds=seconds,
        begun=fitted.begun[index],
    )


def notes(session: SessionData, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
    """What a user should know before trusting the result."""
    assert fitted.correction is not None
    own = fitted.sessions[index]
    more = () if own.targets is None else mixed_notes(own.targets, own.outliers, session)
    return (*warnings(start, fitted.correction.hand_eye), *more)


def _locate_targets(measurements: Sequence[Measurement], correction: Correction) -> list[TargetModelFit | None]:
    # How certain the hand-eye is need not be waited for where there are none.
    return [
        None if m.capture.sightings is None else locate_targets(m, correction.model, correction.hand_eye.inflation)
        for m in measurements
    ]


def _fitted_rig(correction: Correction, sessions: Sequence[FittedSession]) -> FittedRig:
    weighed = [
        replace(s, measurement=_with_noise_factor(s.measurement, own.noise_factor))
        for s, own in zip(sessions, correction.captures, strict=True)
    ]
    return FittedRig(weighed, list(correction.captures), correction)


def _with_noise_factor(measurement: Measurement, noise_factor: float) -> Measurement:
    """The measurement with clouds that weigh as they were found to (`Capture.noise_factor`)."""
    return replace(measurement, capture=replace(measurement.capture, noise_factor=noise_factor))
