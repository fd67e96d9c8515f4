"""What remains between the views however each of them is moved: no error of poses, joints or mount leaves that.

A seam or a ripple in the scanner's field, a corner that is off, a part that changes its shape: overlaps show it, and
the poses that fit best take only a share of it. Only beside the noise can it be seen that it is there.
"""

from collections.abc import Sequence

from stitch.diagnosis.thresholds import ALPHA_UNKNOWN
from stitch.model.term import Term
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError, field_error
from stitch.observations.surfaces.noise_floor import noise_floor
from stitch.observations.surfaces.surface_model import SurfaceObservation


def overlap_misfit_beyond_noise(linear: LinearModel, stated: float | None = None) -> float:
    """Rms (length_unit) of it beside the noise that the scans show, where it is more than that; else 0, and where no
    overlap of surfaces was observed.

    The noise is the scatter about the surface within each scan (`noise_floor.py`), whatever a data sheet says.

    Args:
        stated: noise of the scanner, for scans too small to show their own.
    """
    if not isinstance(linear.observation, SurfaceObservation):
        return 0.0
    surfaces = linear.observation
    freed, noise = (
        surfaces.unconstrained.overlaps,
        noise_floor(surfaces.capture, surfaces.unconstrained.overlaps, stated),
    )
    left = float(max(freed.gram.rms**2 - noise**2, 0.0) ** 0.5)
    return left if left > noise else 0.0


def find_scanner_error(linear: LinearModel, other_terms: Sequence[Term] = ()) -> FieldError | None:
    """Smooth errors of the scans where they are larger than every scanner's; None where overlaps show no such.

    It may be small beside the noise: many points average that, and not what is the same in every view.

    Args:
        other_terms: effects of points that may have any size.
    """
    if not isinstance(linear.observation, SurfaceObservation):
        return None
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, ALPHA_UNKNOWN, other_terms)
    return found if found.unusual else None
