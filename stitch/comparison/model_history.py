"""The field of disagreement at every step of a model's history: coarse, corrected, each effect, register."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.comparison.disagreement_field import DisagreementField
from stitch.comparison.patches import Patches, patches_of
from stitch.effects.contract import EFFECTS
from stitch.effects.in_session import parameters_in
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.forward import true_geometry
from stitch.model.model import Model
from stitch.model.term import Term
from stitch.observations.surfaces.match import signed_distances
from stitch.runs.run import LedgerStep, Run

COARSE, HAND_EYE_ONLY, REGISTER = "coarse", "hand-eye alone", "register"


@dataclass(frozen=True)
class ModelStep:
    """One step of the history: where it puts the views, and how far they disagree there."""

    name: str  # coarse | hand-eye alone | + joint_compliance | register
    poses: Array  # (V, 4, 4) T_reference_scanner
    field: DisagreementField


@dataclass(frozen=True)
class ModelHistory:
    """All steps, judged by the same correspondences on the same patches."""

    patches: Patches
    steps: tuple[ModelStep, ...]

    @property
    def models(self) -> tuple[ModelStep, ...]:
        """The steps between the coarse hand-eye and register: one per model that was fitted."""
        return tuple(step for step in self.steps if step.name not in (COARSE, REGISTER))


# The history of the run that was asked for last: files, page, recording and terminal ask for it one after another.
_last_history: tuple[weakref.ref[Run], ModelHistory | None] | None = None


def model_history(run: Run) -> ModelHistory | None:
    """The field at every step of a run's history; None without clouds.

    Steps whose effects are not known any more are left out.
    """
    global _last_history
    if _last_history is None or _last_history[0]() is not run:
        _last_history = weakref.ref(run), _build_history(run)
    return _last_history[1]


def _build_history(run: Run) -> ModelHistory | None:
    if run.registered is None:
        return None
    matches = run.registered.matches
    states = [(name, *true_geometry(run.measurement, model)) for name, model in models_of(run)]
    states.append((REGISTER, run.poses, states[-1][2]))
    apart = [signed_distances(matches, poses, points) for _, poses, points in states]
    patches = patches_of(matches, len(run.poses), run.registered.gram.scale, model_distances=apart[1])
    steps = [ModelStep(name, poses, patches.field(e)) for (name, poses, _), e in zip(states, apart, strict=True)]
    return ModelHistory(patches, tuple(steps))


def effect_changes(ledger: Sequence[LedgerStep], i: int) -> str:
    """What step i brought or took: + joint_compliance."""
    if i == 0:
        return ", ".join(ledger[0].effects) or HAND_EYE_ONLY
    new = [f"+ {e}" for e in ledger[i].effects if e not in ledger[i - 1].effects]
    gone = [f"− {e}" for e in ledger[i - 1].effects if e not in ledger[i].effects]
    return ", ".join([*new, *gone]) or "fitted again"


def models_of(run: Run) -> list[tuple[str, Model]]:
    """Name of the step and model: coarse, each line of the ledger, the present one as the last."""
    out = [(COARSE, Model(run.T_mount_coarse))]
    for i, step in enumerate(run.ledger[:-1]):
        model = _model_of(step, run.measurement)
        if model is not None:
            out.append((effect_changes(run.ledger, i), model))
    last = effect_changes(run.ledger, len(run.ledger) - 1) if run.ledger else ", ".join(run.effects) or HAND_EYE_ONLY
    return [*out, (last, run.model)]


def _model_of(step: LedgerStep, measurement: Measurement) -> Model | None:
    if any(name not in EFFECTS or name not in step.values for name in step.effects):
        return None
    terms = []
    for name in step.effects:
        own = parameters_in(measurement, EFFECTS[name])
        terms.append(Term(EFFECTS[name], own).at(np.array([step.values[name].get(p.name, 0.0) for p in own])))
    return Model(step.T_mount, tuple(terms))
