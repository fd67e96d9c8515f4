"""How the views answer to parameters of effects: left twists of every view, as the overlaps would see them.

Effects of robot, mount and part move views as a whole. Effects of points change what the overlaps measure; what they
look like to the poses is H⁺BᵀWg, with g the change of the distance e per unit. Their sums over pairs are streamed:
memory never grows with the points.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.model.forward import PointSlopes, moves_points, pose_derivatives
from stitch.model.model import Model, Term
from stitch.numerics import frames
from stitch.numerics.distributions import tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.linear_model import Response
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import sum_by_pair
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, solve_views
from stitch.session.measurement import Measurement

# Correspondences whose slopes are held at a time: some megabytes, whatever the session's size. One block after the
# other: threads that take turns at so many small calls need longer than one.
_BLOCK = 20_000
# Pairs are asked in squares of so many views by so many, so that a view of many is asked for many pairs at once.
_SQUARE = 8


@dataclass(frozen=True)
class PointGram:
    """Sums over the correspondences of P pairs for K parameters of point effects, about the Gram's centre."""

    vector: Array  # (P, 6, K) Σ w Bᵀg
    residual: Array  # (P, K) Σ w g e
    square: Array  # (P, K, K) Σ w g gᵀ

    def select(self, keep: slice | Mask) -> "PointGram":
        """The sums of some of the parameters."""
        return PointGram(self.vector[:, :, keep], self.residual[:, keep], self.square[:, keep][:, :, keep])

    def merge_sides(self, per_view: int) -> "PointGram":
        """Return the sums for parameters that all views share, from those for parameters of each view of a pair.

        Args:
            per_view: parameters that either view of a pair has for itself; they come first, twice.
        """
        shares = np.vstack([np.eye(per_view), np.eye(per_view)])
        rest = self.residual.shape[1] - 2 * per_view
        A = np.block([[shares, np.zeros((2 * per_view, rest))], [np.zeros((rest, per_view)), np.eye(rest)]])
        return PointGram(self.vector @ A, self.residual @ A, A.T @ self.square @ A)


def view_responses(
    measurement: Measurement, model: Model, terms: Sequence[Term], unconstrained: UnconstrainedPoses
) -> list[Response]:
    """Return per term the twists (6V, P) of the views, and the sums over pairs of those that change the points."""
    of_points = [term for term in terms if moves_points([term])]
    of_views = [term for term in terms if not moves_points([term])]
    sums = None
    if of_points:
        slopes = PointSlopes(measurement, of_points, model)
        sums = stream_point_sums(
            unconstrained,
            measurement.capture.noise_factor,
            lambda v, index: slopes.at(v, unconstrained.poses[v], index),
            lambda: slopes.at_targets(unconstrained.poses),
        )
    twists = apparent_twists(sums, unconstrained) if sums else None
    derivatives = pose_derivatives(measurement, model, of_views, unconstrained.overlaps.gram.centre)
    responses, at = [], 0
    for term in terms:
        if sums is not None and twists is not None and moves_points([term]):
            columns = slice(at, at + len(term.parameters))
            responses.append(Response(twists[:, columns], sums.select(columns)))
            at = columns.stop
        else:
            moved = next(derivatives)
            responses.append(Response(moved.reshape(len(moved), -1).T, None))
    return responses


def view_columns(measurement: Measurement, model: Model, unconstrained: UnconstrainedPoses) -> Array:
    """Return twists (6V, P) of the views for all parameters of the effects in use."""
    columns = [r.columns for r in view_responses(measurement, model, model.terms, unconstrained)]
    return np.hstack([np.zeros((6 * len(unconstrained.poses), 0)), *columns])


def apparent_twists(points: PointGram, unconstrained: UnconstrainedPoses) -> Array:
    """Return H⁺BᵀWg (6V, K): what point effects do to poses that overlaps and targets alone determine."""
    return solve_views(unconstrained.overlaps.gram, points.vector)


