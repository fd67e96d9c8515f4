"""Values to begin a fit with: those that the views suggest at first sight."""

from collections.abc import Callable, Sequence

import numpy as np

from stitch.diagnosis.candidates import candidate_of, with_values
from stitch.diagnosis.score import score
from stitch.effects.contract import Effect
from stitch.frames import Array
from stitch.measurement.labelled_points import Nominal
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import corrected
from stitch.model.terms import empty_term
from stitch.observations.evidence import ViewEvidence
from stitch.observations.surfaces.free_poses import free_poses
from stitch.observations.surfaces.pose_evidence import pose_evidence
from stitch.observations.targets.landmarks import drawing_of
from stitch.observations.targets.target_evidence import target_evidence
from stitch.stored.load_state import State


def evidence_of_state(state: State) -> ViewEvidence:
    """The evidence about what the model of a run lacks."""
    return evidence_at(state.measurement, state.terms, state.T_mount, state.gate, state.session.nominal)


def evidence_at(
    measurement: Measurement, terms: Sequence[Term], T_mount: Array, gate: float, nominal: Nominal | None = None
) -> ViewEvidence:
    """Free the views under the model and reduce them to evidence; labelled points are evidence as they are.

    Args:
        gate: largest distance between partners, length_unit.
        nominal: positions of the targets in the part frame.
    """
    sightings = measurement.capture.sightings
    if not measurement.capture.scans and sightings is not None:
        return target_evidence(measurement, terms, T_mount, drawing_of(nominal, sightings))
    own = corrected(measurement, terms, T_mount)
    return pose_evidence(measurement, terms, own, T_mount, free_poses(own, own.poses(T_mount), gate))


def start_values(
    measurement: Measurement, effects: Sequence[Effect], evidence_now: Callable[[], ViewEvidence]
) -> list[Term]:
    """A term for each effect; events and time constants at the value that explains most.

    Args:
        evidence_now: the evidence before these effects, asked only where one has an event or a time constant.
    """
    gridded = [e for e in effects if any(p.grid for p in measurement.parameters(e))]
    if not gridded:
        return [empty_term(measurement, effect) for effect in effects]
    evidence = evidence_now()
    out = []
    for effect in effects:
        candidate = candidate_of(evidence, effect) if effect in gridded else None
        if candidate is None:
            out.append(empty_term(measurement, effect))
            continue
        best = score(evidence, candidate)
        values = best.values if np.isfinite(best.sigmas).all() else np.zeros(len(best.values))
        out.append(with_values(best.form, values))
    return out
