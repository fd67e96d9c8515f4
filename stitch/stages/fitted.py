"""How a run goes with what was observed, and what the fit of a rig found."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile
from stitch.observations.linear_model import LinearModel
from stitch.runs.recorder import Recorder
from stitch.runs.run import StageResult
from stitch.stages.coarse import CoarseHandEye
from stitch.stages.correction import Correction
from stitch.stages.finish import FinishedSession
from stitch.stages.outlier_removal import FittedSession

# From a measurement, its model and the gate to the model that the fit of effects begins with.
InitialModel = Callable[[Measurement, Model, float], Model]


@dataclass(frozen=True)
class FittedRig:
    """The common model of a rig, and its sessions as they count."""

    model: Model  # of labelled points, that of the first session
    sessions: list[FittedSession]
    captures: list[Capture]  # without the effects in use
    correction: Correction | None = None  # of surfaces

    def model_of(self, index: int) -> Model:
        """Of one session: labelled points of an arm share its effects, and each session has its own hand-eye."""
        own = self.sessions[index].targets
        return own.model if self.correction is None and own is not None else self.model


class Pipeline(Protocol):
    """How a run goes with what was observed; a further kind of observation is one more module with these functions."""

    def initial_hand_eyes(
        self, sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile | None
    ) -> list[CoarseHandEye]:
        """The hand-eye of every session to begin with."""
        ...

    def initial_stage(
        self, measurement: Measurement, start: CoarseHandEye, seconds: float, recorder: Recorder
    ) -> StageResult:
        """How well the views agree under it."""
        ...

    def fit(
        self,
        sessions: Sequence[Session],
        measurements: Sequence[Measurement],
        starts: Sequence[CoarseHandEye],
        initial_model: InitialModel | None,
        recorder: Recorder,
    ) -> FittedRig:
        """Hand-eye and effects from the coarse hand-eye on."""
        ...

    def refit(
        self,
        sessions: Sequence[Session],
        measurements: Sequence[Measurement],
        model: Model,
        gates: Sequence[float],
        recorder: Recorder,
    ) -> FittedRig:
        """Hand-eye and the effects of a model fitted anew from where it stands."""
        ...

    def apply(self, sessions: Sequence[Session], measurements: Sequence[Measurement], file: ModelFile) -> FittedRig:
        """The sessions under a model of another run as it is."""
        ...

    def linearise(self, session: Session, measurement: Measurement, model: Model, gate: float) -> LinearModel:
        """What was observed, as one linear model about a model."""
        ...

    def finish(
        self,
        session: Session,
        fitted: FittedRig,
        index: int,
        before: StageResult,
        recorder: Recorder,
        seconds: float,
        register: str,
    ) -> FinishedSession:
        """Single views registered by a method, and fused."""
        ...

    def notes(self, session: Session, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
        """What a user should know before trusting the result."""
        ...
