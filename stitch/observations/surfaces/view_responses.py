"""How the views answer to parameters of effects: left twists of every view, as the overlaps would see them.

Effects of robot, mount and part move views as a whole. Effects of points change what the overlaps
measure; what they look like to the poses is H⁺BᵀWg, with g the change of the distance e per unit.
"""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.forward import moves_points
from stitch.model.jacobian import pose_derivatives
from stitch.model.model import Model
from stitch.model.point_slopes import PointSlopes
from stitch.model.term import Term
from stitch.observations.response import Response
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.point_gram import PointGram, apparent_twists, stream_point_sums


def view_responses(
    measurement: Measurement, model: Model, terms: Sequence[Term], unconstrained: UnconstrainedPoses
) -> list[Response]:
    """Per term the twists (6V, P) of the views, and the sums over pairs of those that change the points."""
    of_points = [term for term in terms if moves_points([term])]
    sums = _point_effect_sums(measurement, model, of_points, unconstrained) if of_points else None
    seen = apparent_twists(sums, unconstrained) if sums else None
    of_views = [term for term in terms if not moves_points([term])]
    moved = pose_derivatives(measurement, model, of_views, unconstrained.overlaps.gram.centre)
    out, at = [], 0
    for term in terms:
        if sums is not None and seen is not None and moves_points([term]):
            own = slice(at, at + len(term.parameters))
            out.append(Response(seen[:, own], sums.select(own)))
            at = own.stop
        else:
            found = next(moved)
            out.append(Response(np.asarray(found.reshape(len(found), -1).T), None))
    return out


def view_columns(measurement: Measurement, model: Model, unconstrained: UnconstrainedPoses) -> Array:
    """(6V, P) twists of the views for all parameters of the effects in use."""
    found = [r.columns for r in view_responses(measurement, model, model.terms, unconstrained)]
    return np.hstack([np.zeros((6 * len(unconstrained.poses), 0)), *found])


def _point_effect_sums(
    measurement: Measurement, model: Model, terms: Sequence[Term], unconstrained: UnconstrainedPoses
) -> PointGram:
    """Sums over the correspondences for all parameters of point effects."""

    slopes = PointSlopes.about_model(measurement, model, terms)

    def of_points(v: int, index: Indices) -> Array:
        return slopes.at(v, unconstrained.poses[v], index)

    def of_targets() -> Array:
        return slopes.at_targets(unconstrained.poses)

    return stream_point_sums(unconstrained, measurement.capture.noise_factor, of_points, of_targets)
