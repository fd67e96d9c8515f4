"""What the correction of a model from overlapping surfaces found."""

from dataclasses import dataclass

from stitch.measurement.capture import Capture
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.hand_eye import HandEyeFit
from stitch.observations.surfaces.overlaps import Overlaps


@dataclass(frozen=True)
class Correction:
    """The model of a rig; overlaps, freed poses and captures in the order of its sessions."""

    model: Model
    hand_eye: HandEyeFit  # its statistics
    overlaps: tuple[Overlaps, ...]
    unconstrained: tuple[UnconstrainedPoses, ...]  # views moved by the overlaps alone: where register starts
    history: tuple[float, ...]  # rms per iteration
    captures: tuple[Capture, ...]  # without the effects in use
    given: bool = False  # the model is that of another run, nothing was fitted
