"""Register what the hand-eye cannot explain: all views at once, each held by the robot's pose.

Three methods weigh the correspondences (`METHODS`): `dpwvm`, the weighted variance of the distances (`dpwvm_weights`),
`vmm`, that of a plus and a minus class about their own means (`vmm_weights`), and `gicp`, plane to plane inside Tukey's
biweight (`plane_weights`). The cost is the weighted mean of Var(d) +
λ·mean(d)² with λ = 1: an offset common to all points of a pair is the very step that stitching has to close. Under
`dpwvm` λ is 0 for a view that shows an offset of its own, as stock on a casting.

Solving all views together leaves no drift around a loop. The prior is each view's pose from the robot, with the
scatter that the overlaps themselves show (REML). Where there are labelled points alone, each view moves by its own most
likely error (`register_targets`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from stitch.errors import InputError, did_you_mean
from stitch.fusion.correspondence_weights import (
    OffsetSums,
    acts,
    class_variances,
    dpwvm_weights,
    plane_weights,
    vmm_weights,
    with_offsets,
)
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import symmetric_inverse
from stitch.observations.surfaces.hand_eye_fit import Repeatability, hand_eye_jacobian
from stitch.observations.surfaces.matching import Match, sample_points
from stitch.observations.surfaces.normal_equations import (
    FINE_SAMPLES,
    NEAR_NULL,
    Gram,
    Overlaps,
    append_targets,
    assemble,
    collect_overlaps,
    gram,
    next_gate,
)
from stitch.observations.surfaces.view_poses import LastStep, has_converged, take_step
from stitch.observations.targets.rows import TargetRows
from stitch.recorder import Recorder, SilentRecorder
from stitch.session.capture import Capture

_MAXIMUM_ITERATIONS = 25
_CONVERGED = 5e-3
# Iterations in a row in which neither the rms nor the step may fall by this share, at a gate that stands still.
_PATIENCE, _FALLS = 3, 1e-3

# Weights (M,) per match, from the matches, their capture and T_reference_scanner (V, 4, 4).
CorrespondenceWeights = Callable[[Sequence[Match], Capture, Array], Sequence[Array]]


@dataclass(frozen=True)
class Method:
    """What correspondences count, and whether an offset that a view's whole surface shows costs nothing."""

    name: str
    weigh: CorrespondenceWeights
    offsets: bool = False
    classes: bool = False  # what is made small are the variances of the distances' plus and minus class


DPWVM = Method("dpwvm", dpwvm_weights, offsets=True)
GICP = Method("gicp", plane_weights)
VMM = Method("vmm", vmm_weights, classes=True)
METHODS = {method.name: method for method in (DPWVM, GICP, VMM)}
DEFAULT = DPWVM.name


def method_named(name: str) -> Method:
    """Return the method of `--register`.

    Raises:
        InputError: there is none of this name.
    """
    if name not in METHODS:
        raise InputError(
            f"register {name}: no method has this name{did_you_mean(name, METHODS)}; to fix: dpwvm, gicp or vmm"
        )
    return METHODS[name]


@dataclass(frozen=True)
class Registration:
    """Poses after the fit; how far they are from the model's is the robot's own error."""

    poses: Array  # (V, 4, 4) T_reference_scanner
    overlaps: Overlaps
    history: tuple[float, ...]
    note: str = ""  # why it ended before the views stood still
    offsets: dict[int, float] = field(default_factory=dict)  # by which whole surfaces of views stand off, outwards


def register(
    capture: Capture,
    model_poses: Array,
    scatter: Repeatability,
    gate: float,
    recorder: Recorder | None = None,
    start: Array | None = None,
    method: Method = METHODS[DEFAULT],
    before: Overlaps | None = None,
) -> Registration:
    """Move every view by its own twist until the overlaps agree, or until neither rms nor step falls any more.

    Args:
        model_poses: T_reference_scanner (V, 4, 4) of robot and hand-eye.
        scatter: prior of the flange poses and the factor on the overlap noise.
        gate: first distance between partners, length_unit.
        start: (V, 4, 4) poses to begin with, if a better guess than the model's is at hand.
        method: what every correspondence counts.
        before: of the same points at poses near by: what cannot have changed is not searched again.

    Raises:
        NoResultError: no two views overlap.
    """
    recorder = recorder or SilentRecorder()
    samples = [sample_points(scan, FINE_SAMPLES) for scan in capture.scans]
    poses = np.array(model_poses if start is None else _without_mean_motion(start, model_poses))
    history: list[float] = []
    overlaps = collect_overlaps(capture, poses, gate, samples, before)
    last: LastStep = None
    progress = _Progress()
    for index in range(_MAXIMUM_ITERATIONS):
        g = overlaps.gram
        history.append(g.rms)
        recorder.iteration("register", index, poses, g.rms, gate)
        equations = normal_equations(overlaps, capture, poses, model_poses, scatter=scatter, method=method)
        step = equations.step
        tighter = min(gate, next_gate(overlaps, capture))
        if has_converged(g, step, _CONVERGED) and tighter > 0.9 * gate:
            return Registration(poses, overlaps, tuple(history), offsets=equations.offsets)
        if progress.made(g, step, gate):
            best = Registration(poses, overlaps, (), offsets=equations.offsets)
        elif progress.stalled >= _PATIENCE:
            break
        poses, last = take_step(poses, g, step, last)
        gate = tighter
        overlaps = collect_overlaps(capture, poses, gate, samples, overlaps)
    return replace(best, history=tuple(history), note=progress.note(len(history)))


