"""Hand-eye and effects from overlapping surfaces: match anew, free the views, solve, until nothing moves.

Each step is a generalised least-squares fit over the free-network poses of the views about a model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.fit.correct import Correction
from stitch.fit.fit import WEAK, Step, fitted_parameters, iterate
from stitch.fit.sentences import ANOTHER_ARM, unfitted
from stitch.model.forward import corrected_capture
from stitch.model.model import (
    Model,
    kept_root,
    sizes_of,
    stack_parameters,
    values_of,
    with_fitted_effects,
    with_parameter_values,
)
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.parameter_selection import WhitenedData, omitted_rms
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.effect_columns import view_columns
from stitch.observations.surfaces.hand_eye_fit import (
    SCANNER_SCALE,
    FittedEffects,
    HandEyeSolution,
    hand_eye_statistics,
    solve_hand_eye,
    whiten_captures,
)
from stitch.observations.surfaces.normal_equations import (
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

_MAXIMUM_STEPS = 6
# A step that moves no parameter by so many sigmas is the last.
_CONVERGED = 0.05
# The effect that is the scanner's scale.
_SCALE = "range_scale"


@dataclass(frozen=True)
class Choice:
    """What a step fits, and which errors its covariance counts."""

    fitted: Mask  # (P,) parameters that are fitted
    omitted: Array  # (P,) rms that parameters left at zero may have, each in its unit; 0 for all others
    scanner_errors: dict[str, list[Array]]  # by source, per session, left twists (6V, K) per sigma of shared errors


def fit_surfaces(
    measurements: Sequence[Measurement], model: Model, gates: Sequence[float], recorder: Recorder
) -> Correction:
    """Return the fit of hand-eye and effects that all sessions of a rig share, with covariance and overlaps.

    The steps of `iterate` find the values; their covariance, with the prior of pose errors, is that of the last one.

    Args:
        model: effects in use with the values to begin with.
        gates: per session the largest distance between corresponding points at first, length_unit.
        recorder: is shown every step of the first session.

    Raises:
        NoResultError: no two views overlap.
    """

    def linearise(before: "SurfaceStep | None") -> LinearisedSurfaces:
        """Return the least-squares problem linearised about the first model, or about the one after the step before.

        The observations are the poses to which overlaps alone move the views; the columns, what effects do to them.
        """
        about = model if before is None else before.model
        pairs_from = None if before is None else before.linearised.unconstrained
        captures, unconstrained = _moved_by_overlaps(measurements, about, gates, pairs_from)
        columns = [view_columns(m, about, free) for m, free in zip(measurements, unconstrained, strict=True)]
        return LinearisedSurfaces(measurements, about, captures, unconstrained, columns)

    history: list[float] = []
    for step in iterate(linearise, at_most=_MAXIMUM_STEPS, converged=_CONVERGED):
        poses = step.linearised.captures[0].poses(step.model.T_mount)
        gate = step.linearised.unconstrained[0].overlaps.gate
        recorder.iteration("fit", len(history), poses, step.rms, gate)
        history.append(step.rms)
    # The covariance of the last step, with all that the arm may do wrong.
    linearised, choice = step.linearised, step.choice
    centres = [f.overlaps.gram.centre for f in linearised.unconstrained]
    errors = prior_pose_errors(measurements, linearised.model, centres)
    hand_eye = hand_eye_statistics(step.solution, errors, linearised.common_errors(choice))
    fitted_model = replace(step.model, covariance=hand_eye.covariance)
    kept = kept_root(step.model.terms, model.effects_covariance)
    model = with_fitted_effects(
        fitted_model, choice.fitted, hand_eye.values_covariance, kept, hand_eye.visible_covariance
    )
    last_gates = [f.overlaps.gate for f in linearised.unconstrained]
    captures, unconstrained = _moved_by_overlaps(measurements, model, last_gates, linearised.unconstrained)
    overlaps = tuple(_final_overlaps(c, model.T_mount, gate) for c, gate in zip(captures, gates, strict=True))
    return Correction(
        geometry=model,
        statistics=lambda: hand_eye,
        scatter=hand_eye.repeatability,
        overlaps=overlaps,
        unconstrained=tuple(unconstrained),
        history=(*history, pooled_rms(overlaps)),
        captures=captures,
    )


@dataclass(frozen=True)
class LinearisedSurfaces:
    """The fit's problem about a model: views of all sessions moved by their overlaps alone; P parameters of effects."""

    measurements: Sequence[Measurement]
    model: Model
    captures: tuple[Capture, ...]
    unconstrained: list[UnconstrainedPoses]
    columns: list[Array]  # per session (6V, P) left twists of the views per unit of each parameter

    def choose(self, before: Choice | None) -> Choice:
        """Return the parameters to fit, the rms of those left at zero, and the scanner's errors.

        An effect in use that is the scanner's scale replaces the error of that scale, else it would count twice.

        Args:
            before: the choice of the step before; None in the first.
        """
        scanner_errors = rig_scanner_errors(self.measurements, self.unconstrained)
        # Effects may be of one scanner among several, NAME@SCANNER: then only that one's column goes.
        scale_effects = [term.effect for term in self.model.terms if term.name.partition("@")[0] == _SCALE]
        if any(not effect.scanner for effect in scale_effects):
            del scanner_errors[SCANNER_SCALE]
        elif scale_effects:
            fitted_scanners = {effect.scanner for effect in scale_effects}
            scanner_errors[SCANNER_SCALE] = [
                columns[:, [name not in fitted_scanners for name in m.views.scanners.names]]
                for m, columns in zip(self.measurements, scanner_errors[SCANNER_SCALE], strict=True)
            ]
        held = self._held
        fitted = np.zeros(len(held), bool) if before is None else before.fitted
        fitted = fitted_parameters(self.model.terms, fitted, self._whitened)
        omitted = omitted_rms(self._whitened(fitted), sizes_of(self.model.terms), fitted, self._effect_of_parameter)
        return Choice(fitted, np.where(held | self._is_gauge, 0.0, omitted), scanner_errors)

    def solve(self, choice: Choice) -> "SurfaceStep":
        """Return the step of hand-eye and chosen parameters by generalised least squares; those not chosen become zero.

        It counts as moved by sigmas of white scatter; no covariance is computed.

        Args:
            choice: as `choose` returned it.
        """
        fitted = choice.fitted
        terms = self.model.terms
        before = values_of(terms)
        effects = FittedEffects(
            tuple(c[:, fitted] for c in self.columns), before[fitted], WEAK * sizes_of(terms)[fitted]
        )
        common = self.common_errors(choice)
        solution = solve_hand_eye(self.captures, self.unconstrained, self.model.T_mount, effects, common)
        values = before.copy()
        # Held parameters, as the time of an event, are not fitted and keep their values.
        values[~self._held] = 0.0
        values[fitted] = solution.values + solution.x[6:]
        model = replace(self.model, T_mount=solution.T_mount, terms=with_parameter_values(terms, values))
        sigma = np.sqrt(np.maximum(np.diag(solution.covariance)[6:], 1e-300))
        moved = float(np.max(np.abs(values - before)[fitted] / sigma, initial=0.0))
        return Step(self, choice, solution, model, moved, _model_rms(self.unconstrained))

    def common_errors(self, choice: Choice) -> dict[str, list[Array]]:
        """Return by source, per session, left twists (6V, K) of the views for one sigma of errors that all views share.

        Sources are the scanner, each effect whose parameters are left at zero though they may not be, and the
        uncertainty of another run's arm.
        """
        terms = self.model.terms
        errors = dict(choice.scanner_errors)
        for k, term in enumerate(terms):
            sizes = choice.omitted * (self._effect_of_parameter == k)
            if sizes.any():
                errors[unfitted(term.name)] = [c[:, sizes > 0] * sizes[sizes > 0] for c in self.columns]
        # (P, K) root of the covariance of parameters that come from another run's arm.
        kept = kept_root(terms, self.model.effects_covariance)
        errors[ANOTHER_ARM] = [c @ kept for c in self.columns]
        return errors

    @property
    def _effect_of_parameter(self) -> Indices:
        """(P,) index of the effect of every parameter."""
        return np.array([k for k, term in enumerate(self.model.terms) for _ in term.parameters], int)

    @property
    def _is_gauge(self) -> Mask:
        """(P,) mask of parameters that place axes in a session without a robot.

        Nothing then says where the common frame of the axes stands. Some of these parameters move all axes together:
        leaving them at zero is a choice of that frame (a gauge), not an error.
        """
        is_free = any(m.views.axes and not m.views.axes.has_robot for m in self.measurements)
        return np.array(
            [
                is_free and term.effect.place == "axis" and term.is_geometry
                for term in self.model.terms
                for _ in term.parameters
            ],
            bool,
        )

    @property
    def _held(self) -> Mask:
        """(P,) mask of the parameters that keep their values: they are not fitted."""
        return np.array([p.held for p in stack_parameters(self.model.terms)], bool)

    def _whitened(self, free: Mask) -> WhitenedData:
        """Return the whitened data of all sessions, the scatter estimated with the `free` parameters (P,) fitted."""
        sessions = list(zip(self.captures, self.unconstrained, self.columns, strict=True))
        return whiten_captures(sessions, self.model.T_mount, values_of(self.model.terms), free)


