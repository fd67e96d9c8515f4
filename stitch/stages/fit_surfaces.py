"""Hand-eye and effects from overlapping surfaces: match anew, free the views, generalised least squares."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array, Mask
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import covariance_of_fit, kept_root
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.model.term import known_sigmas, split, stacked
from stitch.observations.pose_errors import PoseErrors, pose_errors
from stitch.observations.surfaces.free_poses import FreePoses, free_poses
from stitch.observations.surfaces.gram import pair_squares
from stitch.observations.surfaces.hand_eye import Columns, HandEye, fit_hand_eye
from stitch.observations.surfaces.match import sample
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, Overlaps, collect, next_gate, pooled_rms
from stitch.observations.surfaces.pose_channel import whitened
from stitch.observations.surfaces.scanner_field import field_scatters
from stitch.observations.surfaces.view_responses import view_columns
from stitch.runs.recorder import Recorder
from stitch.stages.correction import Correction
from stitch.stages.fit import WEAK, fitted_parameters, iterate
from stitch.statistics.parameter_selection import Whitened, omitted_rms


@dataclass(frozen=True)
class _Choice:
    fitted: Mask  # (P,)
    omitted: Array  # (P,) rms that parameters at zero may well have
    repeating: list[Array]  # per session (6V, K) of errors that all views have in common


@dataclass(frozen=True)
class _Step:
    model: Model
    moved: float
    rms: float
    hand_eye: HandEye
    fitted: Mask
    freed: list[FreePoses]
    linearised: "_Linearised"
    choice: _Choice


@dataclass(frozen=True)
class _Linearised:
    """Freed views of all sessions about a model; P parameters of effects."""

    measurements: Sequence[Measurement]
    model: Model
    captures: tuple[Capture, ...]
    freed: list[FreePoses]
    columns: list[Array]  # per session (6V, P)

    @property
    def values(self) -> Array:
        """(P,) of the effects at which the views were freed."""
        return np.array([p.value for p in stacked(self.model.terms)], float)

    @property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return np.array([p.typical for p in stacked(self.model.terms)], float)

    def choose(self, before: _Choice | None) -> _Choice:
        # What the scanner repeats hardly changes with the last micrometres.
        repeating = field_scatters(self.measurements, self.freed)
        fitted = np.zeros(len(self.values), bool) if before is None else before.fitted
        fitted = fitted_parameters(self.model.terms, fitted, self._whitened)
        omitted = omitted_rms(self._whitened(fitted), self.sizes, fitted)
        return _Choice(fitted, np.where(self._held, 0.0, omitted), repeating)

    def solve(self, choice: _Choice) -> _Step:
        return self.step(choice)

    def step(self, choice: _Choice, errors: PoseErrors | None = None) -> _Step:
        """The step, with a covariance that counts how poses may err; without, one of scatter alone."""
        fitted, before = choice.fitted, self.values
        # A parameter at zero that is not zero errs alike in every view, as the scanner does; so does another run's arm.
        kept = kept_root(self.model.terms, self.model.effects_covariance)
        repeating = [
            np.hstack([r, c * choice.omitted, c @ kept]) for r, c in zip(choice.repeating, self.columns, strict=True)
        ]
        columns = Columns(tuple(c[:, fitted] for c in self.columns), before[fitted], WEAK * self.sizes[fitted])
        found = fit_hand_eye(self.captures, self.freed, self.model.T_mount, columns, repeating, errors)
        values = before.copy()
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[~self._held] = 0.0
        values[fitted] = found.values
        moved = float(np.max(np.abs(values - before)[fitted] / found.values_sigma, initial=0.0))
        return _Step(
            model=replace(
                self.model, T_mount=found.T_mount, terms=split(self.model.terms, values), covariance=found.covariance
            ),
            moved=moved,
            rms=_model_rms(self.freed),
            hand_eye=found,
            fitted=fitted,
            freed=self.freed,
            linearised=self,
            choice=choice,
        )

    def with_errors(self, choice: _Choice) -> _Step:
        """The step again, with all that the arm may do wrong in its covariance."""
        centres = [f.overlaps.gram.centre for f in self.freed]
        return self.step(choice, pose_errors(self.measurements, self.model, centres))

    @property
    def _held(self) -> Mask:
        return np.array([p.held for p in stacked(self.model.terms)], bool)

    def _whitened(self, free: Mask) -> Whitened:
        channels = [(c, f, extra) for c, f, extra in zip(self.captures, self.freed, self.columns, strict=True)]
        return whitened(channels, self.model.T_mount, self.values, free)


@dataclass(frozen=True)
class _Surfaces:
    """The overlapping surfaces of all sessions of a rig."""

    measurements: Sequence[Measurement]
    gates: Sequence[float]  # per session the first distance between partners, length_unit
    maximum_iterations: int = 6
    converged: float = 0.05

    def linearise(self, model: Model, previous: _Step | None) -> _Linearised:
        captures, freed = _free(self.measurements, model, self.gates)
        columns = [view_columns(m, model, f) for m, f in zip(self.measurements, freed, strict=True)]
        return _Linearised(self.measurements, model, captures, freed, columns)


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

    def watch(index: int, step: _Step) -> None:
        if recorder is not None:
            poses = step.linearised.captures[0].poses(step.model.T_mount)
            recorder.iteration("fit", index, poses, step.rms, step.freed[0].overlaps.gate)

    last, history = iterate(_Surfaces(measurements, gates), model, watch)
    last = last.linearised.with_errors(last.choice)
    sigmas = known_sigmas(last.model.terms, last.fitted, np.sqrt(np.diag(last.hand_eye.values_covariance)))
    values = np.array([p.value for p in stacked(last.model.terms)], float)
    covariance = covariance_of_fit(
        last.model.terms,
        last.fitted,
        last.hand_eye.values_covariance,
        kept_root(last.model.terms, model.effects_covariance),
    )
    model = replace(last.model, terms=split(last.model.terms, values, sigmas), effects_covariance=covariance)
    captures, freed = _free(measurements, model, [f.overlaps.gate for f in last.freed])
    overlaps = [_final_overlaps(c, model.T_mount, gate) for c, gate in zip(captures, gates, strict=True)]
    return Correction(
        model=model,
        hand_eye=last.hand_eye,
        overlaps=tuple(overlaps),
        freed=tuple(freed),
        history=(*history, pooled_rms(overlaps)),
        captures=captures,
    )


def _model_rms(freed: Sequence[FreePoses]) -> float:
    """What a model leaves between the surfaces, from the correspondences of the freed views."""
    squares, weights = np.zeros(2)
    for f in freed:
        g = f.overlaps.gram
        squares += pair_squares(g, -f.twists)[~g.labelled].sum()
        weights += g.weight.sum()
    return float(np.sqrt(squares / max(weights, 1e-300)))


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
