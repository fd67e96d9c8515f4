"""What effects of the library may do to the views of a session before anybody knows of one.

A view that stands out from white scatter may do so by a blunder, or because the arm bends as arms do. The second is a
random effect (Searle, Casella and McCulloch 1992): every parameter of every effect is zero give or take its size, and
the views scatter accordingly, together and not one by one.
"""

from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.effects.contract import EFFECTS, Effect
from stitch.effects.in_session import missing_need
from stitch.effects.specs import EVERY_VIEW
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.term import term_of
from stitch.observations.flange_errors import DRIFT_MEMORY, drift_kernel, usual_twist
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.view_responses import view_responses
from stitch.statistics.kernels import process_covariance

# Standard deviation of a parameter, in usual sizes: effects of up to four times the usual size are not rare then.
_TIMES_USUAL = 2.0
# Correspondences that tell what an effect does to the views where its size is free.
_MAX_CORRESPONDENCES = 20_000


@dataclass(frozen=True)
class UsualEffects:
    """What may happen to the views of a good session."""

    measurement: Measurement
    model: Model

    def twists(self, unconstrained: UnconstrainedPoses) -> Array:
        """Left twists of the views about the centre of the correspondences, one column a parameter, at its deviation.

        Returns:
            (6V, P) twists, reference frame, rad and length_unit.
        """
        return _TIMES_USUAL * np.hstack(list(self._by_place(unconstrained).values()))

    def errors(self, unconstrained: UnconstrainedPoses) -> PoseErrors:
        """The same in sizes that the views show, one for every place of the chain, beside all that arms do.

        Mount and part also wander as slowly as a session is long: they warm up, creep or settle by no law.
        """
        own, centre = self.measurement.capture, unconstrained.overlaps.gram.centre
        errors = prior_pose_errors([self.measurement], self.model, [centre])
        alike = drift_kernel([self.measurement], max(DRIFT_MEMORY.values()))
        unit = usual_twist(self.measurement.length_unit)
        of_mount = frames.adjoint(frames.make(np.eye(3), -centre) @ own.hand_eye_frames(self.model.T_mount))
        of_part = np.tile(np.eye(6), (len(unconstrained.poses), 1, 1))
        for name, moved in (("wandering mount", of_mount), ("wandering part", of_part)):
            errors = errors.with_component(name, process_covariance((moved * unit).reshape(-1, 6), alike), 1.0)
        for place, columns in self._by_place(_thin_correspondences(unconstrained)).items():
            errors = errors.with_component(place, columns @ columns.T, 1.0)
        return errors

    def _by_place(self, unconstrained: UnconstrainedPoses) -> dict[str, Array]:
        """(6V, P) twists by the effects of each place of the chain, one column a parameter, of usual size."""
        physical = [e for e in EFFECTS.values() if e.tier == "physical" and not _is_event(e)]
        terms = [term_of(self.measurement, e) for e in physical if not missing_need(self.measurement, e)]
        columns = [
            response.columns[:, ~term.gridded] * term.typical[~term.gridded]
            for term, response in zip(
                terms, view_responses(self.measurement, self.model, terms, unconstrained), strict=True
            )
        ]
        places = dict.fromkeys(term.effect.place for term in terms)
        return {
            place: np.hstack([c for term, c in zip(terms, columns, strict=True) if term.effect.place == place])
            for place in places
        }


def _thin_correspondences(unconstrained: UnconstrainedPoses) -> UnconstrainedPoses:
    """The same with fewer correspondences, each of more weight: what an effect roughly does to poses needs no more."""
    every = -(-sum(len(m.residual) for m in unconstrained.overlaps.matches) // _MAX_CORRESPONDENCES) or 1
    thinned = [
        replace(
            m,
            middle=m.middle[::every],
            normal=m.normal[::every],
            residual=m.residual[::every],
            weight=every * m.weight[::every],
            index_v=m.index_v[::every],
            index_w=m.index_w[::every],
        )
        for m in unconstrained.overlaps.matches
    ]
    return replace(unconstrained, overlaps=replace(unconstrained.overlaps, matches=thinned))


def _is_event(effect: Effect) -> bool:
    """True for a step between two views: blocks of views are tested as such."""
    return any(spec.grid == EVERY_VIEW for spec in effect.specs.values())
