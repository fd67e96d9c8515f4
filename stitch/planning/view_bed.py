"""All views that a plan may hold, with what they would say of the hand-eye and of rival effects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.diagnosis.candidates import free_masks
from stitch.diagnosis.score import weights_of_masks
from stitch.effects.in_session import find_effect, require_available
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.model.term import sizes_of, term_of
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.pose_channel import hand_eye_jacobian
from stitch.observations.surfaces.scanner_field import field_scatter
from stitch.observations.surfaces.view_responses import view_columns, view_responses
from stitch.planning.expected_model import CellModel, SimulatedViews, simulate_views
from stitch.planning.planned_part import thinned_surface
from stitch.planning.scatter import Scatter
from stitch.planning.view_search import TwistChannel, noise_of

# Points on the part and correspondences of a view are few here: there are many pairs, and noise is not what limits.
_SAMPLES, _POINTS, _MIN_VIEW_SAMPLES = 250, 4000, 25


@dataclass(frozen=True)
class EffectColumns:
    """One effect of a pair: its columns at plausible sizes, and the forms that it may have."""

    columns: Array  # (6N, P)
    forms: Array  # (F, P) bool: parameters that are free
    weights: Array  # (F,) share of the prior of each


@dataclass(frozen=True)
class PossibleViews:
    """N views: those of the session first, then those that could be added."""

    session: Session
    cell: CellModel
    simulated: SimulatedViews
    scatter: Scatter

    def channel(self, foreign_effects: Sequence[str] = (), columns: Sequence[Array] = ()) -> TwistChannel:
        """Hand-eye, a common motion, effects in use, further columns; `foreign_effects`: effects that no arm has of itself."""
        m, freed, model = self.simulated.measurement, self.simulated.unconstrained, self.cell.model
        g = freed.overlaps.gram
        errors = prior_pose_errors([m], model, [g.centre]).without(set(foreign_effects))
        sizes = self.scatter.variances(errors.names)
        covariance = np.einsum("c,cij->ij", sizes[3:], errors.components) + self._white()
        field = field_scatter(m, freed)
        covariance += field @ field.T
        covariance += noise_of(self._information(), sizes[2] * g.variance, max(g.lever, 1e-9))
        used = view_columns(m, model, freed) * sizes_of(model.terms)
        common = np.tile(np.eye(6), (g.views, 1))
        own = hand_eye_jacobian(m.capture.hand_eye_frames(model.T_mount), g.centre)
        return TwistChannel(covariance, np.hstack([own, common, used, *columns]))

    def effect(self, name: str) -> EffectColumns:
        """How the views answer to an effect of the library.

        Raises:
            InputError: one that is not known, or that these views cannot have.
        """
        measurement, effect = self.simulated.measurement, find_effect(name)
        require_available(measurement, effect)
        term = term_of(measurement, effect)
        response = view_responses(measurement, self.cell.model, [term], self.simulated.unconstrained)[0].columns
        masks = free_masks(term)
        return EffectColumns(response * term.typical, np.array(masks), weights_of_masks(masks))

    def _white(self) -> Array:
        """(6N, 6N) of the flange's scatter, view by view."""
        m = self.simulated.measurement
        to_centre = frames.make(np.eye(3), -self.simulated.unconstrained.overlaps.gram.centre)
        carried = frames.adjoint(to_centre @ m.capture.T_reference_flange)
        size = np.repeat([self.scatter.rotation**2, self.scatter.translation**2], 3)
        out = np.zeros((len(carried), 6, len(carried), 6))
        each = np.arange(len(carried))
        out[each, :, each] = (carried * size) @ carried.transpose(0, 2, 1)
        return out.reshape(6 * len(carried), -1)

    def _information(self) -> Array:
        """(N, 6, 6) of every view against all others."""
        g = self.simulated.unconstrained.overlaps.gram
        out = np.zeros((g.views, 6, 6))
        for side in (0, 1):
            np.add.at(out, g.pairs[:, side].astype(np.int64), g.matrix)
        return out


def possible_views(session: Session, cell: CellModel, scatter: Scatter) -> PossibleViews:
    """A session with all views that could be added.

    Args:
        scatter: with the errors of the arm that the views are expected to leave open.
    """
    coarse = replace(cell, part=thinned_surface(cell.part.points, cell.part.normals, _POINTS))
    return PossibleViews(session, coarse, simulate_views(session, coarse, _SAMPLES, _MIN_VIEW_SAMPLES), scatter)
