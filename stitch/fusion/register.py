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
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import (
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
    """Return poses at which the overlaps agree, each view moved by its own twist and held by the robot's pose.

    Each iteration matches points within the gate and takes one Gauss–Newton step. It ends when a step is small, or with
    the best poses and a note: where neither rms nor step has fallen for `_PATIENCE` iterations, or at
    `_MAXIMUM_ITERATIONS`.

    Args:
        model_poses: T_reference_scanner (V, 4, 4) of robot and hand-eye.
        scatter: sigmas of the flange's poses (the prior), and the factor on the noise within overlaps.
        gate: largest distance between corresponding points at first, length_unit.
        start: (V, 4, 4) poses to begin with, whose mean motion from the model's is taken out; None: the model's.
        method: how correspondences are weighted.
        before: overlaps at poses near by, whose search is used again; None: all is searched.

    Raises:
        NoResultError: no two views overlap.
    """
    recorder = recorder or SilentRecorder()
    poses = np.array(model_poses)
    if start is not None:
        # No overlap shows the mean of the motions from the model's poses.
        common = frames.log(start @ frames.inverse(model_poses)).mean(axis=0)
        poses = frames.exp(-common) @ start
    history: list[float] = []
    overlaps = collect_overlaps(capture, poses, gate, before=before)
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
        overlaps = collect_overlaps(capture, poses, gate, before=overlaps)
    return replace(best, history=tuple(history), note=progress.note(len(history)))


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
    """Return the normal equations of the views' twists: overlaps under a method's weights, plus the robot's prior.

    Cost: Σ w e²/σ² + Σ_v (δ_v + δ⁰_v)ᵀ Λ_v (δ_v + δ⁰_v), with δ⁰ the twist from the model's pose to the present one.

    Args:
        overlaps: correspondences at `poses`.
        poses: T_reference_scanner (V, 4, 4), about which the cost is linearised.
        model_poses: T_reference_scanner (V, 4, 4) of robot and hand-eye, where the prior is centred.
        scatter: sigmas of the flange's poses, and the factor on the noise within overlaps.
    """
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
    off = frames.twists_about(g.centre, model_poses, poses)
    H, b = assemble(g)
    H = H / variance
    b = b / variance + np.einsum("vij,vj->vi", prior, off).reshape(-1)
    for v, precision in enumerate(prior):
        H[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] += precision
    return NormalEquations(H, b) if sums is None else NormalEquations(*with_offsets(H, b, sums, variance, old.scale))


def prior_precision(capture: Capture, scatter: Repeatability, centre: Array) -> Array:
    """Return the inverse covariance (V, 6, 6) of the views' left twists about `centre` (3,) by the flange's scatter."""
    carried = frames.adjoint_about(centre, capture.T_reference_flange)
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
    """Return the covariance (6V, 6V) of the registered views' left twists about the centre of the overlaps.

    It is H⁻¹ (M + K) H⁻¹, a sandwich (Liang and Zeger 1986, Biometrika 73:13). H are the normal equations; K is the
    precision of the robot's poses with the hand-eye free, so that the result holds for differences between views. M is
    the covariance of the gradient: the noise of one point enters all distances that the point has a part in, so the
    gradient is summed per point first and then squared, by the noise of its scan.

    Args:
        poses: (V, 4, 4) T_reference_scanner as registered.
        T_mount: (4, 4) maps scanner to mount.
        scatter: sigmas of the flange's poses, and the factor on the noise within overlaps.
    """
    g = overlaps.gram
    variance = g.variance * scatter.noise_factor
    prior = prior_precision(capture, scatter, g.centre)
    K = with_free_mean(prior, hand_eye_jacobian(capture, T_mount, g.centre))
    equations = normal_equations(overlaps, capture, poses, poses, scatter=scatter, method=method)
    inverse = symmetric_inverse(equations.H - block_diag(*prior) + K)
    weights = method.weigh(overlaps.matches, capture, poses)
    # Free offsets of views are unknowns too. They are eliminated: by `from_offsets` their gradient enters the twists'.
    free = [v for v, scan in enumerate(capture.scans) if method.offsets and (scan.stock or v in equations.offsets)]
    sums = OffsetSums(g, overlaps.matches, weights, capture)
    coupling = sums.coupling.reshape(len(K), -1)[:, free]
    from_offsets = np.linalg.solve(sums.matrix[np.ix_(free, free)], coupling.T)
    elimination = np.hstack([np.eye(len(K)), -from_offsets.T])
    M = elimination @ _gradient_covariance(capture, overlaps, [w / variance for w in weights], free) @ elimination.T
    return inverse @ (M + K) @ inverse


def _gradient_covariance(capture: Capture, overlaps: Overlaps, weights: Sequence[Array], free: Sequence[int]) -> Array:
    """Return the covariance (6V + F, 6V + F) of the gradient by twists of V views and offsets of F of them.

    It is Σ σ² gᵀg over the points of all scans, with g a point's part of the gradient and σ the noise of its scan.

    Args:
        weights: (M,) per match, over the variance of a distance.
        free: numbers of the F views.
    """
    g, size = overlaps.gram, 6 * len(capture.scans)
    gradients = [csr_array((len(scan.points), size + len(free))) for scan in capture.scans]
    for m, weight in zip(overlaps.matches, weights, strict=True):
        rows = frames.plane_rows(m.middle - g.centre, m.normal)
        # Change of each distance by all twists and offsets: its second view acts against its first.
        by_distance = np.zeros((len(rows), size + len(free)))
        sides = ((m.v, m.index_v, 1.0), (m.w, m.index_w, -1.0))
        for v, index, sign in sides:
            by_distance[:, 6 * v : 6 * v + 6] = sign * rows
            if v in free:
                by_distance[:, size + free.index(v)] = sign * acts(capture, v, index)
        for v, index, sign in sides:
            shape = len(capture.scans[v].points), len(index)
            to_points = csr_array((sign * weight, (index, np.arange(len(index)))), shape)
            gradients[v] = gradients[v] + to_points @ csr_array(by_distance)
    noises = [scan.noise if np.isfinite(scan.noise) else np.sqrt(g.variance / 2) for scan in capture.scans]
    return sum(s**2 * (gradient.T @ gradient).toarray() for s, gradient in zip(noises, gradients, strict=True))


class _Progress:
    """Whether the rms or the step still falls, and for how many iterations neither has."""

    def __init__(self) -> None:
        self.rms = self.step = self.gate = np.inf
        self.stalled = 0

    def made(self, g: Gram, step: Array, gate: float) -> bool:
        """Return whether rms or step fell below all earlier ones, by a share of `_FALLS`; a tighter gate resets both.

        `stalled` counts the calls in a row that returned False.

        Args:
            step: (V, 6) of this iteration; its size is the rms translation, length_unit.
            gate: largest distance between corresponding points, length_unit.
        """
        size = float(np.sqrt(np.mean(step[:, 3:] ** 2)))
        if gate < 0.9 * self.gate:
            self.rms, self.step, self.gate = np.inf, np.inf, gate
        falls = g.rms < (1 - _FALLS) * self.rms or size < (1 - _FALLS) * self.step
        self.rms, self.step = min(self.rms, g.rms), min(self.step, size)
        self.stalled = 0 if falls else self.stalled + 1
        return falls

    def note(self, iterations: int) -> str:
        """Return one sentence on why register ended without convergence, and which poses are kept."""
        kept = iterations - self.stalled
        if self.stalled >= _PATIENCE:
            return (
                f"stopped after {iterations} iterations, since neither rms nor step fell any further; "
                f"the poses of iteration {kept} are kept"
            )
        return f"did not come to rest in {iterations} iterations; the poses of iteration {kept} are kept"


def unseen_moves(registration: Registration, model_poses: Array) -> Array:
    """Return (V,) how far register moved each view in directions that its overlaps do not see, length_unit.

    A ball can turn in itself, a cylinder slide: such moves come from noise and prior. Of each view, they are the
    eigenvectors of the sum of its pairs' matrices whose eigenvalue is below `NEAR_NULL` of the largest.

    Args:
        model_poses: T_reference_scanner (V, 4, 4) before register; the motion common to all views does not count.
    """
    g = registration.overlaps.gram
    blocks = np.zeros((g.views, 6, 6))
    factors = g.displacement_factors
    for side in g.pairs.T:
        np.add.at(blocks, side, g.matrix / np.outer(factors, factors))
    values, vectors = np.linalg.eigh(blocks)
    moved = frames.twists_about(g.centre, model_poses, registration.poses) * factors
    along = np.einsum("vik,vi->vk", vectors, moved - moved.mean(axis=0))
    return np.linalg.norm(along * (values < NEAR_NULL * values[:, -1:]), axis=1)


def register_targets(rows: TargetRows, variances: Array, poses: Array) -> tuple[Array, Array]:
    """Return poses (V, 4, 4) moved by each view's most likely error, and the residual distances (V, S) of its targets.

    The most likely left twist of a view is C·Lᵀ·Σ⁻¹·(−e), the best linear unbiased prediction (Robinson 1991): C is the
    covariance of its twist by the flange's scatter, L the lever, Σ the covariance of its residuals e.

    Args:
        variances: (3,) of rotation scatter (rad²), translation scatter (length_unit²), factor on the sensor's noise.
        poses: T_reference_scanner (V, 4, 4) of the model.
    """
    V = len(rows.lever)
    carried = frames.adjoint_about(rows.centre, rows.capture.T_reference_flange)
    scatter = carried * np.repeat(variances[:2], 3) @ carried.transpose(0, 2, 1)
    covariance = rows.mixed_model(rows.hand_eye).covariance(variances)[:V]
    pushed = np.linalg.solve(covariance, -rows.residual[:V, :, None])
    twist = (scatter @ rows.lever.transpose(0, 2, 1) @ pushed)[..., 0]
    moved = frames.moved_about(rows.centre, twist, poses)
    residual = rows.residual.copy()
    residual[:V] += np.einsum("vmi,vi->vm", rows.lever, twist)
    return moved, rows.distances(residual)
