"""The fit of a session that grows by one view at a time: each new view is matched with the others, once.

The first views are fitted as `correct` fits them. A further view is moved to where the surfaces of the others put it;
all pairs are then solved together from their correspondences, which are not searched again. That costs what the new
view costs, and V² numbers. `stitch.run` over all views is the fit that counts; this one says where it is going.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.correct import REUSE_GATE, Correction
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.hand_eye_fit import hand_eye_statistics, solve_hand_eye
from stitch.observations.surfaces.matching import (
    MINIMUM_OVERLAP,
    Match,
    match_pairs,
    near_pairs,
    sample_points,
    signed_distances,
)
from stitch.observations.surfaces.normal_equations import NEAR_NULL, Gram, Overlaps, next_gate, sum_matches
from stitch.observations.surfaces.view_poses import (
    SAMPLES,
    UnconstrainedPoses,
    unconstrained_poses,
    visible_step,
)
from stitch.session.capture import Capture, part_size
from stitch.session.scan import Scan

# A view that moves by less than this share of the robust sigma rests.
_CONVERGED = 5e-3
_MAXIMUM_ITERATIONS = 12
# Where all views together have moved by this share of the gate, their partners are searched anew.
_SEARCH_ANEW = 0.3


@dataclass(frozen=True)
class LiveFit:
    """The fit of the views that have come so far: hand-eye, and the poses that their overlaps alone give them."""

    capture: Capture
    T_mount: Array  # (4, 4) T_mount_scanner
    covariance: Array  # (6, 6) of T_mount·exp(ξ), scanner frame, rotation first
    unconstrained: UnconstrainedPoses  # relative to the poses under T_mount
    drifted: float = 0.0  # largest distance by which views moved since all partners were searched, length_unit

    @property
    def gate(self) -> float:
        """Distance within which partners are searched, length_unit."""
        return self.unconstrained.overlaps.gate


# Called with a capture, its free-network poses and a hand-eye (4, 4); returns the prior of pose errors, and the
# scanner's errors by source, as `solve_hand_eye` takes them.
ErrorPrior = Callable[[Capture, UnconstrainedPoses, Array], tuple[PoseErrors, dict[str, list[Array]]]]


def start_live_fit(correction: Correction) -> LiveFit:
    """Return the fit of the first views, as `correct` found it, ready for further ones."""
    capture, T_mount = correction.captures[0], correction.model.T_mount
    unconstrained = correction.unconstrained[0].relative_to(capture.poses(T_mount))
    return LiveFit(capture, T_mount, correction.hand_eye.covariance, unconstrained)


def place_view(fit: LiveFit, scan: Scan, T_reference_mount: Array, T_reference_flange: Array) -> tuple[LiveFit, float]:
    """Return the fit with a new view as its last one, and the share of its points that lie on another view's surface.

    First the new view alone is moved until it fits the others' surfaces, its gate narrowing; then all views are solved
    together from all correspondences.

    Args:
        T_reference_mount, T_reference_flange: (4, 4) poses of the new view, as in `Capture`.

    Raises:
        NoResultError: it overlaps with no other view.
    """
    capture = replace(
        fit.capture,
        scans=(*fit.capture.scans, scan),
        T_reference_mount=np.concatenate([fit.capture.T_reference_mount, T_reference_mount[None]]),
        T_reference_flange=np.concatenate([fit.capture.T_reference_flange, T_reference_flange[None]]),
    )
    model_poses = capture.poses(fit.T_mount)
    poses = np.concatenate([fit.unconstrained.poses, model_poses[-1:]])
    gate, last = REUSE_GATE * part_size([capture]), len(poses) - 1
    samples = [sample_points(s, SAMPLES) for s in capture.scans]
    matches = _match_last(capture, poses, gate, samples)
    for _ in range(_MAXIMUM_ITERATIONS):
        g = sum_matches(matches, len(poses))
        step = _last_step(g)
        poses[last] = frames.moved_about(g.centre, step, poses[last])
        gate = min(gate, max(next_gate(Overlaps([], matches, g, gate), capture), 0.6 * gate))
        matches = _match_last(capture, poses, gate, samples)
        if np.linalg.norm(step * g.displacement_factors) < _CONVERGED * g.scale and gate <= 1.01 * fit.gate:
            break
    solved = _solve_together(capture, poses, [*fit.unconstrained.overlaps.matches, *matches], min(gate, fit.gate))
    moved = np.linalg.norm(frames.log(frames.inverse(poses) @ solved.poses)[:, 3:], axis=1)
    matched = np.unique(np.concatenate([m.index_w for m in matches]))
    fitted = replace(
        fit,
        capture=capture,
        unconstrained=solved.relative_to(model_poses),
        drifted=fit.drifted + float(moved[:-1].max(initial=0.0)),
    )
    return fitted, float(np.isin(samples[last], matched).mean())


def fit_live_hand_eye(fit: LiveFit, prior: ErrorPrior) -> LiveFit:
    """Return the fit with its hand-eye and covariance fitted to the present poses of the views.

    Correspondences are searched anew if views have moved by more than `_SEARCH_ANEW` gates since the last search.

    Args:
        prior: returns the pose errors and the scanner's errors that the covariance is to count.
    """
    unconstrained = fit.unconstrained
    if fit.drifted > _SEARCH_ANEW * fit.gate:
        unconstrained = unconstrained_poses(fit.capture, fit.capture.poses(fit.T_mount), fit.gate)
    errors, of_scanner = prior(fit.capture, unconstrained, fit.T_mount)
    solution = solve_hand_eye([fit.capture], [unconstrained], fit.T_mount, scanner_errors=of_scanner)
    hand_eye = hand_eye_statistics(solution, errors, of_scanner)
    return LiveFit(
        fit.capture,
        hand_eye.T_mount,
        hand_eye.covariance,
        unconstrained.relative_to(fit.capture.poses(hand_eye.T_mount)),
        fit.drifted if unconstrained is fit.unconstrained else 0.0,
    )


def without_view(fit: LiveFit, view: int) -> LiveFit:
    """Return the fit without one view and its correspondences; the hand-eye stays as it is.

    Raises:
        NoResultError: no two of the others overlap.
    """
    old = fit.unconstrained.overlaps
    matches = [replace(m, v=m.v - (m.v > view), w=m.w - (m.w > view)) for m in old.matches if view not in (m.v, m.w)]
    capture = fit.capture.without(np.array([view]))
    if not matches:
        raise NoResultError(f"{capture.name}: no two views overlap")
    poses = np.delete(fit.unconstrained.poses, view, axis=0)
    solved = _solve_together(capture, poses, matches, old.gate)
    return replace(fit, capture=capture, unconstrained=solved.relative_to(capture.poses(fit.T_mount)))


def _match_last(capture: Capture, poses: Array, gate: float, samples: Sequence[Indices]) -> list[Match]:
    """Return the correspondences of the last view with every other one that it overlaps.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        gate: largest distance between corresponding points, length_unit.
        samples: per view the numbers of the points that are searched.

    Raises:
        NoResultError: it overlaps with no other view.
    """
    last = len(poses) - 1
    pairs = [pair for pair in near_pairs(capture.scans, poses, gate) if pair[1] == last]
    fewest = MINIMUM_OVERLAP * len(samples[last])
    matches = [m for m in match_pairs(capture.scans, poses, pairs, gate, samples)[0] if len(m.residual) > fewest]
    if not matches:
        raise NoResultError(f"{capture.scans[last].name}: it shares no surface with the other views")
    return matches


def _last_step(g: Gram) -> Array:
    """Return the left twist (6,), about the centre of `g`, that brings the last view onto the others, which are fixed.

    Zero in directions that the surfaces do not see. `g` holds pairs of the last view alone, as the second of each, so
    that the solution of the normal equations has the sign of +b.
    """
    unit = g.displacement_factors
    values, vectors = np.linalg.eigh(g.matrix.sum(axis=0) / np.outer(unit, unit))
    keep = values > NEAR_NULL * values[-1]
    pull = vectors[:, keep].T @ (g.vector.sum(axis=0) / unit)
    return vectors[:, keep] @ (pull / values[keep]) / unit


def _solve_together(capture: Capture, poses: Array, matches: list[Match], gate: float) -> UnconstrainedPoses:
    """Return the views moved by two Gauss–Newton steps of all known correspondences, which are not searched again.

    The twists of the result are zeros: `relative_to` fills them in.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        gate: largest distance between corresponding points, length_unit, recorded with the overlaps.
    """
    points = [scan.points for scan in capture.scans]
    for _ in range(2):
        ends = np.cumsum([len(m.residual) for m in matches])[:-1]
        residuals = np.split(signed_distances(matches, poses, points), ends)
        matches = [replace(m, residual=e) for m, e in zip(matches, residuals, strict=True)]
        g = sum_matches(matches, len(poses))
        step = visible_step(g)
        poses = frames.moved_about(g.centre, step, poses)
    overlaps = Overlaps([(m.v, m.w) for m in matches], matches, g, gate)
    return UnconstrainedPoses(poses, np.zeros((len(poses), 6)), overlaps)