SurfaceStep = Step[LinearisedSurfaces, HandEyeSolution]


def _moved_by_overlaps(
    measurements: Sequence[Measurement],
    model: Model,
    gates: Sequence[float],
    pairs_from: Sequence[UnconstrainedPoses] | None,
) -> tuple[tuple[Capture, ...], list[UnconstrainedPoses]]:
    """Return per session the capture with the effects of a model taken out, and its views moved by the overlaps alone.

    Args:
        gates: per session the largest distance between corresponding points at first, length_unit.
        pairs_from: the views moved from a model near by: which of them overlap, and the nearest points that cannot
            have changed, are used again; None: all is searched.
    """
    captures = tuple(corrected_capture(measurement, model) for measurement in measurements)
    overlaps_before = [None] * len(captures) if pairs_from is None else [free.overlaps for free in pairs_from]
    unconstrained = [
        unconstrained_poses(c, c.poses(model.T_mount), gate, before)
        for c, gate, before in zip(captures, gates, overlaps_before, strict=True)
    ]
    return captures, unconstrained


def _model_rms(unconstrained: Sequence[UnconstrainedPoses]) -> float:
    """Return the weighted rms distance (length_unit) that a model leaves between the surfaces of all sessions.

    The correspondences are those of views moved by the overlaps alone; the views are moved back to the model's poses.
    """
    squares = 0.0
    weights = 0.0
    for f in unconstrained:
        g = f.overlaps.gram
        squares += pair_squares(g, -f.twists)[~g.labelled].sum()
        weights += g.weight.sum()
    return float(np.sqrt(squares / max(weights, 1e-300)))


def _final_overlaps(capture: Capture, T_mount: Array, gate: float) -> Overlaps:
    """Return the overlaps at the poses of the model, matched twice: the second time within the gate of the first.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        gate: largest distance between corresponding points the first time, length_unit.
    """
    poses = capture.poses(T_mount)
    overlaps = collect_overlaps(capture, poses, gate)
    return collect_overlaps(capture, poses, min(gate, next_gate(overlaps, capture)), before=overlaps)
