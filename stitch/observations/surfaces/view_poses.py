"""Where each view would go if the robot did not hold it: the evidence about poses, view by view.

One linear step at the model's poses would understate it: nearest neighbours along the surface follow
the error. Matching anew until nothing moves removes that pull. Directions that the overlaps cannot
see (a sphere turned in itself) stay where the robot put them.
"""

from dataclasses import dataclass, replace

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import anderson_step
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import Gram, Overlaps, carry_overlaps, collect_overlaps, next_gate
from stitch.session.capture import Capture

# Queries per view.
SAMPLES = 1500
_MAXIMUM_ITERATIONS = 12
_CONVERGED = 5e-3
# Noise of a pair's scans that is so many times what is left between them is a shape, beyond what chance leaves of few.
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
        """The same views against another model, (V, 4, 4): where overlaps put them does not depend on it."""
        to_centre = frames.make(np.eye(3), -self.overlaps.gram.centre)
        return replace(self, twists=frames.log(to_centre @ self.poses @ frames.inverse(to_centre @ model_poses)))


def unconstrained_poses(
    capture: Capture, model_poses: Array, gate: float, before: Overlaps | None = None
) -> UnconstrainedPoses:
    """Move all views until overlaps and common targets agree, without regard to the robot.

    Args:
        model_poses: T_reference_scanner (V, 4, 4).
        gate: first distance between partners, length_unit.
        before: at poses near by; its pairs of views serve again.

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
            overlaps = carry_overlaps(capture, overlaps, start, poses)
            break
        gate = min(gate, next_gate(overlaps, capture))
        overlaps = collect_overlaps(capture, poses, gate, samples, overlaps)
    return UnconstrainedPoses(poses, np.zeros((len(poses), 6)), overlaps).relative_to(model_poses)


def take_step(poses: Array, g: Gram, step: Array, last: LastStep) -> tuple[Array, LastStep]:
    """T_reference_scanner (V, 4, 4) after a step (V, 6) about the centre, which makes up for what the last one left."""
    unit = g.displacement_factors
    asked = (step * unit).ravel()
    taken = asked if last is None else anderson_step(asked, *last)
    return frames.moved_about(g.centre, taken.reshape(-1, 6) / unit, poses), (asked, taken)


def has_converged(g: Gram, step: Array, share: float) -> bool:
    """True if a step (V, 6) moves the views by less than a share of the robust sigma, rms."""
    return bool(np.sqrt(np.mean(step[:, 3:] ** 2)) < share * g.scale)


def is_last_step(g: Gram, step: Array, last: LastStep, share: float) -> bool:
    """Return whether the step (V, 6) after this one converges, as the ratio of this one to the last foretells.

    Then nothing is to be learnt from new partners: the step is taken, and those at hand are carried along.
    """
    if last is None:
        return False
    ratio = np.linalg.norm(step * g.displacement_factors) / np.linalg.norm(last[0])
    return has_converged(g, ratio * step, share)


def visible_step(g: Gram) -> Array:
    """Return the Gauss–Newton step (V, 6) of all views in the directions that overlaps and targets see."""
    return -solve_views(g, g.vector[..., None]).reshape(-1, 6)


def solve_views(g: Gram, pair_vectors: Array) -> Array:
    """Return twists H⁺b (6V, K) of the views when pulls (P, 6, K), Σ w Bᵀg, act on the pairs."""
    pulls = []
    for keep in (~g.labelled, g.labelled):
        b = np.zeros((g.views, 6, pair_vectors.shape[2]))
        v, w = g.pairs[keep].astype(np.int64).T
        np.add.at(b, v, pair_vectors[keep])
        np.subtract.at(b, w, pair_vectors[keep])
        pulls.append(b.reshape(6 * g.views, -1))
    return solve_view_sums(g, *pulls)


def solve_view_sums(g: Gram, by_surfaces: Array, by_targets: Array) -> Array:
    """Return the same (6V, K) where pulls on the views are given: (6V, K) of surfaces, and of labelled points."""
    seen = g.visible
    scale, vectors, by_normals = seen.scale[:, None], seen.vectors, seen.of_surfaces
    b = scale * by_surfaces
    if g.labelled.any():
        # Where surfaces see nothing, their pull is noise of normals: there the targets' own counts alone.
        b = scale * by_targets + by_normals @ (by_normals.T @ b)
    return scale * (vectors @ ((vectors.T @ b) / seen.values[:, None]))


def noise_floor(capture: Capture, overlaps: Overlaps, stated: float | None = None) -> float:
    """Return the rms (length_unit) that noise leaves between surfaces at perfect poses: √(σ_v² + σ_w²) over all pairs.

    σ of each view is measured in its own scan, across local quadrics; where the scans are too small
    for that, `stated` (scanner.noise of the session) stands in. Noise cannot leave more than what was left
    once every view was free to move: where quadrics took a shape for noise, that is the floor, of a pair as of all.

    Args:
        overlaps: of the registered views.
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
