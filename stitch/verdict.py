"""The result of a run in one plain sentence."""

from stitch.repeatability import Repeatability

_MICROMETRES = {"mm": 1e3, "m": 1e6}
# Residuals within a quarter of the noise floor's square are noise; above, something else is there.
_NEAR_FLOOR = 1.1


def sentence(residual: float, registered: float, floor: float, scatter: Repeatability, length_unit: str) -> str:
    """What one hand-eye leaves, what the noise would leave, and where the difference sits."""
    to_um = _MICROMETRES[length_unit]
    left, after, noise = (f"{x * to_um:.3g} µm" for x in (residual, registered, floor))
    if residual < _NEAR_FLOOR * floor:
        return f"One hand-eye closes all overlaps to {left} rms, which the sensor's own noise ({noise}) explains."
    return (
        f"One hand-eye leaves {left} rms where the sensor's own noise would leave {noise}: the robot's poses "
        f"scatter by {scatter.translation * to_um:.3g} µm and {scatter.rotation * 1e3:.2g} mrad; moving each view "
        f"by its own correction leaves {after}."
    )