def stream_point_sums(
    unconstrained: UnconstrainedPoses,
    noise_factor: float,
    of_points: Callable[[int, Indices], Array],
    of_targets: Callable[[], Array],
    per_view: int = 0,
) -> PointGram:
    """Return the sums of all pairs, streamed once, a block of rows at a time.

    Args:
        noise_factor: of the capture, by which labelled points count beside the surfaces.
        of_points: (K, N, 3) how far some points of view v move per unit, scanner frame.
        of_targets: (K, V, S, 3) the same for all labelled points.
        per_view: so many of the K are parameters of every view: the sums hold those of the first view of a pair, then
            those of the second, then the others.
    """
    g = unconstrained.overlaps.gram

    def slopes(v: int, index: Indices, normal: Array) -> Array:
        """(N, K) how far points of view v move along normals (N, 3) of the reference frame, per unit."""
        in_scanner = frames.rotate(frames.inverse(unconstrained.poses[v]), normal)
        # A point is asked by several partners, and moves alike for all.
        points, asked = np.unique(index, return_inverse=True)
        return np.einsum("kni,ni->nk", of_points(v, points).take(asked, axis=1), in_scanner)

    sums = dict[int, tuple[Array, ...]]()
    for block in _match_blocks(unconstrained.overlaps.matches):
        changes = _split_by_view(_distance_changes([m for _, m in block], slopes), per_view)
        end = 0
        for pair, m in block:
            start, end = end, end + len(m.residual)
            change = changes[start:end]
            weighted = change * (m.weight * tukey(m.residual, g.scale))[:, None]
            B = frames.plane_rows(m.middle - g.centre, m.normal)
            more = (B.T @ weighted, weighted.T @ m.residual, weighted.T @ change)
            sums[pair] = tuple(map(np.add, sums[pair], more)) if pair in sums else more
    rows = [sums[pair] for pair in sorted(sums)]
    rows += _target_pair_sums(unconstrained, noise_factor, of_targets, per_view)
    return PointGram(*(np.array([row[i] for row in rows]) for i in range(3)))


def _split_by_view(changes: Array, per_view: int) -> Array:
    """(…, K + apart) of changes (…, 2, K) that the two views of a pair cause."""
    sides = [changes[..., side, :per_view] for side in range(2)] if per_view else []
    return np.concatenate([*sides, changes[..., per_view:].sum(axis=-2)], axis=-1)


def _match_blocks(matches: Sequence[Match]) -> Iterator[list[tuple[int, Match]]]:
    """Pairs and their numbers, square by square, as many at a time as fill a block; a larger one in parts."""
    block, rows = list[tuple[int, Match]](), 0
    for pair, m in sorted(enumerate(matches), key=lambda item: (item[1].v // _SQUARE, item[1].w // _SQUARE, item[0])):
        for start in range(0, len(m.residual), _BLOCK):
            part = m.subset(slice(start, start + _BLOCK))
            if block and rows + len(part.residual) > _BLOCK:
                yield block
                block, rows = [], 0
            block.append((pair, part))
            rows += len(part.residual)
    if block:
        yield block


def _distance_changes(matches: Sequence[Match], slopes: Callable[[int, Indices, Array], Array]) -> Array:
    """(N, 2, K) how the distances of all N correspondences of some pairs change by either view; each is asked once."""
    ends = np.cumsum([len(m.residual) for m in matches])
    normal = np.concatenate([m.normal for m in matches])
    # Per side of a pair the view, its points, the rows of the pair, and whether it is the second view.
    sides = list[tuple[int, Indices, Indices, int]]()
    for second in range(2):
        for m, end in zip(matches, ends, strict=True):
            rows = np.arange(end - len(m.residual), end)
            sides.append((m.w, m.index_w, rows, 1) if second else (m.v, m.index_v, rows, 0))
    out = np.zeros((len(normal), 2, 0))
    for view in sorted({side[0] for side in sides}):
        of_view = [side for side in sides if side[0] == view]
        index = np.concatenate([side[1] for side in of_view])
        at = np.concatenate([side[2] for side in of_view])
        is_second = np.concatenate([np.full(len(side[2]), side[3]) for side in of_view])
        moved = slopes(view, index, normal.take(at, axis=0))
        out = out if out.shape[2] else np.zeros((len(normal), 2, moved.shape[1]))
        out[at, is_second] = np.where(is_second[:, None] == 1, -moved, moved)
    return out


def _target_pair_sums(
    unconstrained: UnconstrainedPoses, noise_factor: float, of_targets: Callable[[], Array], per_view: int
) -> list[tuple[Array, ...]]:
    """Return per pair of views with common targets the sums that `PointGram` has: vector, residual and square.

    What changes is the difference of two places of a target, a vector, where surfaces have a distance.

    Args:
        noise_factor: of the targets' weights.
        of_targets: returns how each parameter moves the targets (K, V, S, 3), sensor frame.
        per_view: parameters that either view of a pair has for itself.
    """
    targets, g = unconstrained.overlaps.targets, unconstrained.overlaps.gram
    if targets is None:
        return []
    moved = np.moveaxis(frames.rotate(unconstrained.poses, of_targets()), 0, -1)  # (V, S, 3, K)
    (v, w), (slot_v, slot_w) = targets.views.T, targets.slots.T
    change = _split_by_view(np.stack([moved[v, slot_v], -moved[w, slot_w]], axis=-2), per_view)
    weighted = change * (noise_factor * g.variance * targets.information)[:, None, None]
    vector = sum_by_pair(targets, np.einsum("nia,nik->nak", targets.lever(g.centre), weighted))[1]
    residual = sum_by_pair(targets, np.einsum("ni,nik->nk", targets.difference, weighted))[1]
    square = sum_by_pair(targets, np.einsum("nik,nil->nkl", change, weighted))[1]
    return list(zip(vector, residual, square, strict=True))
