"""A run from clouds, with labelled points beside them or without: how it starts, fits, goes on and ends."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.model.bound import bound
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import PoseErrors, pose_errors
from stitch.observations.surfaces.free_poses import FreePoses, free_poses
from stitch.observations.surfaces.overlaps import collect, common_samples
from stitch.observations.surfaces.scanner_field import field_scatters
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.targets.target_fit import TargetFit
from stitch.runs.recorder import Recorder
from stitch.runs.run import StageResult
from stitch.stages.coarse import REUSED, STATED, Coarse, coarse, given
from stitch.stages.correct import COARSE_SAMPLES, correct
from stitch.stages.correction import Correction
from stitch.stages.evaluate_targets import placed_targets
from stitch.stages.finish import Finished, finish_surfaces
from stitch.stages.fit_surfaces import fit_surfaces
from stitch.stages.fitted import BeginAt, Fitted
from stitch.stages.outlier_removal import FittedSession, without_outliers
from stitch.stages.register import METHODS
from stitch.stages.reuse import reuse
from stitch.stages.sentences import coarse_note, mixed_notes, warnings


def start(sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile | None) -> list[Coarse]:
    """The hand-eye to begin with, one for all sessions: of a model, stated in session.toml, or searched.

    Raises:
        NoResultError: no hand-eye makes the views overlap.
    """
    return [_start(sessions, [m.capture for m in measurements], file)] * len(sessions)


def _start(sessions: Sequence[Session], captures: Sequence[Capture], file: ModelFile | None) -> Coarse:
    if file:
        return given(captures, file.T_mount, REUSED)
    stated = next((s.scanner.T_mount for s in sessions if s.scanner.T_mount is not None), None)
    return coarse(captures) if stated is None else given(captures, stated, STATED)


def begin(measurement: Measurement, begun: Coarse, seconds: float, recorder: Recorder) -> StageResult:
    """How well the views of one session meet under the coarse hand-eye."""
    own, poses = measurement.capture, measurement.capture.poses(begun.T_mount)
    g = collect(own, poses, begun.gate, common_samples(own.scans, COARSE_SAMPLES)).gram
    stage = StageResult("coarse", g.rms, int(g.count.sum()), len(begun.candidates), seconds, coarse_note(begun))
    recorder.stage(stage, poses)
    return stage


def fit(
    sessions: Sequence[Session],
    measurements: Sequence[Measurement],
    begun: Sequence[Coarse],
    begin_at: BeginAt | None,
    recorder: Recorder,
) -> Fitted:
    """The hand-eye from the scans; with effects, both."""

    def once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        repeating = partial(field_scatters, measurements)
        captures = [m.capture for m in measurements]

        def erring(freed: Sequence[FreePoses], T_mount: Array) -> PoseErrors:
            return pose_errors(measurements, Model(T_mount), [f.overlaps.gram.centre for f in freed])

        first = correct(captures, begun[0].T_mount, begun[0].gate, recorder, repeating, erring)
        if begin_at is None:
            return first
        gates = [overlaps.gate for overlaps in first.overlaps]
        weighed = [_weighed(m, own.noise_factor) for m, own in zip(measurements, first.captures, strict=True)]
        # An event or a time constant is one for the whole rig: the first session says where it begins.
        return fit_surfaces(weighed, begin_at(weighed[0], Model(first.model.T_mount), gates[0]), gates, recorder)

    return _fitted(*without_outliers(measurements, once, _targets))


def refit(
    sessions: Sequence[Session],
    measurements: Sequence[Measurement],
    model: Model,
    gates: Sequence[float],
    recorder: Recorder,
) -> Fitted:
    """Hand-eye and the effects of a model fitted anew, matched anew."""

    def once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        return fit_surfaces(measurements, model, gates, recorder)

    return _fitted(*without_outliers(measurements, once, _targets))


def apply(sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile) -> Fitted:
    """The sessions under a model of another run, neither hand-eye nor effects changed."""

    def once(measurements: Sequence[Measurement], _: Correction | None) -> Correction:
        model = bound(file, measurements[0])
        return reuse([corrected(m, model) for m in measurements], model)

    return _fitted(*without_outliers(measurements, once, _targets))


def linearise(session: Session, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Views freed under the model by their overlaps and common targets.

    Raises:
        NoResultError: no two views overlap.
    """
    own = corrected(measurement, model)
    return surface_model(measurement, model, own, free_poses(own, own.poses(model.T_mount), gate))


def finish(
    session: Session,
    fitted: Fitted,
    index: int,
    before: StageResult,
    recorder: Recorder,
    seconds: float,
    register: str,
) -> Finished:
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
        method=METHODS[register],
    )


def notes(session: Session, fitted: Fitted, index: int, begun: Coarse) -> tuple[str, ...]:
    """What a user should know before trusting the result."""
    assert fitted.correction is not None
    own = fitted.sessions[index]
    more = () if own.targets is None else mixed_notes(own.targets, own.outliers, session)
    return (*warnings(begun, fitted.correction.hand_eye), *more)


def _targets(measurements: Sequence[Measurement], correction: Correction) -> list[TargetFit | None]:
    return [placed_targets(m, correction.model, correction.hand_eye.inflation) for m in measurements]


def _fitted(correction: Correction, sessions: Sequence[FittedSession]) -> Fitted:
    weighed = [
        replace(s, measurement=_weighed(s.measurement, own.noise_factor))
        for s, own in zip(sessions, correction.captures, strict=True)
    ]
    return Fitted(correction.model, weighed, list(correction.captures), correction)


def _weighed(measurement: Measurement, noise_factor: float) -> Measurement:
    """The measurement with clouds that weigh as they were found to (`Capture.noise_factor`)."""
    return replace(measurement, capture=replace(measurement.capture, noise_factor=noise_factor))
