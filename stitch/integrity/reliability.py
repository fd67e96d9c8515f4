"""What could be wrong unseen: redundancy, minimal detectable and identifiable blunder, and what it would do.

Baarda (1968), "A testing procedure for use in geodetic networks". Redundancy numbers of a view are the eigenvalues of
Σ^½ N Σ^½, Σ the covariance of its pose and N the normal matrix of its own displacement: 0 where only the robot knows
the view, 1 where the others alone would do. A blunder δ is detected with the stated power where δᵀNδ reaches the
non-centrality λ₀ of the test, and identified where no other view's test is likely to look worse (Teunissen 2018).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from stitch.frames import Array
from stitch.integrity.blunders import FAMILY_WISE, Found
from stitch.integrity.view_model import ViewModel
from stitch.statistics.tails import chi2_limit, noncentral_chi2_tail, normal_limit

POWER = 0.8
# Share of cases in which the right view is to be named.
NAMED = 0.95
# A redundancy below this says that a direction is known to the robot alone.
WEAK_REDUNDANCY = 0.1
_DIRECTIONS = 64


@dataclass(frozen=True)
class Reliability:
    """Of one view."""

    redundancy: Array  # (6,) ascending, 0 … 1
    weak: tuple[str, ...]  # directions, reference frame, that the others hardly hold
    detectable: float  # length_unit: a shift this large is found whatever its direction
    detectable_rotation: float  # rad, about the middle of all correspondences
    identifiable: float  # length_unit: … and the right view is named
    hand_eye: (
        float  # length_unit: largest shift of the part that the smallest detectable one, missed, makes by the hand-eye
    )
    cloud: float  # length_unit: the same of the view in the stitched cloud, after registration


def reliability(model: ViewModel, found: Found) -> list[Reliability]:
    """For every view of a model, under the scatter that was found."""
    normal = normal_blocks(model, found)
    covariance = pose_covariance(model, found)
    pull = _hand_eye_pull(model, found)
    return [_of_view(model, normal, covariance[v], pull, v) for v in range(model.count)]


def noncentrality(degrees: int, tests: int, power: float = POWER) -> float:
    """λ₀ at which a χ² test of `tests`, family-wise, finds a blunder with the stated power."""
    return _noncentrality(degrees, tests, power)


@lru_cache(maxsize=64)
def _noncentrality(degrees: int, tests: int, power: float) -> float:
    limit = chi2_limit(FAMILY_WISE / tests, degrees)
    return float(brentq(lambda x: noncentral_chi2_tail(limit, degrees, x) - power, 1e-3, 1e3))


def normal_blocks(model: ViewModel, found: Found) -> Array:
    """(V, V, 6, 6) N_vw = L_vᵀPL_w: how a displacement of one view shows in the test of another."""
    PL = np.einsum("nm,wmj->wnj", found.under.P, model.views)
    return np.asarray(np.einsum("vni,wnj->vwij", model.views, PL, optimize=True))


def pose_covariance(model: ViewModel, found: Found) -> Array:
    """(V, 6, 6) covariance of the views' poses by the robot, rotations in 1/lever."""
    variances = found.fit.variances
    unit = np.repeat(variances[:2], 3)
    return np.asarray(np.einsum("vij,j,vkj->vik", model.carried, unit, model.carried))


def blunder_sizes(normal: Array, view: int, directions: Array) -> tuple[Array, Array]:
    """Minimal detectable and minimal identifiable factors (K,) on displacements (K, 6), rotations in 1/lever.

    Args:
        normal: (V, V, 6, 6) of `normal_blocks`.
    """
    views = len(normal)
    own = np.einsum("ki,ij,kj->k", directions, normal[view, view], directions)
    seen = own > 1e-12 * max(float(own.max()), 1e-300)
    safe = np.where(seen, own, 1.0)
    detectable = np.where(seen, np.sqrt(noncentrality(6, views) / safe), np.inf)
    others = [w for w in range(views) if w != view]
    shown = np.einsum("wij,kj->wki", normal[others, view], directions)
    inverse = np.linalg.pinv(normal[others, others], rcond=1e-9, hermitian=True)
    shared = np.einsum("wki,wij,wkj->wk", shown, inverse, shown, optimize=True).max(axis=0)
    # The statistics of the right view and of the most similar one differ by own − shared, with a standard deviation
    # of 2√(own − shared) for a blunder much larger than the scatter.
    lead = np.maximum(own - shared, 0.0)
    needed = 2 * normal_limit((1 - NAMED) / max(views - 1, 1))
    told = seen & (lead > 1e-9 * safe)
    identifiable = np.where(told, needed / np.sqrt(np.where(told, lead, 1.0)), np.inf)
    return detectable, np.maximum(detectable, identifiable)


def _of_view(model: ViewModel, normal: Array, covariance: Array, pull: Array, view: int) -> Reliability:
    N = normal[view, view]
    root = np.linalg.cholesky(covariance + 1e-12 * np.trace(covariance) * np.eye(6))
    values, vectors = np.linalg.eigh(root.T @ N @ root)
    weak = tuple(_named(root @ vectors[:, i]) for i in range(6) if values[i] < WEAK_REDUNDANCY)
    shifts = np.concatenate([np.zeros((_DIRECTIONS, 3)), _sphere(_DIRECTIONS)], axis=1)
    turns = np.concatenate([_sphere(_DIRECTIONS), np.zeros((_DIRECTIONS, 3))], axis=1)
    detectable, identifiable = blunder_sizes(normal, view, shifts)
    rotation = blunder_sizes(normal, view, turns)[0].max() / model.lever
    finite = np.where(np.isfinite(detectable), detectable, 0.0)[:, None] * shifts
    # Registration weighs the robot's pose against the overlaps: what stays is the share that only the robot knows.
    kept = np.eye(6) - covariance @ N
    left = np.linalg.norm((finite @ kept.T)[:, 3:], axis=1)
    pushed = np.linalg.norm((finite @ pull[view].T)[:, 3:], axis=1)
    return Reliability(
        redundancy=np.clip(values, 0, 1),
        weak=weak,
        detectable=float(detectable.max()),
        detectable_rotation=float(rotation),
        identifiable=float(identifiable.max()),
        hand_eye=float(pushed.max()),
        cloud=float(left.max()),
    )


def _hand_eye_pull(model: ViewModel, found: Found) -> Array:
    """(V, 6, 6) largest twist of a view, rotations in 1/lever, that one view displaced by 1 makes by the hand-eye."""
    mixed = model.mixed(found.further)
    inverse = np.linalg.inv(mixed.covariance(found.fit.variances)[0])
    X = model.hand_eye if found.further is None else np.column_stack([model.hand_eye, found.further])
    scale = 1 / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    scaled = X * scale
    gain = scale[:, None] * (
        np.linalg.pinv(scaled.T @ inverse @ scaled, rcond=1e-12, hermitian=True) @ scaled.T @ inverse
    )
    moved = np.einsum("vij,jn->vin", model.mount_twists, gain[:6])
    own = np.einsum("vin,wnj->wvij", moved, model.views, optimize=True)
    # Common to all views it is no error of the cloud: what counts is the displacement of single views against the mean.
    return np.asarray(np.abs(own - own.mean(axis=1, keepdims=True)).max(axis=1))


def _named(direction: Array) -> str:
    """The largest part of a displacement in words."""
    i = int(np.argmax(np.abs(direction)))
    return f"{'rotation about' if i < 3 else 'shift along'} {'xyz'[i % 3]}"


def _sphere(count: int) -> Array:
    """(count, 3) unit vectors, evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    phi = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(phi), r * np.sin(phi), z])
