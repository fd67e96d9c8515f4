"""Values to begin a fit with: those that the views suggest at first sight."""

from collections.abc import Sequence

import numpy as np

from stitch.diagnosis.candidates import candidate_of, with_values
from stitch.diagnosis.evidence import ViewEvidence
from stitch.diagnosis.pose_evidence import pose_evidence
from stitch.diagnosis.score import score
from stitch.diagnosis.target_evidence import target_evidence
from stitch.effects.chain import Term
from stitch.effects.contract import Effect
from stitch.effects.terms import empty_term
from stitch.effects.undo import corrected
from stitch.labelled.landmarks import drawing_of
from stitch.overlap.free_poses import free_poses
from stitch.state import State


def evidence_of_state(state: State) -> ViewEvidence:
    """Free the views under the model and reduce them to evidence; labelled points are evidence as they are."""
    sightings = state.chain.capture.sightings
    if not state.chain.capture.scans and sightings is not None:
        return target_evidence(state.chain, state.terms, state.T_mount, drawing_of(state.session.nominal, sightings))
    own = corrected(state.chain, state.terms, state.T_mount)
    freed = free_poses(own, own.poses(state.T_mount), state.gate)
    return pose_evidence(state.chain, state.terms, own, state.T_mount, freed)


def start_values(state: State, effects: Sequence[Effect]) -> list[Term]:
    """A term for each effect; events and time constants at the value that explains most."""
    gridded = [e for e in effects if any(p.grid for p in state.chain.parameters(e))]
    if not gridded:
        return [empty_term(state.chain, effect) for effect in effects]
    evidence = evidence_of_state(state)
    out = []
    for effect in effects:
        candidate = candidate_of(evidence, effect) if effect in gridded else None
        if candidate is None:
            out.append(empty_term(state.chain, effect))
            continue
        best = score(evidence, candidate)
        values = best.values if np.isfinite(best.sigmas).all() else np.zeros(len(best.values))
        out.append(with_values(best.form, values))
    return out
