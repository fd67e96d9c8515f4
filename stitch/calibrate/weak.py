"""What a hand-eye's covariance says in words: which components are weak, and how little the wrist turned."""

import numpy as np

from stitch import frames
from stitch.calibrate.motions import axis_spread
from stitch.errors import NoResultError
from stitch.frames import Array

# A component is weak where it is this many times worse known than one view is measured.
_WEAK = 3.0
# Wrists that turn less than this between any two views hardly turn (rad).
_LITTLE = np.radians(45.0)
_PARALLEL = np.sin(np.radians(3.0))
# Views to compare in pairs; more are thinned out evenly.
_VIEWS = 60


def turned(G: Array) -> float:
    """Largest rotation angle (rad) between any two poses (V, 4, 4)."""
    thin = G[:: max(1, len(G) // _VIEWS)]
    return float(max(frames.angle_between(np.broadcast_to(T, thin.shape), thin).max() for T in thin))


def require_turns(G: Array) -> None:
    """Refuse poses under which translations of the hand-eye and of what it looks at are the same.

    Raises:
        NoResultError: no rotation between the views, or rotations about one axis alone.
    """
    spread = axis_spread(frames.inverse(G[:1]) @ G[1:]) if len(G) > 1 else np.zeros(3)
    if spread[0] == 0 or turned(G) < 1e-4:
        raise NoResultError("all views have one orientation: the translation cannot be found; turn the wrist both ways")
    if spread[1] < _PARALLEL:
        raise NoResultError(
            "all views are turned about one axis: the translation along it cannot be found; turn about another one too"
        )


def hardly_turned(G: Array) -> str | None:
    """One sentence where the wrist hardly turned."""
    angle = turned(G)
    if angle >= _LITTLE:
        return None
    return f"The wrist hardly turned: at most {np.degrees(angle):.0f}° between any two views; turn it by 90° or more"


def weak_components(covariance: Array, view_sigma: float, lever: float, unit: str) -> list[str]:
    """One phrase per component of the hand-eye, in the scanner's axes, that is badly known.

    Args:
        covariance: (6, 6) of the right perturbation, rotation first.
        view_sigma: how well one view measures a position, length unit.
        lever: distance at which a rotation shows as displacement.
    """
    sigma = np.sqrt(np.diag(covariance))
    out = []
    for axis, turn in zip("xyz", sigma[:3], strict=True):
        if turn * lever > _WEAK * view_sigma:
            moved = f"{turn * lever:.2g} {unit} at the target"
            out.append(f"rotation about scanner {axis}: {np.degrees(turn):.2g}°, {moved}")
    for axis, shift in zip("xyz", sigma[3:], strict=True):
        if shift > _WEAK * view_sigma:
            out.append(f"translation along scanner {axis}: {shift:.2g} {unit}")
    return out
