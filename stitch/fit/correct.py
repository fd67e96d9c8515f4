"""Correct the hand-eye from the scans themselves: symmetric point-to-plane over one common ξ.

All overlapping pairs, nearest neighbours in both directions, one ξ for every view of every session
of the rig, T ← T·exp(ξ) (source A, step 3). Matching tightens from the data's own scale; a last
generalised least-squares step weighs the views by the robot's own scatter (`hand_eye_fit.py`). A hand-eye that was
corrected on another object of the same rig is used as it is: only the overlaps are found.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.errors import NoResultError
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import symmetric_inverse
from stitch.observations.observability import seen_part, visible_twists
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.hand_eye_fit import (
    HandEyeFit,
    HandEyeSolution,
    Repeatability,
    capture_repeatability,
    hand_eye_jacobian,
    hand_eye_statistics,
    solve_hand_eye,
)
from stitch.observations.surfaces.normal_equations import (
    FINE_SAMPLES,
    Overlaps,
    assemble,
    collect_overlaps,
    common_samples,
    next_gate,
    pooled_rms,
)
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.recorder import Recorder, SilentRecorder
from stitch.session.capture import Capture, part_size
from stitch.system.process import announce

# Queries per view, at most, while the gate closes; the final normal equations take FINE_SAMPLES. While partners may lie
# farther away than so many spacings, a quarter of them do: what is missing is not points, but the right partners.
COARSE_SAMPLES = 600
_WIDE_SAMPLES, _WIDE_SPACINGS = 150, 4.0
_MAXIMUM_ITERATIONS = 40
# A step that moves the part by less than this share of the robust sigma changes nothing: views that are moved by their
# overlaps alone tell what is left. After one below the second share the gate closes at once to what the distances ask.
_CONVERGED, _AT_REST = 1e-2, 0.1
# A corrected hand-eye leaves the robot's pose errors: some percent of the part at most.
REUSE_GATE = 0.05
# Rounds of matching in which the gate of a given hand-eye narrows at most; a smaller change of it ends them.
_TIGHTENINGS, _GATE_CONVERGED = 4, 0.99
# While the hand-eye is corrected, a gate that keeps this share of itself has settled.
_GATE_SETTLED = 0.9
# No scanner stands farther from its mount than so many times the size of what it sees.
_FARTHEST = 1e3

# Called with the free-network poses per capture; returns by source, per capture, left twists (6V, K) of the views per
# sigma of the scanner's errors that all views repeat.
ScannerErrors = Callable[[Sequence[UnconstrainedPoses]], dict[str, list[Array]]]
# Called with the free-network poses per capture and a hand-eye (4, 4); returns the prior of pose errors.
PoseErrorPrior = Callable[[Sequence[UnconstrainedPoses], Array], PoseErrors]


@dataclass(frozen=True)
class Correction:
    """The corrected model of a rig; tuples have one entry per session."""

    geometry: Model  # hand-eye and effects; the covariance of the hand-eye may be missing, see `model`
    statistics: Callable[[], HandEyeFit]  # computes the hand-eye's covariance, for which register need not wait
    scatter: tuple[Repeatability, ...]  # of the poses
    overlaps: tuple[Overlaps, ...]  # under the corrected model
    unconstrained: tuple[UnconstrainedPoses, ...]  # views moved by the overlaps alone: where register starts
    history: tuple[float, ...]  # rms per iteration, length_unit
    captures: tuple[Capture, ...]  # with the effects in use taken out
    given: bool = False  # the model is that of another run, nothing was fitted

    @cached_property
    def hand_eye(self) -> HandEyeFit:
        """The hand-eye with its covariance and other statistics, computed when it is first asked for."""
        return self.statistics()

    @property
    def model(self) -> Model:
        """The model with the covariance of its hand-eye, which is computed for it."""
        return replace(self.geometry, covariance=self.hand_eye.covariance)


def correct(
    captures: Sequence[Capture],
    T_mount: Array,
    gate: float,
    recorder: Recorder | None = None,
    scanner_errors: ScannerErrors | None = None,
    pose_error_prior: PoseErrorPrior | None = None,
    met: Sequence[Overlaps] | None = None,
) -> Correction:
    """Return the hand-eye corrected from all overlapping pairs of all captures of a rig.

    Three stages: ICP of the hand-eye alone; each view moved by its overlaps alone; generalised least squares of the
    hand-eye over these poses, linearised twice. The covariance is computed when it is first asked for.

    Args:
        captures: one per session; all carry the same scanner on the same mount.
        T_mount: (4, 4) coarse hand-eye, maps scanner to mount.
        gate: largest distance between corresponding points at first, length_unit: the coarse error at the part.
        scanner_errors: returns errors of the scanner that all views share; they widen the covariance. None: no errors.
        pose_error_prior: returns the pose errors beside white scatter; None: there are none.
        met: overlaps per capture under the coarse hand-eye; None: they are searched.

    Raises:
        NoResultError: no two views of a capture overlap, or the hand-eye runs away.
    """
    T_mount, overlaps, history = icp_hand_eye(captures, T_mount, [gate] * len(captures), first=met, recorder=recorder)
    gates = [next_gate(o, c) for o, c in zip(overlaps, captures, strict=True)]
    announce("correct: what every view tells of its pose")
    unconstrained = tuple(
        unconstrained_poses(c, c.poses(T_mount), gate, o) for c, gate, o in zip(captures, gates, overlaps, strict=True)
    )
    first = solve_hand_eye(captures, unconstrained, T_mount)
    T_first = first.T_mount
    require_near_scanner(captures, T_first)
    # With large pose errors the step is not linear, and what is not would count as noise: hence a second one.
    captures, unconstrained = _linearised_about(first, captures, unconstrained, gates)
    # Errors of several scanners do not weigh here: their places are fitted from this hand-eye on, and there they do.
    solved = solve_hand_eye(captures, unconstrained, T_first)
    require_near_scanner(captures, solved.T_mount)

    def statistics() -> HandEyeFit:
        """Return the hand-eye of the last solution with its covariance."""
        common = None if scanner_errors is None else scanner_errors(unconstrained)
        errors = None if pose_error_prior is None else pose_error_prior(unconstrained, T_first)
        return hand_eye_statistics(solved, errors, common)

    announce("correct: what the corrected hand-eye leaves")
    final = tuple(
        collect_overlaps(c, c.poses(solved.T_mount), gate, before=f.overlaps)
        for c, f, gate in zip(captures, unconstrained, gates, strict=True)
    )
    return Correction(
        geometry=Model(solved.T_mount),
        statistics=statistics,
        scatter=solved.scatter,
        overlaps=final,
        unconstrained=unconstrained,
        history=(*history, pooled_rms(final)),
        captures=tuple(captures),
    )


def _linearised_about(
    first: HandEyeSolution,
    captures: Sequence[Capture],
    unconstrained: Sequence[UnconstrainedPoses],
    gates: Sequence[float],
) -> tuple[list[Capture], tuple[UnconstrainedPoses, ...]]:
    """Return captures with the noise factor of a first solution, and their free views as seen from its hand-eye.

    The noise factor changes how clouds weigh beside labelled points: where there are such, views are moved anew.
    """
    T_mount = first.T_mount
    captures = [with_noise_factor(c, scatter) for c, scatter in zip(captures, first.scatter, strict=True)]
    return captures, tuple(
        f.relative_to(c.poses(T_mount)) if c.sightings is None else unconstrained_poses(c, c.poses(T_mount), gate)
        for c, f, gate in zip(captures, unconstrained, gates, strict=True)
    )


def require_near_scanner(captures: Sequence[Capture], T_mount: Array) -> None:
    """Refuse a hand-eye whose scanner lies implausibly far from the flange: the fit has run away.

    Raises:
        NoResultError: it does.
    """
    if not np.linalg.norm(T_mount[:3, 3]) < _FARTHEST * part_size(captures):
        raise NoResultError(
            "these views hold the hand-eye nowhere: what the scans show hardly follows the poses; to fix: check that "
            "poses and scans belong together, and turn the flange more between views"
        )


def icp_hand_eye(
    captures: Sequence[Capture],
    T_mount: Array,
    gates: Sequence[float],
    *,
    first: Sequence[Overlaps] | None = None,
    samples: int = COARSE_SAMPLES,
    maximum: int = _MAXIMUM_ITERATIONS,
    recorder: Recorder | None = None,
) -> tuple[Array, list[Overlaps], list[float]]:
    """Return T_mount (4, 4) by ICP: matching and one step of the hand-eye, repeated until it no longer moves the part.

    It ends at a step below `_CONVERGED` sigmas while the gates no longer close, or silently after `maximum`.

    Args:
        T_mount: (4, 4) start, maps scanner to mount.
        gates: per capture the largest distance between corresponding points at first, length_unit.
        first: overlaps per capture under the start; None: they are searched.
        samples: points of a view that are searched in others, at most; fewer while the gate is wide.

    Returns:
        T_mount, the last overlaps per capture, and the rms per iteration, length_unit.
    """
    recorder = recorder or SilentRecorder()
    coarse_queries = [common_samples(c.scans, min(samples, _WIDE_SAMPLES)) for c in captures]
    fine_queries = [common_samples(c.scans, samples) for c in captures]
    gates = list(gates)
    history: list[float] = []
    part = seen_part(captures)
    before: Sequence[Overlaps | None] = [None] * len(captures)
    # Few points do while the gates are wide, until the hand-eye has come to rest with these.
    few_points_do = True
    for index in range(maximum):
        is_wide = few_points_do and all(
            gate > _WIDE_SPACINGS * c.spacing for c, gate in zip(captures, gates, strict=True)
        )
        if first is not None and index == 0:
            overlaps = list(first)
        else:
            inputs = zip(captures, gates, coarse_queries if is_wide else fine_queries, before, strict=True)
            overlaps = [collect_overlaps(c, c.poses(T_mount), gate, queries, last) for c, gate, queries, last in inputs]
        before = overlaps
        history.append(pooled_rms(overlaps))
        recorder.iteration("correct", index, captures[0].poses(T_mount), history[-1], gates[0])
        xi, moved = common_step(captures, overlaps, T_mount, visible_twists(captures, T_mount, part))
        T_mount = T_mount @ frames.exp(xi)
        tighter = [min(g, next_gate(o, c)) for g, o, c in zip(gates, overlaps, captures, strict=True)]
        gates_settled = all(new > _GATE_SETTLED * old for new, old in zip(tighter, gates, strict=True))
        if moved < _CONVERGED and gates_settled:
            if not is_wide:
                break
            # The gate is still wide, as where surfaces agree badly: go on with all points before it ends.
            few_points_do = False
        gates = tighter if moved < _AT_REST else next_gates(captures, overlaps)
    return T_mount, overlaps, history


def common_step(
    captures: Sequence[Capture], overlaps: Sequence[Overlaps], T_mount: Array, visible: Array
) -> tuple[Array, float]:
    """Return the Gauss–Newton step ξ (6,) of the hand-eye, T_mount·exp(ξ), over all captures, and its rms at the part.

    ξ = −D⁻¹b with D = Σ JᵀHJ/σ², b = Σ Jᵀh/σ², where J are the twists of the views per twist of the hand-eye, H and h
    the normal equations of the views. The motion is the rms translation of the views at the part, in σ.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        visible: (6, k) twists of the hand-eye that the motions show; ξ is a combination of these.
    """
    D = np.zeros((6, 6))
    b = np.zeros(6)
    jacobians = [hand_eye_jacobian(c, T_mount, o.gram.centre) for c, o in zip(captures, overlaps, strict=True)]
    for J, o in zip(jacobians, overlaps, strict=True):
        # Sessions of different noise count by their own variance.
        H, vector = assemble(o.gram)
        D += J.T @ H @ J / o.gram.scale**2
        b += J.T @ vector / o.gram.scale**2
    xi = -visible @ symmetric_inverse(visible.T @ D @ visible) @ (visible.T @ b)
    moved = [(J @ xi).reshape(-1, 6)[:, 3:] / o.gram.scale for J, o in zip(jacobians, overlaps, strict=True)]
    return xi, float(np.sqrt(np.mean(np.concatenate(moved) ** 2)))


def next_gates(captures: Sequence[Capture], overlaps: Sequence[Overlaps]) -> list[float]:
    """Return the next gates, not tighter than 0.6 of the last: the first fits at a wide gate are still far off."""
    return [max(min(o.gate, next_gate(o, c)), 0.6 * o.gate) for c, o in zip(captures, overlaps, strict=True)]


def with_noise_factor(capture: Capture, scatter: Repeatability) -> Capture:
    """Return the capture with the noise factor that was found, by which clouds are weighted against labelled points.

    It is 1 at least, as for independent distances: correspondences share points and normals, and tell no more than
    these. A capture without labelled points is unchanged.
    """
    return capture if capture.sightings is None else replace(capture, noise_factor=max(scatter.noise_factor, 1.0))


def apply_given_hand_eye(captures: Sequence[Capture], model: Model) -> Correction:
    """Return the correction of a rig whose hand-eye is given and stays as it is: overlaps and scatter under it.

    Args:
        captures: with the model's effects taken out.

    Raises:
        NoResultError: no two views overlap under the hand-eye.
    """
    size = part_size(captures)
    overlaps = tuple(converged_overlaps(c, model.T_mount, REUSE_GATE * size) for c in captures)
    poses = [c.poses(model.T_mount) for c in captures]
    unconstrained = tuple(unconstrained_poses(c, T, o.gate) for c, T, o in zip(captures, poses, overlaps, strict=True))
    scatter = tuple(capture_repeatability(c, f, model.T_mount) for c, f in zip(captures, unconstrained, strict=True))
    hand_eye = HandEyeFit(model.T_mount, model.covariance, 1.0, scatter, 1.0)
    return Correction(
        geometry=model,
        statistics=lambda: hand_eye,
        scatter=scatter,
        overlaps=overlaps,
        unconstrained=unconstrained,
        history=(pooled_rms(overlaps),),
        captures=tuple(with_noise_factor(c, s) for c, s in zip(captures, scatter, strict=True)),
        given=True,
    )


def converged_overlaps(capture: Capture, T_mount: Array, gate: float) -> Overlaps:
    """Return the correspondences of a capture under a hand-eye that is right but for pose errors.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        gate: largest distance between corresponding points at first, length_unit; it narrows to what the data ask.

    Raises:
        NoResultError: no two views overlap.
    """
    gate = converged_gate(capture, T_mount, gate)
    return collect_overlaps(capture, capture.poses(T_mount), gate)


def gate_of_model(capture: Capture, T_mount: Array) -> float:
    """Return the largest distance between corresponding points under a fitted model, length_unit; NaN without clouds.

    Args:
        capture: with the model's effects taken out.
        T_mount: (4, 4) maps scanner to mount.

    Raises:
        NoResultError: no two views overlap.
    """
    if not capture.scans:
        return float("nan")
    return converged_gate(capture, T_mount, REUSE_GATE * part_size([capture]))


def converged_gate(capture: Capture, T_mount: Array, gate: float) -> float:
    """Return the largest distance between corresponding points that spacing and residuals ask for, length_unit.

    It narrows from `gate`, in at most `_TIGHTENINGS` rounds of matching under fixed poses.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        gate: to begin with, too large, length_unit.

    Raises:
        NoResultError: no two views overlap.
    """
    samples = common_samples(capture.scans, FINE_SAMPLES)
    poses = capture.poses(T_mount)
    overlaps: Overlaps | None = None
    for _ in range(_TIGHTENINGS):
        overlaps = collect_overlaps(capture, poses, gate, samples, overlaps)
        tighter = float(np.minimum(gate, next_gate(overlaps, capture)))
        settled = tighter > _GATE_CONVERGED * gate
        gate = tighter
        if settled:
            break
    return gate