def _without_mean_motion(start: Array, model_poses: Array) -> Array:
    """`start` without its mean motion against the robot, which no overlap can show."""
    common = frames.log(start @ frames.inverse(model_poses)).mean(axis=0)
    return frames.exp(-common) @ start


@dataclass(frozen=True)
class NormalEquations:
    """Of data and prior, for twists of all views about the centre; `pose_covariance` has what these vary by."""

    H: Array  # (6V, 6V)
    b: Array  # (6V,)
    offsets: dict[int, float] = field(default_factory=dict)  # that views show, eliminated

    @property
    def step(self) -> Array:
        """(V, 6) of Gauss and Newton."""
        return np.linalg.solve(self.H, -self.b).reshape(-1, 6).astype(float, copy=False)


def normal_equations(
    overlaps: Overlaps, capture: Capture, poses: Array, model_poses: Array, *, scatter: Repeatability, method: Method
) -> NormalEquations:
    """Return what the overlaps say under a method's weights, and the robot's prior."""
    old = overlaps.gram
    weights = method.weigh(overlaps.matches, capture, poses)
    surfaces = gram(overlaps.matches, old.views, old.centre, old.scale, weights)
    if method.classes:
        surfaces = class_variances(surfaces, overlaps.matches, weights)
    sums = OffsetSums(surfaces, overlaps.matches, weights, capture) if method.offsets else None
    if sums is not None:
        surfaces = replace(surfaces, square=sums.square)
    g = append_targets(surfaces, overlaps.targets, capture.noise_factor)
    variance = g.variance * scatter.noise_factor
    prior = prior_precision(capture, scatter, g.centre)
    to_centre = frames.make(np.eye(3), -g.centre)
    off = frames.log(to_centre @ poses @ frames.inverse(model_poses) @ frames.inverse(to_centre))
    H, b = assemble(g)
    H = H / variance
    b = b / variance + np.einsum("vij,vj->vi", prior, off).reshape(-1)
    for v, precision in enumerate(prior):
        H[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] += precision
    return NormalEquations(H, b) if sums is None else NormalEquations(*with_offsets(H, b, sums, variance, old.scale))


def prior_precision(capture: Capture, scatter: Repeatability, centre: Array) -> Array:
    """Return the (V, 6, 6) inverse covariance of the views' twists about `centre`."""
    carried = frames.adjoint(frames.make(np.eye(3), -centre) @ capture.T_reference_flange)
    sigma = np.diag([scatter.rotation**2] * 3 + [scatter.translation**2] * 3)
    return np.linalg.inv(carried @ sigma @ carried.transpose(0, 2, 1)).astype(float, copy=False)


def with_free_mean(precision: Array, columns: Array) -> Array:
    """Return (6V, 6V) K = Λ − ΛJ(JᵀΛJ)⁻¹JᵀΛ of precisions Λ (V, 6, 6) of the views' twists, columns J (6V, k) free."""
    L = block_diag(*precision)
    LJ = L @ columns
    return L - LJ @ symmetric_inverse(columns.T @ LJ) @ LJ.T


