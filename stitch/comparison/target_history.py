"""How far the targets lie off their place at every step of a model's history."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.comparison.model_history import REGISTER, models_of
from stitch.frames import Array
from stitch.measurement.sightings import Sightings
from stitch.model.forward import corrected_capture
from stitch.observations.targets.target_fit import rms_of
from stitch.runs.run import Run


@dataclass(frozen=True)
class TargetStep:
    """One step of the history, V views with S slots for targets."""

    name: str  # coarse | hand-eye alone | + joint_compliance | register
    distances: Array  # (V, S) 3D, of every target from its place; NaN where none was seen; length_unit
    rms: float  # over all of them, as the ledger has it


def target_history(run: Run) -> tuple[TargetStep, ...]:
    """All steps on the same sightings, those that count now; empty where no targets were seen.

    The model in use is the last but one. Steps whose effects are not known any more are left out.
    """
    s = run.measurement.capture.sightings
    if run.targets is None or s is None:
        return ()
    models = models_of(run)
    steps = []
    for name, model in models[:-1]:
        own = corrected_capture(run.measurement, model)
        assert own.sightings is not None
        steps.append(_target_step(name, s, frames.transform(own.poses(model.T_mount), own.sightings.points)))
    rows = run.targets.rows
    steps.append(TargetStep(models[-1][0], rows.distances(rows.residual), run.targets.rms))
    return (*steps, _target_step(REGISTER, s, frames.transform(run.poses, rows.sightings.points)))


def _target_step(name: str, s: Sightings, placed: Array) -> TargetStep:
    """Of targets (V, S, 3) as the views place them: each about the middle of all views, the place of least squares."""
    own = np.full(s.used.shape, np.nan)
    for k in range(len(s.targets)):
        here = s.used & (s.target == k)
        if here.any():
            own[here] = np.linalg.norm(placed[here] - placed[here].mean(axis=0), axis=1)
    return TargetStep(name, own, rms_of(own))
