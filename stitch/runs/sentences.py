"""The result of a run in plain sentences."""

import numpy as np

from stitch.observations.surfaces.pose_channel import Repeatability
from stitch.units import MICROMETRES
from stitch.stages.coarse import Coarse

# Residuals within a quarter of the noise floor's square are noise; above, something else is there.
_NEAR_FLOOR = 1.1


def sentence(residual: float, registered: float, floor: float, scatter: Repeatability, length_unit: str) -> str:
    """What one hand-eye leaves, what the noise would leave, and where the difference sits."""
    to_um = MICROMETRES[length_unit]
    left, after, noise = (f"{x * to_um:.3g} µm" for x in (residual, registered, floor))
    if residual < _NEAR_FLOOR * floor:
        return f"One hand-eye closes all overlaps to {left} rms, which the sensor's own noise ({noise}) explains."
    return (
        f"One hand-eye leaves {left} rms where the sensor's own noise would leave {noise}: the robot's poses "
        f"scatter by {scatter.translation * to_um:.3g} µm and {scatter.rotation * 1e3:.2g} mrad; moving each view "
        f"by its own correction leaves {after}."
    )


def correct_note(before: float, after: float) -> str:
    """Why the correction may leave a larger rms than it found."""
    if after > before:
        return "views weighed by the robot's scatter: the hand-eye is more certain, single overlaps fit less tightly"
    return ""


def coarse_note(start: Coarse) -> str:
    """Where the hand-eye came from, and how far the second answer was."""
    if not start.candidates:
        return start.source
    best = start.candidates[0]
    tried = sum(c.reached for c in start.candidates)
    found = f"found from {best.source}; {best.reached} of {tried} starts ended there"
    if len(start.candidates) == 1:
        return f"{found}, no other answer"
    return f"{found}, the runner-up is {start.runner_up_ratio:.1f} times worse"


def warnings(start: Coarse, inflation: float) -> tuple[str, ...]:
    """What a user should know before trusting the hand-eye."""
    notes = []
    if start.candidates and start.runner_up_ratio < 1.1:
        notes.append(
            f"Two different hand-eyes fit almost equally well (ratio {start.runner_up_ratio:.2f}): "
            "give scanner.pose, or add views with other orientations."
        )
    if inflation > 2.5:
        notes.append(
            f"Few views, or views that leave the hand-eye {np.sqrt(inflation):.1f} times less certain than independent "
            "pose errors would: its sigma was widened by that factor."
        )
    return tuple(notes)