def pose_covariance(
    overlaps: Overlaps, capture: Capture, poses: Array, T_mount: Array, scatter: Repeatability, method: Method
) -> Array:
    """Return the covariance (6V, 6V) of what registered views turn and move about the centre of the overlaps.

    The hand-eye is free, and no scan shows where all views stand: it holds for differences between them. A point's
    noise is in every distance that the point has a part in, so that these are not independent: what each point pulls in
    all of them counts, by the noise that its own scan shows (a sandwich, Liang and Zeger 1986, Biometrika 73:13).

    Args:
        poses: (V, 4, 4) T_reference_scanner as registered.
    """
    g, size = overlaps.gram, 6 * len(poses)
    variance = g.variance * scatter.noise_factor
    prior = prior_precision(capture, scatter, g.centre)
    K = with_free_mean(prior, hand_eye_jacobian(capture.hand_eye_frames(T_mount), g.centre))
    equations = normal_equations(overlaps, capture, poses, poses, scatter=scatter, method=method)
    inverse = symmetric_inverse(equations.H - block_diag(*prior) + K)
    weights = method.weigh(overlaps.matches, capture, poses)
    # Offsets that cost nothing are unknowns too: what they take from a distance follows from their own sums.
    free = [v for v, scan in enumerate(capture.scans) if method.offsets and (scan.stock or v in equations.offsets)]
    sums = OffsetSums(g, overlaps.matches, weights, capture)
    taken = np.linalg.solve(sums.matrix[np.ix_(free, free)], sums.coupling.reshape(size, -1)[:, free].T)
    pulls = [csr_array((len(scan.points), size + len(free))) for scan in capture.scans]
    for m, weight in zip(overlaps.matches, weights, strict=True):
        rows = frames.plane_rows(m.middle - g.centre, m.normal)
        pulled = np.zeros((len(rows), size + len(free)))
        sides = ((m.v, m.index_v, 1.0), (m.w, m.index_w, -1.0))
        for v, index, sign in sides:
            pulled[:, 6 * v : 6 * v + 6] = sign * rows
            if v in free:
                pulled[:, size + free.index(v)] = sign * acts(capture, v, index)
        for v, index, sign in sides:
            at = index, np.arange(len(index))
            of_points = csr_array((sign * weight / variance, at), (len(capture.scans[v].points), len(index)))
            pulls[v] = pulls[v] + of_points @ csr_array(pulled)
    known = [scan.noise if np.isfinite(scan.noise) else np.sqrt(g.variance / 2) for scan in capture.scans]
    meat = sum(noise**2 * (pulled.T @ pulled).toarray() for noise, pulled in zip(known, pulls, strict=True))
    left = np.hstack([np.eye(size), -taken.T])
    return inverse @ (left @ meat @ left.T + K) @ inverse


class _Progress:
    """Whether the rms or the step still falls, and for how many iterations neither has."""

    def __init__(self) -> None:
        self.rms = self.step = self.gate = np.inf
        self.stalled = 0

    def made(self, g: Gram, step: Array, gate: float) -> bool:
        """Return True if one of both fell below all before; under a tighter gate they begin anew."""
        size = float(np.sqrt(np.mean(step[:, 3:] ** 2)))
        if gate < 0.9 * self.gate:
            self.rms, self.step, self.gate = np.inf, np.inf, gate
        falls = g.rms < (1 - _FALLS) * self.rms or size < (1 - _FALLS) * self.step
        self.rms, self.step = min(self.rms, g.rms), min(self.step, size)
        self.stalled = 0 if falls else self.stalled + 1
        return falls

    def note(self, iterations: int) -> str:
        """Return one sentence on why register ended and where."""
        kept = iterations - self.stalled
        if self.stalled >= _PATIENCE:
            return (
                f"stopped after {iterations} iterations, since neither rms nor step fell any further; "
                f"the poses of iteration {kept} are kept"
            )
        return f"did not come to rest in {iterations} iterations; the poses of iteration {kept} are kept"


def unseen_moves(registration: Registration, model_poses: Array) -> Array:
    """Return (V,) how far register moved each view along its surfaces, where no overlap shows it; length_unit.

    A ball turns and a cylinder slides on itself: such moves come from the noise and from the prior.
    """
    g = registration.overlaps.gram
    blocks = np.zeros((g.views, 6, 6))
    factors = g.displacement_factors
    for side in g.pairs.T:
        np.add.at(blocks, side, g.matrix / np.outer(factors, factors))
    values, vectors = np.linalg.eigh(blocks)
    to_centre = frames.make(np.eye(3), -g.centre)
    motions = to_centre @ registration.poses @ frames.inverse(model_poses) @ frames.inverse(to_centre)
    moved = frames.log(motions) * factors
    along = np.einsum("vik,vi->vk", vectors, moved - moved.mean(axis=0))
    return np.linalg.norm(along * (values < NEAR_NULL * values[:, -1:]), axis=1)


def register_targets(rows: TargetRows, variances: Array, poses: Array) -> tuple[Array, Array]:
    """Return poses (V, 4, 4) moved by each view's most likely error, and what is left of its targets, (V, S).

    The most likely twist of a view is C·leverᵀ·V⁻¹·(−residual) (best linear unbiased prediction, Robinson 1991).
    """
    V = len(rows.lever)
    to_centre = frames.make(np.eye(3), -rows.centre)
    carried = frames.adjoint(to_centre @ rows.capture.T_reference_flange)
    scatter = carried * np.repeat(variances[:2], 3) @ carried.transpose(0, 2, 1)
    covariance = rows.mixed_model(rows.hand_eye).covariance(variances)[:V]
    pushed = np.linalg.solve(covariance, -rows.residual[:V, :, None])
    twist = (scatter @ rows.lever.transpose(0, 2, 1) @ pushed)[..., 0]
    moved = frames.moved_about(rows.centre, twist, poses)
    residual = rows.residual.copy()
    residual[:V] += np.einsum("vmi,vi->vm", rows.lever, twist)
    return moved, rows.distances(residual)
