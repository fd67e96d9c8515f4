"""Hand-eye and effects from overlapping surfaces: match anew, free the views, solve, until nothing moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import covariance_of_fit, kept_root
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.model.term import known_sigmas, split, values_of
from stitch.observations.surfaces.free_poses import FreePoses, free_poses
from stitch.observations.surfaces.match import sample
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, Overlaps, collect, next_gate, pooled_rms
from stitch.observations.surfaces.view_responses import view_columns
from stitch.runs.recorder import Recorder
from stitch.stages.correction import Correction
from stitch.stages.fit import iterate
from stitch.stages.surface_step import Linearised, Step


@dataclass(frozen=True)
class _Surfaces:
    """The overlapping surfaces of all sessions of a rig."""

    measurements: Sequence[Measurement]
    gates: Sequence[float]  # per session the first distance between partners, length_unit
    maximum_iterations: int = 6
    converged: float = 0.05

    def linearise(self, model: Model, previous: Step | None) -> Linearised:
        captures, freed = _free(self.measurements, model, self.gates)
        columns = [view_columns(m, model, f) for m, f in zip(self.measurements, freed, strict=True)]
        return Linearised(self.measurements, model, captures, freed, columns)


def fit_surfaces(
    measurements: Sequence[Measurement], model: Model, gates: Sequence[float], recorder: Recorder | None = None
) -> Correction:
    """Hand-eye and effects that all sessions of a rig share.

    Args:
        model: effects in use with the values to begin with.
        gates: per session the first distance between partners, length_unit.

    Raises:
        NoResultError: no two views overlap.
    """

    def watch(index: int, step: Step) -> None:
        if recorder is not None:
            poses = step.linearised.captures[0].poses(step.model.T_mount)
            recorder.iteration("fit", index, poses, step.rms, step.linearised.freed[0].overlaps.gate)

    last, history = iterate(_Surfaces(measurements, gates), model, watch)
    last = last.linearised.with_errors(last.choice)
    terms, fitted, found = last.model.terms, last.choice.fitted, last.hand_eye.values_covariance
    sigmas = known_sigmas(terms, fitted, np.sqrt(np.diag(found)))
    covariance = covariance_of_fit(terms, fitted, found, kept_root(terms, model.effects_covariance))
    model = replace(last.model, terms=split(terms, values_of(terms), sigmas), effects_covariance=covariance)
    captures, freed = _free(measurements, model, [f.overlaps.gate for f in last.linearised.freed])
    overlaps = [_final_overlaps(c, model.T_mount, gate) for c, gate in zip(captures, gates, strict=True)]
    return Correction(
        model=model,
        hand_eye=last.hand_eye,
        overlaps=tuple(overlaps),
        freed=tuple(freed),
        history=(*history, pooled_rms(overlaps)),
        captures=captures,
    )


def _free(
    measurements: Sequence[Measurement], model: Model, gates: Sequence[float]
) -> tuple[tuple[Capture, ...], list[FreePoses]]:
    captures = tuple(corrected(measurement, model) for measurement in measurements)
    return captures, [free_poses(c, c.poses(model.T_mount), gate) for c, gate in zip(captures, gates, strict=True)]


def _final_overlaps(capture: Capture, T_mount: Array, gate: float) -> Overlaps:
    """Correspondences of the model's own poses; the gate follows what they leave."""
    samples = [sample(scan, FINE_SAMPLES) for scan in capture.scans]
    overlaps = collect(capture, capture.poses(T_mount), gate, samples)
    return collect(capture, capture.poses(T_mount), min(gate, next_gate(overlaps, capture)), samples)
