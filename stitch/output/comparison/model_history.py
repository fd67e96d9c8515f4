"""The history of a run's model: coarse, corrected, each effect, register; how far views or targets disagree at each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.effects.contract import EFFECTS, find_effect, parameters_in
from stitch.model.forward import corrected_capture, true_geometry
from stitch.model.model import Model, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.surfaces.matching import signed_distances
from stitch.observations.targets.target_model import rms_of
from stitch.output.comparison.disagreement_field import DisagreementField, Patches, patches_of
from stitch.run_data import LedgerStep, RunData
from stitch.session.capture import Sightings
from stitch.session.measurement import Measurement
from stitch.system.threads import remembered

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
        return self.steps[1:-1]


@dataclass(frozen=True)
class TargetStep:
    """One step of the history of labelled points, V views with S slots for targets."""

    name: str  # coarse | hand-eye alone | + joint_compliance | register
    distances: Array  # (V, S) 3D, of every target from its place; NaN where none was seen; length_unit
    rms: float  # over all of them, as the ledger has it


@remembered
def model_history(run: RunData) -> ModelHistory | None:
    """Return the field of disagreement at every step: coarse, each model of the ledger, register; None without clouds.

    All steps share correspondences and patches, chosen for the first corrected model. Steps with an effect that is not
    in the library any more are left out.
    """
    if run.registered is None:
        return None
    matches = run.registered.matches
    placed = [(name, *true_geometry(run.measurement, model)) for name, model in models_of(run)]
    distances = [signed_distances(matches, poses, points) for _, poses, points in placed]
    patches = patches_of(matches, len(run.poses), run.registered.gram.scale, model_distances=distances[1])
    models = [ModelStep(name, poses, patches.field(e)) for (name, poses, _), e in zip(placed, distances, strict=True)]
    _, _, points = placed[-1]
    registered = patches.field(signed_distances(matches, run.poses, points))
    return ModelHistory(patches, (*models, ModelStep(REGISTER, run.poses, registered)))


def target_history(run: RunData) -> tuple[TargetStep, ...]:
    """Return how far the targets lie from their positions at every step; empty where none were seen.

    All steps use the sightings that count now. The present model is the last but one step, with its fitted positions;
    in the others a target's position is its mean over the views. Steps with unknown effects are left out.
    """
    sightings = run.measurement.capture.sightings
    if run.targets is None or sightings is None:
        return ()
    *earlier, (present, _) = models_of(run)
    steps = []
    for name, model in earlier:
        capture = corrected_capture(run.measurement, model)
        assert capture.sightings is not None
        places = frames.transform(capture.poses(model.T_mount), capture.sightings.points)
        steps.append(_target_step(name, sightings, places))
    rows = run.targets.rows
    steps.append(TargetStep(present, rows.distances(rows.residual), run.targets.rms))
    return (*steps, _target_step(REGISTER, sightings, frames.transform(run.poses, rows.sightings.points)))


def _target_step(name: str, sightings: Sightings, places: Array) -> TargetStep:
    """Return a step with the distance of every sighting from the mean position of its target.

    Args:
        sightings: which target each slot of a view shows, and whether it counts.
        places: (V, S, 3) positions by view and slot, reference frame, length_unit.
    """
    distances = np.full(sightings.used.shape, np.nan)
    for k in range(len(sightings.targets)):
        seen = sightings.used & (sightings.target == k)
        if seen.any():
            distances[seen] = np.linalg.norm(places[seen] - places[seen].mean(axis=0), axis=1)
    return TargetStep(name, distances, rms_of(distances))


def models_of(run: RunData) -> list[tuple[str, Model]]:
    """Return (name, model) of every step: the coarse hand-eye, each step of the ledger, the present model as the last.

    Steps with an effect that is not in the library any more are left out.
    """
    models = [(COARSE, Model(run.T_mount_coarse))]
    for i, step in enumerate(run.ledger[:-1]):
        if (model := _model_of(step, run.measurement)) is not None:
            models.append((effect_changes(run.ledger, i), model))
    last = effect_changes(run.ledger, len(run.ledger) - 1) if run.ledger else ", ".join(run.effects) or HAND_EYE_ONLY
    return [*models, (last, run.model)]


def _model_of(step: LedgerStep, measurement: Measurement) -> Model | None:
    """Return the model of a step of the ledger; None where one of its effects is not in the library any more.

    A parameter that the step does not state, as of an older version, is zero.
    """
    if any(name.partition("@")[0] not in EFFECTS or name not in step.values for name in step.effects):
        return None
    terms = []
    # Where axes stand is in every model.
    placed = [name for name in step.values if name in EFFECTS and EFFECTS[name].tier == "geometry"]
    for name in (*placed, *step.effects):
        effect = find_effect(name)
        parameters = parameters_in(measurement, effect)
        values = [step.values[name].get(p.name, 0.0) for p in parameters]
        terms.append(Term(effect, parameters).at(np.array(values)))
    return Model(step.T_mount, tuple(terms))


def effect_changes(ledger: Sequence[LedgerStep], i: int) -> str:
    """Return what step i of a ledger added and dropped, as "+ joint_compliance, − backlash"; first, its effects."""
    if i == 0:
        return ", ".join(ledger[0].effects) or HAND_EYE_ONLY
    before = ledger[i - 1].effects
    after = ledger[i].effects
    changes = [*(f"+ {e}" for e in after if e not in before), *(f"− {e}" for e in before if e not in after)]
    return ", ".join(changes) or "fitted again"
