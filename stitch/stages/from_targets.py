"""A run from labelled points or probes alone: how it starts, fits, goes on and ends."""

from collections.abc import Callable, Sequence

import numpy as np

from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
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
from stitch.stages.fit_targets import fit_targets
from stitch.stages.fitted import BeginAt, Fitted
from stitch.stages.outlier_removal import without_outliers
from stitch.stages.sentences import target_notes


def start(sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile | None) -> Coarse:
    """The hand-eye to begin with: of a model, stated in session.toml, or in closed form.

    Raises:
        NoResultError: motions or targets that cannot show the hand-eye.
    """
    stated = file.T_mount if file else sessions[0].scanner.T_mount
    if stated is None:
        return Coarse(closed_form(measurements[0].capture), float("nan"), "found in closed form", ())
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
    begun: Coarse,
    begin_at: BeginAt | None,
    recorder: Recorder,
) -> Fitted:
    """Hand-eye and targets; then, with effects, all of them."""
    first = refit(sessions, measurements, Model(begun.T_mount), (), recorder)
    if begin_at is None:
        return first
    own = first.sessions[0].measurement
    return refit(sessions, [own], begin_at(own, Model(first.model.T_mount), begun.gate), (), recorder)


def refit(
    sessions: Sequence[Session],
    measurements: Sequence[Measurement],
    model: Model,
    gates: Sequence[float],
    recorder: Recorder,
) -> Fitted:
    """Hand-eye, targets and the effects of a model fitted anew from where it stands."""
    sightings = measurements[0].capture.sightings
    assert sightings is not None
    drawing = drawing_of(sessions[0].nominal, sightings)

    def once(measurement: Measurement, before: TargetFit | None) -> TargetFit:
        begin = model if before is None else before.model
        landmarks = initial_landmarks(corrected(measurement, begin), begin.T_mount, drawing)
        return fit_targets(measurement, begin, landmarks, recorder)

    return _fitted(measurements, once)


def apply(sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile) -> Fitted:
    """The session under a model of another run; nothing is fitted but targets that it does not know."""
    return _fitted(measurements, lambda measurement, _: evaluate_targets(measurement, bound(file, measurement)))


def linearise(session: Session, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Labelled points as they are."""
    sightings = measurement.capture.sightings
    assert sightings is not None
    return target_model(measurement, model, drawing_of(session.nominal, sightings))


def finish(
    session: Session, fitted: Fitted, index: int, before: StageResult, recorder: Recorder, seconds: float
) -> Finished:
    """Register single views."""
    found = fitted.sessions[index].targets
    assert found is not None
    return finish_targets(session, found, before, recorder, seconds)


def notes(session: Session, fitted: Fitted, index: int, begun: Coarse) -> tuple[str, ...]:
    """What a user should know before trusting the result."""
    own = fitted.sessions[index]
    assert own.targets is not None
    return target_notes(own.targets, own.outliers, session)


def _fitted(measurements: Sequence[Measurement], once: Callable[[Measurement, TargetFit | None], TargetFit]) -> Fitted:
    def fit_all(measurements: Sequence[Measurement], before: TargetFit | None) -> TargetFit:
        return once(measurements[0], before)

    found, sessions = without_outliers(measurements, fit_all, lambda _, found: found)
    return Fitted(found.model, sessions, [found.rows.capture])
