"""A run from labelled points or probes alone: how it starts, fits, goes on and ends."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.coarse import REUSED, STATED, CoarseHandEye
from stitch.fit.register_and_fuse import FittedRig, InitialModel, finish_targets
from stitch.fit.sentences import target_notes
from stitch.fit.target_fit import TargetStart, evaluate_targets, fit_targets, fit_without_outliers
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.observations.linear_model import LinearModel
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.observations.targets.rows import drawing_of, initial_landmarks, target_rows
from stitch.observations.targets.target_model import TargetModelFit, rms_of, target_model
from stitch.recorder import Recorder
from stitch.run_data import Fit, LedgerStep, StageResult
from stitch.session.capture import Sightings
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData


def initial_hand_eyes(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile | None
) -> list[CoarseHandEye]:
    """The hand-eye of each session to begin with: of a model, stated in session.toml, or in closed form.

    Raises:
        NoResultError: motions or targets that cannot show the hand-eye; without a model, no target that is seen twice.
    """
    return [
        _initial_hand_eye(session, measurement, file)
        for session, measurement in zip(sessions, measurements, strict=True)
    ]


def _initial_hand_eye(session: SessionData, measurement: Measurement, file: ModelFile | None) -> CoarseHandEye:
    if file is None and _sightings(measurement).view_counts.max() < 2:
        raise NoResultError(
            f"{session.path}: no target is seen in two views; nothing shows whether the poses agree; to fix: with the "
            "model of another run (--hand-eye) they are put in their places"
        )
    stated = file.T_mount if file else session.scanner.T_mount
    if stated is None:
        return CoarseHandEye(closed_form_hand_eye(measurement.capture), float("nan"), "found in closed form", ())
    return CoarseHandEye(stated, float("nan"), REUSED if file else STATED, ())


def initial_stage(measurement: Measurement, start: CoarseHandEye, seconds: float, recorder: Recorder) -> StageResult:
    """How well the views agree on the targets under the coarse hand-eye."""
    own = measurement.capture
    rows = target_rows(own, start.T_mount, initial_landmarks(own, start.T_mount))
    distances = rows.distances(rows.residual)
    count = int(np.isfinite(distances).sum())
    stage = StageResult("coarse", rms_of(distances), count, 1, seconds, start.source)
    recorder.stage(stage, own.poses(start.T_mount))
    return stage


def fit(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    starts: Sequence[CoarseHandEye],
    initial_model: InitialModel | None,
    recorder: Recorder,
) -> FittedRig:
    """Hand-eyes and targets; then, with effects that all sessions share, all of them."""
    first = _refit(sessions, measurements, [Model(own.T_mount) for own in starts], recorder)
    if initial_model is None:
        return first
    own = [session.measurement for session in first.sessions]
    # An event or a time constant is one for all sessions: the first says where it begins.
    model = initial_model(own[0], Model(first.model_of(0).T_mount), starts[0].gate)
    return _refit(sessions, own, [replace(model, T_mount=first.model_of(k).T_mount) for k in range(len(own))], recorder)


def refit(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    model: Model,
    gates: Sequence[float],
    recorder: Recorder,
) -> FittedRig:
    """Hand-eye, targets and the effects of a model fitted anew from where it stands."""
    return _refit(sessions, measurements, [model] * len(sessions), recorder)


def _refit(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], models: Sequence[Model], recorder: Recorder
) -> FittedRig:
    drawings = [drawing_of(s.nominal, _sightings(m)) for s, m in zip(sessions, measurements, strict=True)]

    def once(measurements: Sequence[Measurement], before: list[TargetModelFit] | None) -> list[TargetModelFit]:
        at = models if before is None else [found.model for found in before]
        every = zip(measurements, at, drawings, strict=True)
        begun = [
            TargetStart(m, own, initial_landmarks(corrected_capture(m, own), own.T_mount, drawn))
            for m, own, drawn in every
        ]
        return fit_targets(begun, recorder)

    return _fitted_rig(measurements, once)


def apply(sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile) -> FittedRig:
    """The sessions under a model of another run; nothing is fitted but targets that it does not know."""

    def once(measurements: Sequence[Measurement], _: list[TargetModelFit] | None) -> list[TargetModelFit]:
        return [evaluate_targets(m, bind_to_session(file, m)) for m in measurements]

    return _fitted_rig(measurements, once)


def linearise(session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Labelled points as they are."""
    return target_model(measurement, model, drawing_of(session.nominal, _sightings(measurement)))


def begin_to_register(fitted: FittedRig, sessions: Sequence[SessionData], register: str) -> FittedRig:
    """The same: `register` names a method of surfaces, which labelled points do not need."""
    return fitted


def finish(
    session: SessionData,
    fitted: FittedRig,
    index: int,
    before: StageResult,
    recorder: Recorder,
    seconds: float,
) -> tuple[Fit, LedgerStep]:
    """Register single views."""
    found = fitted.sessions[index].targets
    assert found is not None
    return finish_targets(session, found, before, recorder, seconds)


def notes(session: SessionData, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
    """What a user should know before trusting the result."""
    own = fitted.sessions[index]
    assert own.targets is not None
    return target_notes(own.targets, own.outliers, session)


def _fitted_rig(
    measurements: Sequence[Measurement],
    once: Callable[[Sequence[Measurement], list[TargetModelFit] | None], list[TargetModelFit]],
) -> FittedRig:
    found, sessions = fit_without_outliers(measurements, once, lambda _, found: found)
    return FittedRig(sessions, [own.rows.capture for own in found])


def _sightings(measurement: Measurement) -> Sightings:
    assert measurement.capture.sightings is not None
    return measurement.capture.sightings
