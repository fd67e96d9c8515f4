"""Where each view would go if the robot did not hold it: the evidence about poses, view by view.

One linear step at the model's poses would understate it: nearest neighbours along the surface follow
the error. Matching anew until nothing moves removes that pull. Directions that the overlaps cannot
see (a sphere turned in itself) stay where the robot put them.
"""

from dataclasses import dataclass, replace

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.least_squares import anderson_step
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import Gram, Overlaps, carry_overlaps, collect_overlaps, next_gate
from stitch.session.capture import Capture

# Queries per view.
SAMPLES = 1500
_MAXIMUM_ITERATIONS = 12
_CONVERGED = 5e-3
# Measured noise of a pair's scans that is so many times the distance left between them is a shape taken for noise.
_MORE_THAN_LEFT = 2.0
# The step (6V,) that was asked for, and the one that was taken, as displacements; None before the first.
LastStep = tuple[Array, Array] | None


@dataclass(frozen=True)
class UnconstrainedPoses:
    """Views moved by overlaps and common targets alone."""

    poses: Array  # (V, 4, 4) T_reference_scanner
    twists: Array  # (V, 6) about the centre of `overlaps.gram`: from the model's poses to these
    overlaps: Overlaps  # at `poses`

    def relative_to(self, model_poses: Array) -> "UnconstrainedPoses":
        """Return the same poses with their twists from other poses of a model, T_reference_scanner (V, 4, 4)."""
        return replace(self, twists=frames.twists_about(self.overlaps.gram.centre, model_poses, self.poses))


def unconstrained_poses(
    capture: Capture, model_poses: Array, gate: float, before: Overlaps | None = None
) -> UnconstrainedPoses:
    """Return the poses at which overlaps and common targets agree best, without regard to the robot.

    Each iteration matches points within the gate, takes one Gauss–Newton step of all views, and narrows the gate. It
    ends when a step is small beside the residuals' scatter, or at `_MAXIMUM_ITERATIONS`, where the last poses count.

    Args:
        model_poses: T_reference_scanner (V, 4, 4), where the views begin.
        gate: largest distance between corresponding points in the first iteration, length_unit.
        before: overlaps at poses near by, whose search goes on (`collect_overlaps`); None: all is searched.

    Raises:
        NoResultError: no two views overlap.
    """
    samples = [sample_points(scan, SAMPLES) for scan in capture.scans]
    poses = np.array(model_poses)
    overlaps = collect_overlaps(capture, poses, gate, samples, before)
    last: LastStep = None
    for _ in range(_MAXIMUM_ITERATIONS):
        step = visible_step(overlaps.gram)
        if has_converged(overlaps.gram, step, _CONVERGED):
            break
        start = poses
        ends = is_last_step(overlaps.gram, step, last, _CONVERGED)
        poses, last = take_step(poses, overlaps.gram, step, last)
        if ends:
            # The next step would be too small to matter: new partners are not worth a search.
            overlaps = carry_overlaps(capture, overlaps, start, poses)
            break
        gate = min(gate, next_gate(overlaps, capture))
        overlaps = collect_overlaps(capture, poses, gate, samples, overlaps)
    twists_unset = np.zeros((len(poses), 6))
    return UnconstrainedPoses(poses, twists_unset, overlaps).relative_to(model_poses)


def take_step(poses: Array, g: Gram, step: Array, last: LastStep) -> tuple[Array, LastStep]:
    """Return the poses T_reference_scanner (V, 4, 4) after a step, and this step as the `last` of the next call.

    The step (V, 6), left twists about the centre of the overlaps, is lengthened by Anderson's rule from the step before
    (`anderson_step`): iterations of nearest neighbours stop short of where they lead.
    """
    factors = g.displacement_factors
    proposed = (step * factors).ravel()
    taken = proposed if last is None else anderson_step(proposed, *last)
    return frames.moved_about(g.centre, taken.reshape(-1, 6) / factors, poses), (proposed, taken)


def has_converged(g: Gram, step: Array, share: float) -> bool:
    """Return True if a step (V, 6) translates the views by less than a share of the robust sigma, rms."""
    return bool(np.sqrt(np.mean(step[:, 3:] ** 2)) < share * g.scale)


def is_last_step(g: Gram, step: Array, last: LastStep, share: float) -> bool:
    """Return whether the step after this one would be small enough to end: a share of the robust sigma, as predicted.

    Steps are predicted to shrink by the ratio of this one to the last. Then new partners are not worth a search.

    Args:
        step: (V, 6) left twists about the centre of the overlaps.
        last: the step before; None in the first iteration, which is never the last.
        share: of the residuals' robust sigma, as in `has_converged`.
    """
    if last is None:
        return False
    ratio = np.linalg.norm(step * g.displacement_factors) / np.linalg.norm(last[0])
    return has_converged(g, ratio * step, share)


