"""Hand-eye and effects from overlapping surfaces: match anew, free the views, solve, until nothing moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import covariance_of_fit, kept_root
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.term import known_sigmas, values_of, with_parameter_values
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, unconstrained_poses
from stitch.observations.surfaces.match import sample_points
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, Overlaps, collect_overlaps, next_gate, pooled_rms
from stitch.observations.surfaces.view_responses import view_columns
from stitch.runs.recorder import Recorder
from stitch.stages.correction import Correction
from stitch.stages.fit import iterate
from stitch.stages.surface_step import LinearisedSurfaces, SurfaceFitStep


@dataclass(frozen=True)
class _SurfaceProblem:
    """The overlapping surfaces of all sessions of a rig."""

    measurements: Sequence[Measurement]
    gates: Sequence[float]  # per session the first distance between partners, length_unit
    maximum_iterations: int = 6
    converged: float = 0.05

    def linearise(self, model: Model, previous: SurfaceFitStep | None) -> LinearisedSurfaces:
        captures, freed = _solve_views(self.measurements, model, self.gates)
        columns = [view_columns(m, model, f) for m, f in zip(self.measurements, freed, strict=True)]
        return LinearisedSurfaces(self.measurements, model, captures, freed, columns)


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

    def watch(index: int, step: SurfaceFitStep) -> None:
        if recorder is not None:
            poses = step.linearised.captures[0].poses(step.model.T_mount)
            recorder.iteration("fit", index, poses, step.rms, step.linearised.unconstrained[0].overlaps.gate)

    last, history = iterate(_SurfaceProblem(measurements, gates), model, watch)
    last = last.linearised.with_errors(last.choice)
    terms, fitted, found = last.model.terms, last.choice.fitted, last.hand_eye.values_covariance
    sigmas = known_sigmas(terms, fitted, np.sqrt(np.diag(found)))
    covariance = covariance_of_fit(terms, fitted, found, kept_root(terms, model.effects_covariance))
    model = replace(
        last.model, terms=with_parameter_values(terms, values_of(terms), sigmas), effects_covariance=covariance
    )
    captures, freed = _solve_views(measurements, model, [f.overlaps.gate for f in last.linearised.unconstrained])
    overlaps = [_final_overlaps(c, model.T_mount, gate) for c, gate in zip(captures, gates, strict=True)]
    return Correction(
        model=model,
        hand_eye=last.hand_eye,
        overlaps=tuple(overlaps),
        unconstrained=tuple(freed),
        history=(*history, pooled_rms(overlaps)),
        captures=captures,
    )


def _solve_views(
    measurements: Sequence[Measurement], model: Model, gates: Sequence[float]
) -> tuple[tuple[Capture, ...], list[UnconstrainedPoses]]:
    captures = tuple(corrected_capture(measurement, model) for measurement in measurements)
    return captures, [
        unconstrained_poses(c, c.poses(model.T_mount), gate) for c, gate in zip(captures, gates, strict=True)
    ]


def _final_overlaps(capture: Capture, T_mount: Array, gate: float) -> Overlaps:
    """Correspondences of the model's own poses; the gate follows what they leave."""
    samples = [sample_points(scan, FINE_SAMPLES) for scan in capture.scans]
    overlaps = collect_overlaps(capture, capture.poses(T_mount), gate, samples)
    return collect_overlaps(capture, capture.poses(T_mount), min(gate, next_gate(overlaps, capture)), samples)
