"""What effects of the library may do to the views of a session before anybody knows of one.

A view that stands out from white scatter may do so by a blunder, or because the arm bends as arms do. The second is a
random effect (Searle, Casella and McCulloch 1992): every parameter of every effect is zero give or take its size, and
the views scatter accordingly, together and not one by one.
"""

import numpy as np

from stitch.effects.contract import EFFECTS, Effect
from stitch.effects.in_session import lacking
from stitch.effects.specs import EVERY_VIEW
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.term import term_of
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.view_responses import view_responses

# Standard deviation of a parameter, in usual sizes: effects of up to four times the usual size are not rare then.
_TIMES_USUAL = 2.0


def usual_twists(measurement: Measurement, model: Model, freed: FreePoses) -> Array:
    """Left twists of the views about the centre of the correspondences, one column a parameter, at its deviation.

    Returns:
        (6V, P) twists, reference frame, rad and length_unit.
    """
    effects = [e for e in EFFECTS.values() if e.tier == "physical" and not _event(e) and not lacking(measurement, e)]
    terms = [term_of(measurement, effect) for effect in effects]
    found = view_responses(measurement, model, terms, freed)
    columns = [
        response.columns[:, ~term.gridded] * term.typical[~term.gridded]
        for term, response in zip(terms, found, strict=True)
    ]
    return _TIMES_USUAL * np.hstack([np.zeros((6 * len(freed.poses), 0)), *columns])


def _event(effect: Effect) -> bool:
    """True for a step between two views: blocks of views are tested as such."""
    return any(spec.grid == EVERY_VIEW for spec in effect.specs.values())
