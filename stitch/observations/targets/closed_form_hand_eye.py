"""A first hand-eye from labelled points alone: closed forms, each improved a little, of which the likeliest counts.

left·(R p + t) = P is linear in R (9), t (3) and P (3 a target). The targets' means and t are eliminated; what is left
is solved with |vec R|² = 3 imposed (`numerics.hand_eye`). Without that length R = 0 solves it wherever the flange
stands at one place and only turns: noise of the points then shrinks R to nothing. Where views share three targets their
relative turns say more, A·X = X·B. From each start R and t go on by weighted least squares with weights 1/|residual|
(which end at the least sum of distances, so that a wrong label pulls little), and the least sum counts.
A measured probe adds the turns: A·X = Z·B (Shah 2013).
"""

from collections.abc import Iterator

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array, Indices
from stitch.numerics.hand_eye import AXXB_SOLVERS, minimise_on_sphere, shah
from stitch.numerics.least_squares import less_group_means
from stitch.session.capture import Capture, Sightings

# Reweighted solutions on the way to a start, and steps from it at the most; one that turns or shifts by less than this
# share of the points' spread is the last.
_REWEIGHTED, _STEPS, _STEP_ENDS = 6, 60, 1e-9
# Singular values of the system below this share of the largest: the motions do not show it all.
_DEGENERATE = 1e-6
# A start whose R has a singular value this far from 1 is no rotation: the system says little of it.
_NO_ROTATION = 0.5
# Targets in one line do not show how the sensor turned; neighbours of a view that its motions are asked to.
_LINE, _NEXT = 0.02, (1, 2)


def closed_form_hand_eye(capture: Capture) -> Array:
    """Return a first hand-eye T_mount_sensor (4, 4) from labelled points, or from the poses of a measured probe.

    Points: several closed forms give rotations, each is improved, and the one with the smallest sum of distances is
    returned. A probe: A·X = Z·B (Shah 2013).

    Raises:
        NoResultError: motions or targets that cannot show the hand-eye.
    """
    s = capture.sightings
    assert s is not None
    if s.rotation is not None:
        # T_mount·T_sensor_probe = T_reference_mount⁻¹·T_reference_probe is A·X = Z·B for A = T_reference_mount⁻¹.
        used = s.used.any(axis=1)
        A = frames.inverse(capture.T_reference_mount[used])
        return shah(A, frames.make(s.rotation[used], s.points[used, 0]))[1]
    equations = _PointEquations(capture, s)
    starts = [*equations.linear_starts(), *_starts_from_motions(capture, s)]
    T_mount, _ = min(map(equations.improved, starts), key=lambda solution: solution[1])
    return T_mount


def sensor_motions(s: Sightings) -> tuple[Indices, Array]:
    """Return pairs of views (M, 2), and the motion T_first_second (M, 4, 4) of the sensor between them.

    Pairs are each view with the next two, where they share three targets or more that are not in a line. T maps sensor
    coordinates of the second view to those of the first, by least squares over these targets (Kabsch).
    """
    pairs = []
    T = []
    views = len(s.points)
    for v, w in ((v, v + step) for step in _NEXT for v in range(views - step)):
        common, first, second = np.intersect1d(s.target[v][s.used[v]], s.target[w][s.used[w]], return_indices=True)
        if len(common) < 3:
            continue
        a, b = s.points[v][s.used[v]][first], s.points[w][s.used[w]][second]
        spread = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
        if spread[1] > _LINE * spread[0]:
            pairs.append((v, w))
            T.append(align_points(b, a))
    return np.array(pairs, int).reshape(-1, 2), np.array(T).reshape(-1, 4, 4)


def _starts_from_motions(capture: Capture, s: Sightings) -> Iterator[Array]:
    """Yield rotations (3, 3) of the hand-eye by closed forms of A·X = X·B, for A, B of mount and sensor between views.

    Nothing where no two views share three targets; a solver that fails is left out.
    """
    pairs, B = sensor_motions(s)
    if not len(B):
        return
    v, w = pairs.T
    A = frames.inverse(capture.T_reference_mount[v]) @ capture.T_reference_mount[w]
    for solve in AXXB_SOLVERS.values():
        try:
            yield solve(A, B)[:3, :3]
        except (NoResultError, np.linalg.LinAlgError):
            continue


