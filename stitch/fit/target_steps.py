"""A run from labelled points or probes alone: how it starts, fits, goes on and ends."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.coarse import REUSED, STATED, CoarseHandEye
from stitch.fit.fit import FitStart, FittedRig, fit_without_outliers
from stitch.fit.sentences import target_notes, target_sentence
from stitch.fit.target_fit import TargetSession, evaluate_targets, fit_targets
from stitch.fusion.register import register_targets
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.hand_eye_fit import repeatability_from
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.observations.targets.rows import drawing_of, initial_landmarks
from stitch.observations.targets.target_model import TargetModelFit, rms_of, target_model
from stitch.recorder import Recorder
from stitch.run_data import Fit, FusedCloud, Fusion, StageResult
from stitch.session.capture import Sightings
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData
from stitch.system.threads import Clock


def start(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile | None
) -> list[CoarseHandEye]:
    """Return the hand-eye of each session to begin with: of a model, stated in session.toml, or in closed form.

    Raises:
        NoResultError: motions or targets that cannot show the hand-eye; without a model, no target that is seen twice.
    """
    return [_start_session(s, m, file) for s, m in zip(sessions, measurements, strict=True)]


def _start_session(session: SessionData, measurement: Measurement, file: ModelFile | None) -> CoarseHandEye:
    """Return the hand-eye to begin with: of another run, stated in session.toml, or in closed form.

    Its gate is NaN, since labelled points need none.

    Args:
        file: model of another run; None: there is none.

    Raises:
        NoResultError: no target is seen in two views, and no other run says where they are.
    """
    if file is None and _sightings(measurement).view_counts.max() < 2:
        raise NoResultError(
            f"{session.path}: no target is seen in two views; nothing shows whether the poses agree; to fix: with the "
            "model of another run (--hand-eye) they are put in their places"
        )
    stated = file.T_mount if file else session.scanner.T_mount
    if stated is None:
        return CoarseHandEye(closed_form_hand_eye(measurement.capture), float("nan"), "found in closed form", ())
    return CoarseHandEye(stated, float("nan"), REUSED if file else STATED, ())


def _sightings(measurement: Measurement) -> Sightings:
    """Return the labelled points of a session that has some."""
    assert measurement.capture.sightings is not None
    return measurement.capture.sightings


def fit(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], start: FitStart, recorder: Recorder
) -> FittedRig:
    """Return the fit of each session's hand-eye and targets, and of effects that all sessions share, if there are any.

    Three cases, by `start`. A model of another run: only targets that it does not know are fitted. A model fitted
    before: the fit goes on from it. Else hand-eyes and targets first, then all with the effects.
    """
    if start.given is not None:
        file = start.given

        def evaluate(measurements: Sequence[Measurement], _: list[TargetModelFit] | None) -> list[TargetModelFit]:
            """Return the labelled points of every session under the model of the other run."""
            return [evaluate_targets(m, bind_to_session(file, m)) for m in measurements]

        return FittedRig(fit_without_outliers(measurements, evaluate, _targets_of)[1])
    if start.model is not None:
        return _fit_models(sessions, measurements, [start.model] * len(sessions), recorder)
    first = _fit_models(sessions, measurements, [Model(hand_eye.T_mount) for hand_eye in start.hand_eyes], recorder)
    if start.effects is None:
        return first
    measurements = [session.measurement for session in first.sessions]
    hand_eyes = [first.model_of(k).T_mount for k in range(len(sessions))]
    # The time of an event is common to all sessions: the first decides where its search begins.
    model = start.effects(measurements[0], Model(hand_eyes[0]), start.hand_eyes[0].gate)
    return _fit_models(sessions, measurements, [replace(model, T_mount=T) for T in hand_eyes], recorder)


def _fit_models(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], models: Sequence[Model], recorder: Recorder
) -> FittedRig:
    """Return the fit to labelled points from one model per session, repeated without outliers until there are none."""
    drawings = [drawing_of(s.nominal, _sightings(m)) for s, m in zip(sessions, measurements, strict=True)]

    def fit_once(measurements: Sequence[Measurement], before: list[TargetModelFit] | None) -> list[TargetModelFit]:
        """Return the fit of all sessions, begun at the models of the fit before; None: at `models`."""
        begin = models if before is None else [targets.model for targets in before]
        start = [
            TargetSession(m, model, initial_landmarks(corrected_capture(m, model), model.T_mount, drawing))
            for m, model, drawing in zip(measurements, begin, drawings, strict=True)
        ]
        return fit_targets(start, recorder)

    return FittedRig(fit_without_outliers(measurements, fit_once, _targets_of)[1])


def _targets_of(_: Sequence[Measurement], fits: list[TargetModelFit]) -> list[TargetModelFit]:
    """Return the labelled points of every session under a fit, as `fit_without_outliers` asks for them."""
    return fits


def linearise(session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Return the linear model of a session's labelled points about `model`; `gate` concerns clouds and is not used."""
    return target_model(measurement, model, drawing_of(session.nominal, _sightings(measurement)))


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
    """Return the result of session `index` of a rig, and its noise floor, length_unit.

    Each view is moved by its most likely pose error. There is no cloud: the targets stand in for one. The signature is
    that of `Pipeline`; `method` and `until_screened` concern clouds alone and are not used.

    Args:
        fitted: all sessions of the rig with their common model.
        coarse: result of the stage before the fit.
        recorder: is shown the stages correct and register.
        seconds: time that the fit has taken.
    """
    clock = Clock()
    targets = fitted.sessions[index].targets
    assert targets is not None
    # T_reference_scanner (V, 4, 4), of the model and with each view's own pose error.
    poses_model = targets.rows.capture.poses(targets.model.T_mount)
    poses, distances = register_targets(targets.rows, targets.variances, poses_model)
    count = int(np.isfinite(targets.distances).sum())
    note = "3D distances of the targets from their fitted positions"
    corrected = StageResult("correct", targets.rms, count, iterations=len(targets.history), seconds=seconds, note=note)
    note = "each view moved by its most likely pose error"
    registered = StageResult("register", rms_of(distances), count, iterations=1, seconds=clock.lap(), note=note)
    recorder.stage(corrected, poses_model)
    recorder.stage(registered, poses)
    scatter = repeatability_from(targets.variances)
    fit = Fit(
        stages_before=(coarse, corrected, registered),
        poses_model=poses_model,
        poses=poses,
        corrections=frames.log(poses @ frames.inverse(poses_model)),
        view_rms=np.sqrt(targets.view_squares),
        fusion_source=Fusion(_targets_as_cloud(targets)),
        repeatability=scatter,
        verdict=target_sentence(targets, registered.rms, scatter, session.length_unit),
        convergence={"correct": list(targets.history), "register": [registered.rms]},
    )
    return fit, targets.noise_floor


def _targets_as_cloud(targets: TargetModelFit) -> FusedCloud:
    """Return the targets as a cloud, to stand in for a fused one, without normals.

    Per target: its fitted position, the rms distance of the views from it as residual, and the number of views.
    """
    positions = targets.landmarks.positions
    count: Array = np.minimum(targets.rows.sightings.view_counts, 65535).astype(np.int32)
    return FusedCloud(positions, np.zeros_like(positions), targets.target_rms, count)


def notes(session: SessionData, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
    """Return notes on session `index` for the report, about its labelled points."""
    targets = fitted.sessions[index].targets
    assert targets is not None
    return target_notes(targets, fitted.sessions[index].outliers, session)
