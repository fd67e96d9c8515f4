"""A run from labelled points or probes alone: how it starts, fits, goes on and ends."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.measurement.sightings import Sightings
from stitch.model.bound import bound
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile
from stitch.observations.linear_model import LinearModel
from stitch.observations.targets.closed_form import closed_form
from stitch.observations.targets.landmarks import drawing_of, initial_landmarks
from stitch.observations.targets.rows import rows_of
from stitch.observations.targets.target_fit import TargetFit, rms_of
from stitch.observations.targets.target_model import target_model
from stitch.runs.recorder import Recorder
from stitch.runs.run import StageResult
from stitch.stages.coarse import REUSED, STATED, Coarse
from stitch.stages.evaluate_targets import evaluate_targets
from stitch.stages.finish import Finished, finish_targets
from stitch.stages.fit_targets import Begun, fit_targets
from stitch.stages.fitted import BeginAt, Fitted
from stitch.stages.outlier_removal import without_outliers
from stitch.stages.sentences import target_notes


def start(sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile | None) -> list[Coarse]:
    """The hand-eye of each session to begin with: of a model, stated in session.toml, or in closed form.

    Raises:
        NoResultError: motions or targets that cannot show the hand-eye; without a model, no target that is seen twice.
    """
    return [_start(session, measurement, file) for session, measurement in zip(sessions, measurements, strict=True)]


def _start(session: Session, measurement: Measurement, file: ModelFile | None) -> Coarse:
    if file is None and _sightings(measurement).seen.max() < 2:
        raise NoResultError(
            f"{session.path}: no target is seen in two views; nothing shows whether the poses agree; to fix: with the "
            "model of another run (--hand-eye) they are put in their places"
        )
    stated = file.T_mount if file else session.scanner.T_mount
    if stated is None:
        return Coarse(closed_form(measurement.capture), float("nan"), "found in closed form", ())
    return Coarse(stated, float("nan"), REUSED if file else STATED, ())


def begin(measurement: Measurement, begun: Coarse, seconds: float, recorder: Recorder) -> StageResult:
    """How well the views agree on the targets under the coarse hand-eye."""
    own = measurement.capture
    rows = rows_of(own, begun.T_mount, initial_landmarks(own, begun.T_mount))
    distances = rows.distances(rows.residual)
    count = int(np.isfinite(distances).sum())
    stage = StageResult("coarse", rms_of(distances), count, 1, seconds, begun.source)
    recorder.stage(stage, own.poses(begun.T_mount))
    return stage


def fit(
    sessions: Sequence[Session],
    measurements: Sequence[Measurement],
    begun: Sequence[Coarse],
    begin_at: BeginAt | None,
    recorder: Recorder,
) -> Fitted:
    """Hand-eyes and targets; then, with effects that all sessions share, all of them."""
    first = _refit(sessions, measurements, [Model(own.T_mount) for own in begun], recorder)
    if begin_at is None:
        return first
    own = [session.measurement for session in first.sessions]
    # An event or a time constant is one for all sessions: the first says where it begins.
    model = begin_at(own[0], Model(first.model_of(0).T_mount), begun[0].gate)
    return _refit(sessions, own, [replace(model, T_mount=first.model_of(k).T_mount) for k in range(len(own))], recorder)


def refit(
    sessions: Sequence[Session],
    measurements: Sequence[Measurement],
    model: Model,
    gates: Sequence[float],
    recorder: Recorder,
) -> Fitted:
    """Hand-eye, targets and the effects of a model fitted anew from where it stands."""
    return _refit(sessions, measurements, [model] * len(sessions), recorder)


def _refit(
    sessions: Sequence[Session], measurements: Sequence[Measurement], models: Sequence[Model], recorder: Recorder
) -> Fitted:
    drawings = [drawing_of(s.nominal, _sightings(m)) for s, m in zip(sessions, measurements, strict=True)]

    def once(measurements: Sequence[Measurement], before: list[TargetFit] | None) -> list[TargetFit]:
        at = models if before is None else [found.model for found in before]
        every = zip(measurements, at, drawings, strict=True)
        begun = [Begun(m, own, initial_landmarks(corrected(m, own), own.T_mount, drawn)) for m, own, drawn in every]
        return fit_targets(begun, recorder)

    return _fitted(measurements, once)


def apply(sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile) -> Fitted:
    """The sessions under a model of another run; nothing is fitted but targets that it does not know."""

    def once(measurements: Sequence[Measurement], _: list[TargetFit] | None) -> list[TargetFit]:
        return [evaluate_targets(m, bound(file, m)) for m in measurements]

    return _fitted(measurements, once)


def linearise(session: Session, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Labelled points as they are."""
    return target_model(measurement, model, drawing_of(session.nominal, _sightings(measurement)))


def finish(
    session: Session,
    fitted: Fitted,
    index: int,
    before: StageResult,
    recorder: Recorder,
    seconds: float,
    register: str,
) -> Finished:
    """Register single views; `register` names a method of surfaces, which labelled points do not need."""
    found = fitted.sessions[index].targets
    assert found is not None
    return finish_targets(session, found, before, recorder, seconds)


def notes(session: Session, fitted: Fitted, index: int, begun: Coarse) -> tuple[str, ...]:
    """What a user should know before trusting the result."""
    own = fitted.sessions[index]
    assert own.targets is not None
    return target_notes(own.targets, own.outliers, session)


def _fitted(
    measurements: Sequence[Measurement],
    once: Callable[[Sequence[Measurement], list[TargetFit] | None], list[TargetFit]],
) -> Fitted:
    found, sessions = without_outliers(measurements, once, lambda _, found: found)
    return Fitted(found[0].model, sessions, [own.rows.capture for own in found])


def _sightings(measurement: Measurement) -> Sightings:
    assert measurement.capture.sightings is not None
    return measurement.capture.sightings