class _PointEquations:
    """left·(R p + t) − P = 0 of N sightings, with the targets' means eliminated."""

    def __init__(self, capture: Capture, s: Sightings) -> None:
        """Take the N labelled points in use, centred and scaled, so that the equations are well conditioned.

        `left` is T_reference_mount (N, 4, 4), `p` the point (N, 3) in the sensor's frame, `target` its number (N,).
        """
        v, slot = np.nonzero(s.used)
        self.left = capture.T_reference_mount[v]
        self.offset = s.points[v, slot].mean(axis=0)
        off = s.points[v, slot] - self.offset
        self.scale = float(np.linalg.norm(off, axis=1).mean()) or 1.0
        self.p = off / self.scale
        self.target: Indices = s.target[v, slot]

    def linear_starts(self) -> list[Array]:
        """Return one or two rotations (3, 3), the nearest to solutions R of linear least squares in vec R and t (3,).

        One solution has |vec R|² = 3 imposed, as rotations have it, the other not. One that is far from a rotation
        (singular values off by `_NO_ROTATION`) is left out, unless both are. Weights are 1/|residual|, repeated.

        Raises:
            NoResultError: the motions of the flange, or the targets, do not determine the hand-eye.
        """
        solutions = [self._linear_solution(on_sphere) for on_sphere in (True, False)]
        near = [R for R in solutions if np.abs(np.linalg.svd(R, compute_uv=False) - 1).max() < _NO_ROTATION]
        return [frames.nearest_rotation(R) for R in near or solutions]

    def _linear_solution(self, on_sphere: bool) -> Array:
        """Return R (3, 3), not yet a rotation, by linear least squares in vec R and t (3,), repeatedly weighted.

        Args:
            on_sphere: True: |vec R|² = 3 is imposed.

        Raises:
            NoResultError: the motions of the flange, or the targets, do not determine the hand-eye.
        """
        L = self.left[:, :3, :3]
        columns = np.concatenate([np.einsum("nij,nk->nijk", L, self.p).reshape(-1, 3, 9), L], axis=2)
        weight = np.ones(len(L))
        for _ in range(_REWEIGHTED):
            C = less_group_means(columns, self.target, weight)
            b = less_group_means(self.left[:, :3, 3:] / self.scale, self.target, weight)
            root = np.sqrt(weight)[:, None, None]
            A, right = (root * C).reshape(-1, 12), -(root * b).ravel()
            # t is projected out, vec R solved, and t found from it.
            Q, of_t = np.linalg.qr(A[:, 9:])
            A_R, right_R = A[:, :9] - Q @ (Q.T @ A[:, :9]), right - Q @ (Q.T @ right)
            values = np.linalg.svd(A_R, compute_uv=False)
            if values[-1] < _DEGENERATE * values[0] or len(A) < 12:
                raise NoResultError(
                    "these views do not show the hand-eye: turn the flange about two axes at least and show three "
                    "targets that are not in one line, or give scanner.pose in session.toml"
                )
            if on_sphere:
                vec = minimise_on_sphere(A_R.T @ A_R, A_R.T @ right_R, np.sqrt(3.0))
            else:
                vec = np.linalg.lstsq(A_R, right_R, rcond=None)[0].astype(float)
            t = np.linalg.lstsq(of_t, Q.T @ (right - A[:, :9] @ vec), rcond=_DEGENERATE)[0]
            weight = _weights(np.linalg.norm(C @ np.append(vec, t) + b[..., 0], axis=1))
        R = vec.reshape(3, 3)
        return R * np.sign(np.linalg.det(R)) if on_sphere else R

    def improved(self, R: Array) -> tuple[Array, float]:
        """Return T_mount_sensor (4, 4) from a start R (3, 3), and the sum of its residual distances, over `scale`.

        Gauss–Newton steps with weights 1/|residual| minimise this sum. They end at a step below `_STEP_ENDS`, or after
        `_STEPS`, where the last one counts.
        """
        L = self.left[:, :3, :3]
        weight = np.ones(len(L))
        t = np.zeros(3)
        # The first solution is of t alone.
        for step in range(_STEPS):
            turned = self.p @ R.T
            placed = L @ (turned + t)[..., None] + self.left[:, :3, 3:] / self.scale
            columns = less_group_means(np.concatenate([-L @ frames.skew(turned), L], axis=2), self.target, weight)
            residual = less_group_means(placed, self.target, weight)
            free = slice(3 if step == 0 else 0, 6)
            root = np.sqrt(weight)[:, None, None]
            x = np.zeros(6)
            rows, right = (root * columns[..., free]).reshape(3 * len(L), -1), -(root * residual).ravel()
            x[free] = np.linalg.lstsq(rows, right, rcond=_DEGENERATE)[0]
            distances = np.linalg.norm(residual[..., 0] + columns @ x, axis=1)
            weight = _weights(distances)
            R = frames.exp(np.append(x[:3], np.zeros(3)))[:3, :3] @ R
            t = t + x[3:]
            if step and np.abs(x).max() < _STEP_ENDS:
                break
        return frames.make(R, self.scale * t - R @ self.offset), float(distances.sum())


def _weights(distances: Array) -> Array:
    """Return weights (N,) 1/|residual|, of mean 1, for residual distances (N,)."""
    weight = 1 / np.maximum(distances, 1e-3 * np.median(distances) + 1e-12)
    return weight / weight.mean()
