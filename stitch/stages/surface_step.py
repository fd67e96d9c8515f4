"""One step of the fit to overlapping surfaces: generalised least squares over freed views about a model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.model.effects_covariance import kept_root
from stitch.model.model import Model
from stitch.model.term import sizes_of, split, stacked, values_of
from stitch.observations.pose_errors import PoseErrors, pose_errors
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.gram import pair_squares
from stitch.observations.surfaces.hand_eye import SCANNER_FIELD, HandEye, fit_hand_eye
from stitch.observations.surfaces.hand_eye_solution import Columns
from stitch.observations.surfaces.pose_channel import whitened
from stitch.observations.surfaces.scanner_field import field_scatters
from stitch.stages.error_sources import ANOTHER_ARM, unfitted
from stitch.stages.fit import WEAK, fitted_parameters
from stitch.statistics.parameter_selection import Whitened, omitted_rms


@dataclass(frozen=True)
class Choice:
    """Which parameters of effects are fitted, and what errs beside them."""

    fitted: Mask  # (P,)
    omitted: Array  # (P,) rms that parameters at zero may well have
    scanner_field: list[Array]  # per session (6V, K) twists by the scanner's errors that all views repeat


@dataclass(frozen=True)
class Step:
    """Where a step ended, and from where it came."""

    model: Model
    moved: float  # of the parameters, sigmas
    rms: float  # what the model leaves between the surfaces, length_unit
    hand_eye: HandEye
    linearised: "Linearised"
    choice: Choice


@dataclass(frozen=True)
class Linearised:
    """Freed views of all sessions about a model; P parameters of effects."""

    measurements: Sequence[Measurement]
    model: Model
    captures: tuple[Capture, ...]
    freed: list[FreePoses]
    columns: list[Array]  # per session (6V, P)

    @property
    def values(self) -> Array:
        """(P,) of the effects at which the views were freed."""
        return values_of(self.model.terms)

    @property
    def sizes(self) -> Array:
        """(P,) plausible ones."""
        return sizes_of(self.model.terms)

    def choose(self, before: Choice | None) -> Choice:
        """The parameters that the views ask for, those of before first."""
        # What the scanner repeats hardly changes with the last micrometres.
        field = field_scatters(self.measurements, self.freed)
        fitted = np.zeros(len(self.values), bool) if before is None else before.fitted
        fitted = fitted_parameters(self.model.terms, fitted, self._whitened)
        omitted = omitted_rms(self._whitened(fitted), self.sizes, fitted, self._of_effect)
        return Choice(fitted, np.where(self._held, 0.0, omitted), field)

    def solve(self, choice: Choice) -> Step:
        """The step, as the iteration of the fit asks for it."""
        return self.step(choice)

    def step(self, choice: Choice, errors: PoseErrors | None = None) -> Step:
        """The step, with a covariance that counts how poses may err; without, one of scatter alone."""
        fitted, before = choice.fitted, self.values
        columns = Columns(tuple(c[:, fitted] for c in self.columns), before[fitted], WEAK * self.sizes[fitted])
        found = fit_hand_eye(self.captures, self.freed, self.model.T_mount, columns, self._repeating(choice), errors)
        values = before.copy()
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[~self._held] = 0.0
        values[fitted] = found.values
        moved = float(np.max(np.abs(values - before)[fitted] / found.values_sigma, initial=0.0))
        return Step(
            model=replace(
                self.model, T_mount=found.T_mount, terms=split(self.model.terms, values), covariance=found.covariance
            ),
            moved=moved,
            rms=_model_rms(self.freed),
            hand_eye=found,
            linearised=self,
            choice=choice,
        )

    def with_errors(self, choice: Choice) -> Step:
        """The step again, with all that the arm may do wrong in its covariance."""
        centres = [f.overlaps.gram.centre for f in self.freed]
        return self.step(choice, pose_errors(self.measurements, self.model, centres))

    def _repeating(self, choice: Choice) -> dict[str, list[Array]]:
        """Twists that all views have in common: a parameter at zero that is not zero errs alike in every view, as the
        scanner does; so does another run's arm."""
        terms = self.model.terms
        kept = kept_root(terms, self.model.effects_covariance)
        omitted = [choice.omitted * (self._of_effect == k) for k in range(len(terms))]
        own = {unfitted(term.name): sizes for term, sizes in zip(terms, omitted, strict=True) if sizes.any()}
        return {
            SCANNER_FIELD: choice.scanner_field,
            **{source: [c[:, sizes > 0] * sizes[sizes > 0] for c in self.columns] for source, sizes in own.items()},
            ANOTHER_ARM: [c @ kept for c in self.columns],
        }

    @property
    def _of_effect(self) -> Indices:
        """(P,) index of the effect of every parameter."""
        return np.array([k for k, term in enumerate(self.model.terms) for _ in term.parameters], int)

    @property
    def _held(self) -> Mask:
        return np.array([p.held for p in stacked(self.model.terms)], bool)

    def _whitened(self, free: Mask) -> Whitened:
        channels = [(c, f, extra) for c, f, extra in zip(self.captures, self.freed, self.columns, strict=True)]
        return whitened(channels, self.model.T_mount, self.values, free)


def _model_rms(freed: Sequence[FreePoses]) -> float:
    """What a model leaves between the surfaces, from the correspondences of the freed views."""
    squares, weights = np.zeros(2)
    for f in freed:
        g = f.overlaps.gram
        squares += pair_squares(g, -f.twists)[~g.labelled].sum()
        weights += g.weight.sum()
    return float(np.sqrt(squares / max(weights, 1e-300)))
