"""What a calibrated hand-eye's covariance says: which components are weak, and how little the wrist turned."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch import frames
from stitch.closed_form.relative_motions import axis_spread, motions_from_first
from stitch.frames import Array
from stitch.measurement.session import Session

# A component is weak where it is this many times worse known than one view is measured.
_WEAK = 3.0
# Wrists that turn less than this between any two views hardly turn (rad).
_LITTLE = np.radians(45.0)
# Views to compare in pairs; more are thinned out evenly.
_VIEWS = 60


def hand_eye_document(
    kind: str, session: Session, T_mount: Array, covariance: Array, inflation: float, G: Array
) -> dict[str, Any]:
    """What the JSON documents of all calibrations of a hand-eye share.

    Args:
        T_mount: (4, 4) T_mount_scanner.
        covariance: (6, 6) of its right perturbation, rotation first.
        inflation: what leaving views out put on the covariance.
        G: (V, 4, 4) poses of the views.
    """
    R = T_mount[:3, :3]
    return {
        "format": "stitch-calibrate/1",
        "kind": kind,
        "session": session.name,
        "mount": session.mount,
        "length_unit": session.length_unit,
        "hand_eye": T_mount.tolist(),
        "hand_eye_sigma": np.sqrt(np.diag(covariance)).tolist(),
        "hand_eye_covariance": covariance.tolist(),
        "translation_sigma_mount": np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T)).tolist(),
        "covariance_inflation": inflation,
        "turned_deg": float(np.degrees(largest_turn(G))),
        "axis_spread": axis_spread(motions_from_first(G)).tolist(),
    }


def largest_turn(G: Array) -> float:
    """Largest rotation angle (rad) between any two poses (V, 4, 4)."""
    thin = G[:: max(1, len(G) // _VIEWS)]
    return float(max(frames.angle_between(np.broadcast_to(T, thin.shape), thin).max() for T in thin))


def weak_notes(G: Array, weak: Sequence[str]) -> list[str]:
    """At most one sentence: the wrist hardly turned, and which components of the hand-eye are weak."""
    sentences, angle = [], largest_turn(G)
    if angle < _LITTLE:
        sentences.append(
            f"The wrist hardly turned: at most {np.degrees(angle):.0f}° between any two views; turn it by 90° or more"
        )
    if weak:
        sentences.append(f"Weak: {'; '.join(weak)}")
    return [". ".join(sentences)] if sentences else []


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
