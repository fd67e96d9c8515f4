"""How a run goes with what was observed: from clouds (`surface_steps.py`), or from labelled points (`target_steps.py`).

A further kind of observation is one more module with the functions of `Pipeline`.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from stitch.fit import surface_steps, target_steps
from stitch.fit.coarse import CoarseHandEye
from stitch.fit.fit import FitStart, FittedRig
from stitch.fit.sentences import coarse_note
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile
from stitch.observations.linear_model import LinearModel
from stitch.observations.targets.rows import initial_landmarks, target_rows
from stitch.observations.targets.target_model import rms_of
from stitch.recorder import Recorder
from stitch.run_data import Fit, StageResult
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData


class Pipeline(Protocol):
    """The steps of a run from one kind of observation."""

    def start(
        self, sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile | None
    ) -> list[CoarseHandEye]:
        """Return the hand-eye of every session to begin with: of a model's file, stated, or found."""
        ...

    def fit(
        self, sessions: Sequence[SessionData], measurements: Sequence[Measurement], start: FitStart, recorder: Recorder
    ) -> FittedRig:
        """Return the sessions of a rig with their common model, fitted from `start` on."""
        ...

    def linearise(self, session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
        """Return what one session observed as a linear model about `model`; `gate` as in the function `linearise`."""
        ...

    def register_session(
        self,
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
        """Return the result of session `index`, its views registered, and its noise floor, length_unit.

        It runs in a background thread while the views are screened; where the screening leaves views out, the recorder
        raises an exception that ends it.

        Args:
            fitted: all sessions of the rig with their common model.
            coarse: result of the stage before the fit.
            seconds: time that the fit has taken.
            method: by which surfaces are registered: dpwvm, gicp or vmm.
            until_screened: blocks until the screening has left all views in.
        """
        ...

    def notes(self, session: SessionData, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
        """Return warnings and notes on session `index`: what a user should know before trusting the result."""
        ...


def pipeline_for(session: SessionData) -> Pipeline:
    """Return the steps of a run for what was observed: those from clouds, or from labelled points alone."""
    return surface_steps if session.has_clouds else target_steps


def linearise(session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """Return the linear model of a session about a model: what diagnosis asks for missing effects.

    Args:
        gate: largest distance between corresponding points, length_unit; NaN without clouds.

    Raises:
        NoResultError: no two views overlap.
    """
    return pipeline_for(session).linearise(session, measurement, model, gate)


def coarse_stage(session: SessionData, measurement: Measurement, start: CoarseHandEye, seconds: float) -> StageResult:
    """Return the coarse stage of a session: rms (length_unit) and number of correspondences under the first hand-eye.

    With clouds these are distances between surfaces, else 3D distances of labelled points from their medians.

    Args:
        start: the hand-eye of the start, coarse or given.
        seconds: time that the stage has taken.

    Raises:
        NoResultError: no two views overlap.
    """
    capture, note = measurement.capture, coarse_note(start)
    if session.has_clouds:
        g = start.overlaps(capture).gram
        return StageResult("coarse", g.rms, int(g.count.sum()), len(start.candidates), seconds, note)
    rows = target_rows(capture, start.T_mount, initial_landmarks(capture, start.T_mount))
    distances = rows.distances(rows.residual)
    return StageResult("coarse", rms_of(distances), int(np.isfinite(distances).sum()), 1, seconds, note)
