"""What all calibrations of a hand-eye state: a covariance counted in views, its document, and what is weak.

A covariance from single points or coordinates takes every one as independent. The robot's pose errs once per view, so
views are the samples. Leaving a view out is one Newton step from the solution, from normal equations alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.hand_eye import axis_spread, motions_from_first
from stitch.numerics.least_squares import grouped_inflation
from stitch.session.session import SessionData

# A component is weak where it is this many times worse known than one view is measured.
_WEAK = 3.0
# Wrists that turn less than this between any two views hardly turn (rad).
_LITTLE = np.radians(45.0)
# Views to compare in pairs; more are thinned out evenly.
_VIEWS = 60


def jackknife(information: Array, gradient: Array, model: Array | None = None) -> tuple[Array, float, Array]:
    """Covariance (n, n) of a weighted least-squares solution, counted in V views by leaving out one at a time.

    Args:
        information: (V, n, n) JᵀWJ of each view.
        gradient: (V, n) JᵀWe of each view at the solution, e the residual.
        model: (n, n) covariance that the scatter of the residuals predicts; without it the inverse of
            the information, right where the weights W are inverse covariances.

    Returns:
        The model's covariance times the inflation; the inflation, the mean ratio of the jackknife's covariance to the
        model's, at least 1; and (V, n) how the parameters change without each view.

    The jackknife of Efron & Stein (1981, Ann. Statist. 9:586) never goes below the truth on average, so it only
    inflates.
    """
    count, n = gradient.shape
    total = information.sum(axis=0)
    model = np.linalg.inv(total) if model is None else model
    steps = np.zeros((count, n))
    for v in range(count):
        # Without a view whose loss makes the rest singular no step can be taken: it has no partner.
        steps[v] = np.linalg.lstsq(total - information[v], gradient[v], rcond=1e-12)[0]
    # Steps of few views hardly span the parameters: they say nothing about the spread.
    inflation = grouped_inflation(steps, model) if count > n / 2 + 2 else 1.0
    return model * inflation, inflation, steps


def hand_eye_document(
    kind: str, session: SessionData, T_mount: Array, covariance: Array, inflation: float, G: Array
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
    sentences = []
    angle = largest_turn(G)
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
    phrases = []
    for axis, turn in zip("xyz", sigma[:3], strict=True):
        if turn * lever > _WEAK * view_sigma:
            moved = f"{turn * lever:.2g} {unit} at the target"
            phrases.append(f"rotation about scanner {axis}: {np.degrees(turn):.2g}°, {moved}")
    for axis, shift in zip("xyz", sigma[3:], strict=True):
        if shift > _WEAK * view_sigma:
            phrases.append(f"translation along scanner {axis}: {shift:.2g} {unit}")
    return phrases
