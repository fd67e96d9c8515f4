"""What a session says about what its model lacks: from overlaps, or from labelled points as they are."""

from stitch.measurement.labelled_points import Nominal
from stitch.measurement.measurement import Measurement
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.free_poses import free_poses
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.targets.landmarks import drawing_of
from stitch.observations.targets.target_model import target_model


def linearise(measurement: Measurement, model: Model, gate: float, nominal: Nominal | None = None) -> LinearModel:
    """Linearise a session about its model.

    Args:
        gate: largest distance between partners, length_unit; NaN without clouds.
        nominal: positions of the targets in the part frame.

    Raises:
        NoResultError: no two views overlap.
    """
    sightings = measurement.capture.sightings
    if not measurement.capture.scans and sightings is not None:
        return target_model(measurement, model, drawing_of(nominal, sightings))
    own = corrected(measurement, model)
    return surface_model(measurement, model, own, free_poses(own, own.poses(model.T_mount), gate))