def visible_step(g: Gram) -> Array:
    """Return the Gauss–Newton step (V, 6) of all views in the directions that overlaps and targets see."""
    return -solve_views(g, g.vector[..., None]).reshape(-1, 6)


def solve_views(g: Gram, pair_vectors: Array) -> Array:
    """Return H⁺b (6V, K): twists of the views that solve the normal equations, for K right-hand sides given by pair.

    Args:
        g: normal equations of the views, with H⁺ in the directions that they see.
        pair_vectors: Σ w Bᵀg (P, 6, K) of each pair of views; it acts on the first view and, negative, on the second.
    """
    every = np.broadcast_to(np.arange(pair_vectors.shape[2]), (len(g.pairs), pair_vectors.shape[2]))
    return solve_view_sums(g, *sum_on_views(g, pair_vectors, every))


def sum_on_views(g: Gram, pair_vectors: Array, parameter: Indices) -> tuple[Array, Array]:
    """Return Σ w Bᵀg (6V, K) on the views, for K parameters given by pair: by overlaps of surfaces, by labelled points.

    Both are judged differently, hence apart. A pair acts on its first view and, negative, on its second.

    Args:
        pair_vectors: Σ w Bᵀg (P, 6, C) of each pair of views.
        parameter: (P, C) the parameter that each of these columns stands for; several may stand for one.
    """
    by_kind = np.zeros((2, g.views, int(parameter.max(initial=-1)) + 1, 6))
    kind = g.labelled.astype(np.int64)[:, None]
    v, w = g.pairs.astype(np.int64).T
    vectors = np.moveaxis(pair_vectors, 1, 2)
    np.add.at(by_kind, (kind, v[:, None], parameter), vectors)
    np.subtract.at(by_kind, (kind, w[:, None], parameter), vectors)
    by_surfaces, by_targets = np.moveaxis(by_kind, 2, 3).reshape(2, 6 * g.views, -1)
    return by_surfaces, by_targets


def solve_view_sums(g: Gram, by_surfaces: Array, by_targets: Array) -> Array:
    """Return H⁺b (6V, K): twists of the views that solve the normal equations, for K right-hand sides given by view.

    H⁺ = S V Λ⁻¹ Vᵀ S, with the scale S of twists, and eigenvectors V and eigenvalues Λ of the directions seen.

    Args:
        by_surfaces: (6V, K) part of b by the overlaps of surfaces.
        by_targets: (6V, K) part of b by labelled points.
    """
    seen = g.visible
    scale, vectors, surface_basis = seen.scale[:, None], seen.vectors, seen.of_surfaces
    b = scale * by_surfaces
    if g.labelled.any():
        # Where surfaces see nothing, their part is noise of normals: there only that of the targets counts.
        b = scale * by_targets + surface_basis @ (surface_basis.T @ b)
    return scale * (vectors @ ((vectors.T @ b) / seen.values[:, None]))


def noise_floor(capture: Capture, overlaps: Overlaps, stated: float | None = None) -> float:
    """Return the rms distance (length_unit) between surfaces at perfect poses, by the scanner's noise alone.

    It is √(σ_v² + σ_w²), over all pairs. σ of a view is the noise measured in its own scan, about local quadrics. A
    quadric may take a shape for noise; so the result is at most the rms that is left once every view was free to move,
    corrected for the 6 (V − 1) numbers that this used. The same limit holds for a pair, with some tolerance.

    Args:
        overlaps: of the registered views.
        stated: scanner.noise of the session, σ of scans that are too small to measure it; None: not known.
    """
    sigma = np.array([scan.noise for scan in capture.scans])
    sigma = np.where(np.isfinite(sigma), sigma, np.nan if stated is None else stated)
    pairs = overlaps.gram.pairs[~overlaps.gram.labelled]
    count = overlaps.gram.count[~overlaps.gram.labelled]
    variance = sigma[pairs[:, 0]] ** 2 + sigma[pairs[:, 1]] ** 2
    left = overlaps.gram.raw_square[~overlaps.gram.labelled] / np.maximum(count, 1)
    variance = np.where(variance > _MORE_THAN_LEFT**2 * left, left, variance)
    measured = float(np.sqrt(np.average(variance, weights=np.maximum(count, 1))))
    spare = 1 - 6 * (len(sigma) - 1) / max(count.sum(), 1)
    return min(measured, overlaps.gram.rms / np.sqrt(spare)) if spare > 0 else measured
