"""Register what the hand-eye cannot explain: all views at once, each held by the robot's pose.

Correspondences weigh as `correspondence_weights.py` says. The cost is the weighted mean of d² = Var(d) + mean(d)²: an
offset common to all points of a pair is the very step that stitching has to close, so it counts in full (λ = 1).
Against CAD with an unknown allowance it does not (`cells/window`).

Solving all views together leaves no drift around a loop. The prior is each view's pose from the robot, with the
scatter that the overlaps themselves show (REML).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.gram import Gram, assemble, gram
from stitch.observations.surfaces.match import Match, sample
from stitch.observations.surfaces.moved_views import LastStep, moved, settled
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, Overlaps, collect, next_gate
from stitch.observations.surfaces.pose_channel import Repeatability
from stitch.observations.surfaces.target_pairs import joined
from stitch.runs.recorder import Recorder, Silent
from stitch.stages.correspondence_weights import plane_weights

_MAXIMUM_ITERATIONS = 25
_CONVERGED = 5e-3
# Weights (M,) per match, from the matches, their capture and T_reference_scanner (V, 4, 4).
Weighing = Callable[[Sequence[Match], Capture, Array], Sequence[Array]]


@dataclass(frozen=True)
class Registration:
    """Poses after the fit; how far they are from the model's is the robot's own error."""

    poses: Array  # (V, 4, 4) T_reference_scanner
    overlaps: Overlaps
    history: tuple[float, ...]


def prior_precision(capture: Capture, scatter: Repeatability, centre: Array) -> Array:
    """(V, 6, 6) inverse covariance of the views' twists about `centre`."""
    carried = frames.adjoint(frames.make(np.eye(3), -centre) @ capture.T_reference_flange)
    sigma = np.diag([scatter.rotation**2] * 3 + [scatter.translation**2] * 3)
    return np.asarray(np.linalg.inv(carried @ sigma @ carried.transpose(0, 2, 1)))


def register(
    capture: Capture,
    model_poses: Array,
    scatter: Repeatability,
    gate: float,
    recorder: Recorder | None = None,
    start: Array | None = None,
    weigh: Weighing = plane_weights,
) -> Registration:
    """Move every view by its own twist until the overlaps agree.

    Args:
        model_poses: T_reference_scanner (V, 4, 4) of robot and hand-eye.
        scatter: prior of the flange poses and the factor on the overlap noise.
        gate: first distance between partners, length_unit.
        start: (V, 4, 4) poses to begin with, if a better guess than the model's is at hand.
        weigh: what every correspondence counts.

    Raises:
        NoResultError: no two views overlap.
    """
    recorder = recorder or Silent()
    picked = [sample(scan, FINE_SAMPLES) for scan in capture.scans]
    poses, history = np.array(model_poses if start is None else _held(start, model_poses)), []
    overlaps = collect(capture, poses, gate, picked)
    last: LastStep = None
    for index in range(_MAXIMUM_ITERATIONS):
        g = overlaps.gram
        history.append(g.rms)
        recorder.iteration("register", index, poses, g.rms, gate)
        to_centre = frames.make(np.eye(3), -g.centre)
        off = frames.log(to_centre @ poses @ frames.inverse(model_poses) @ frames.inverse(to_centre))
        step = _step(_weighed(overlaps, capture, weigh(overlaps.matches, capture, poses)), capture, scatter, off)
        tighter = min(gate, next_gate(overlaps, capture))
        if settled(g, step, _CONVERGED) and tighter > 0.9 * gate:
            break
        poses, last = moved(poses, g, step, last)
        gate = tighter
        overlaps = collect(capture, poses, gate, picked, overlaps)
    return Registration(poses, overlaps, tuple(history))


def _weighed(overlaps: Overlaps, capture: Capture, weights: Sequence[Array]) -> Gram:
    """The normal equations of the overlaps under other weights."""
    old = overlaps.gram
    surfaces = gram(overlaps.matches, old.views, old.centre, old.scale, weights)
    return joined(surfaces, overlaps.targets, capture.noise_factor)


def _held(start: Array, model_poses: Array) -> Array:
    """`start` without its mean motion against the robot, which no overlap can show."""
    common = frames.log(start @ frames.inverse(model_poses)).mean(axis=0)
    return np.asarray(frames.exp(-common) @ start)


def _step(g: Gram, capture: Capture, scatter: Repeatability, off: Array) -> Array:
    """(V, 6) Gauss–Newton step of data and prior, about the centre, of views that stand `off` (V, 6) the robot's."""
    H, b = assemble(g)
    variance, prior = g.variance * scatter.noise_factor, prior_precision(capture, scatter, g.centre)
    views = len(prior)
    H, b = H / variance, b / variance + np.einsum("vij,vj->vi", prior, off).reshape(-1)
    for v in range(views):
        H[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] += prior[v]
    return np.asarray(np.linalg.solve(H, -b).reshape(views, 6))
