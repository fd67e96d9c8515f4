"""Hand-eye and effects from overlapping surfaces: match anew, free the views, solve, until nothing moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.fit.correct import Correction
from stitch.fit.fit import WEAK, fitted_parameters, iterate
from stitch.fit.sentences import ANOTHER_ARM, unfitted
from stitch.model.forward import corrected_capture
from stitch.model.model import (
    Model,
    covariance_of_fit,
    kept_root,
    known_sigmas,
    sizes_of,
    stack_parameters,
    values_of,
    with_parameter_values,
)
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.parameter_selection import WhitenedData, omitted_rms
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.effect_columns import view_columns
from stitch.observations.surfaces.hand_eye_fit import (
    SCANNER_SCALE,
    FittedEffects,
    HandEyeFit,
    fit_hand_eye,
    whiten_captures,
)
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import (
    FINE_SAMPLES,
    Overlaps,
    collect_overlaps,
    next_gate,
    pair_squares,
    pooled_rms,
)
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.recorder import Recorder
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.system.threads import known

# The effect that is the scanner's scale.
_SCALE = "range_scale"

# One step of the fit to overlapping surfaces: generalised least squares over freed views about a model.


@dataclass(frozen=True)
class ParameterChoice:
    """Which parameters of effects are fitted, and what errs beside them."""

    fitted: Mask  # (P,)
    omitted: Array  # (P,) rms that parameters at zero may well have
    # By source, per session (6V, K) twists by the scanner's errors that all views repeat.
    scanner_errors: dict[str, list[Array]]


@dataclass(frozen=True)
class SurfaceFitStep:
    """Where a step ended, and from where it came."""

    model: Model
    moved: float  # of the parameters, sigmas
    rms: float  # what the model leaves between the surfaces, length_unit
    hand_eye: HandEyeFit
    linearised: "LinearisedSurfaces"
    choice: ParameterChoice


@dataclass(frozen=True)
class LinearisedSurfaces:
    """Freed views of all sessions about a model; P parameters of effects."""

    measurements: Sequence[Measurement]
    model: Model
    captures: tuple[Capture, ...]
    unconstrained: list[UnconstrainedPoses]
    columns: list[Array]  # per session (6V, P)

    @property
    def values(self) -> Array:
        """(P,) of the effects at which the views were freed."""
        return values_of(self.model.terms)

    @property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return sizes_of(self.model.terms)

    def choose(self, before: ParameterChoice | None) -> ParameterChoice:
        """The parameters that the views ask for, those of before first."""
        # What the scanner repeats hardly changes with the last micrometres.
        repeated = rig_scanner_errors(self.measurements, self.unconstrained)
        if _SCALE in [term.name for term in self.model.terms]:
            del repeated[SCANNER_SCALE]
        fitted = np.zeros(len(self.values), bool) if before is None else before.fitted
        fitted = fitted_parameters(self.model.terms, fitted, self._whitened)
        omitted = omitted_rms(self._whitened(fitted), self.sizes, fitted, self._of_effect)
        return ParameterChoice(fitted, np.where(self._held, 0.0, omitted), repeated)

    def solve(self, choice: ParameterChoice) -> SurfaceFitStep:
        """The step, as the iteration of the fit asks for it."""
        return self.step(choice)

    def step(self, choice: ParameterChoice, errors: PoseErrors | None = None) -> SurfaceFitStep:
        """The step, with a covariance that counts how poses may err; without, one of scatter alone."""
        fitted, before = choice.fitted, self.values
        columns = FittedEffects(tuple(c[:, fitted] for c in self.columns), before[fitted], WEAK * self.sizes[fitted])
        found = fit_hand_eye(
            self.captures, self.unconstrained, self.model.T_mount, columns, self._scanner_errors(choice), errors
        )
        values = before.copy()
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[~self._held] = 0.0
        values[fitted] = found.values
        moved = float(np.max(np.abs(values - before)[fitted] / found.values_sigma, initial=0.0))
        return SurfaceFitStep(
            model=replace(
                self.model,
                T_mount=found.T_mount,
                terms=with_parameter_values(self.model.terms, values),
                covariance=found.covariance,
            ),
            moved=moved,
            rms=_model_rms(self.unconstrained),
            hand_eye=found,
            linearised=self,
            choice=choice,
        )

    def with_errors(self, choice: ParameterChoice) -> SurfaceFitStep:
        """The step again, with all that the arm may do wrong in its covariance."""
        centres = [f.overlaps.gram.centre for f in self.unconstrained]
        return self.step(choice, prior_pose_errors(self.measurements, self.model, centres))

    def _scanner_errors(self, choice: ParameterChoice) -> dict[str, list[Array]]:
        """Twists that all views have in common: a parameter at zero that is not zero errs alike in every view, as the
        scanner does; so does another run's arm."""
        terms = self.model.terms
        kept = kept_root(terms, self.model.effects_covariance)
        omitted = [choice.omitted * (self._of_effect == k) for k in range(len(terms))]
        own = {unfitted(term.name): sizes for term, sizes in zip(terms, omitted, strict=True) if sizes.any()}
        return {
            **choice.scanner_errors,
            **{source: [c[:, sizes > 0] * sizes[sizes > 0] for c in self.columns] for source, sizes in own.items()},
            ANOTHER_ARM: [c @ kept for c in self.columns],
        }

    @property
    def _of_effect(self) -> Indices:
        """(P,) index of the effect of every parameter."""
        return np.array([k for k, term in enumerate(self.model.terms) for _ in term.parameters], int)

    @property
    def _held(self) -> Mask:
        return np.array([p.held for p in stack_parameters(self.model.terms)], bool)

    def _whitened(self, free: Mask) -> WhitenedData:
        channels = [(c, f, extra) for c, f, extra in zip(self.captures, self.unconstrained, self.columns, strict=True)]
        return whiten_captures(channels, self.model.T_mount, self.values, free)


def _model_rms(unconstrained: Sequence[UnconstrainedPoses]) -> float:
    """What a model leaves between the surfaces, from the correspondences of the freed views."""
    squares, weights = np.zeros(2)
    for f in unconstrained:
        g = f.overlaps.gram
        squares += pair_squares(g, -f.twists)[~g.labelled].sum()
        weights += g.weight.sum()
    return float(np.sqrt(squares / max(weights, 1e-300)))


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
        geometry=model,
        statistics=known(last.hand_eye),
        scatter=last.hand_eye.repeatability,
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
    return collect_overlaps(capture, capture.poses(T_mount), min(gate, next_gate(overlaps, capture)), samples, overlaps)
