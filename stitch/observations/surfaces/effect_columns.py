"""How the views answer to parameters of effects: left twists of every view, as the overlaps would see them.

Effects of robot, mount and part move views as a whole. Effects of points change what the overlaps measure; what they
look like to the poses is H⁺BᵀWg, with g the change of the distance e per unit. Their sums over pairs are streamed:
memory never grows with the points.
"""

from collections import defaultdict
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
# Pairs are taken in tiles of the views × views matrix, so many views wide: a block of pairs then has few views, and
# each view is asked for its points' slopes once a block.
_TILE = 8


@dataclass(frozen=True)
class PointGram:
    """Sums over the correspondences of P pairs for K parameters of point effects, about the Gram's centre."""

    vector: Array  # (P, 6, K) Σ w Bᵀg
    residual: Array  # (P, K) Σ w g e
    square: Array  # (P, K, K) Σ w g gᵀ

    def select(self, keep: slice | Mask | Indices) -> "PointGram":
        """Return the sums of some of the parameters, in the order in which `keep` names them."""
        return PointGram(self.vector[:, :, keep], self.residual[:, keep], self.square[:, keep][:, :, keep])


def view_responses(
    measurement: Measurement, model: Model, terms: Sequence[Term], unconstrained: UnconstrainedPoses
) -> list[Response]:
    """Return per term the left twists (6V, P) of the views, in rad and length_unit per unit of its P parameters.

    The twists are about the centre of the overlaps. Of effects that move a view as a whole they are the derivative of
    its pose. Of effects that move points within a view they are what the overlaps would make of the moved points
    (`apparent_twists`), and the response holds the sums over pairs too.
    """
    of_points = [term for term in terms if moves_points([term])]
    of_views = [term for term in terms if not moves_points([term])]
    sums = None
    if of_points:
        slopes = PointSlopes(measurement, of_points, model)
        sums = stream_point_sums(
            unconstrained,
            measurement.capture.noise_factor,
            lambda v, index, normal: slopes.along(v, unconstrained.poses[v], index, normal).T,
            lambda: slopes.at_targets(unconstrained.poses),
        )
    twists = apparent_twists(sums, unconstrained) if sums else None
    derivatives = pose_derivatives(measurement, model, of_views, unconstrained.overlaps.gram.centre)
    responses, at = [], 0
    # The sums and `derivatives` hold each kind in the order of the terms.
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
    """Return the left twists (6V, P) of the views per unit of each parameter of the effects in use."""
    columns = [r.columns for r in view_responses(measurement, model, model.terms, unconstrained)]
    return np.hstack([np.zeros((6 * len(unconstrained.poses), 0)), *columns])


def apparent_twists(points: PointGram, unconstrained: UnconstrainedPoses) -> Array:
    """Return the twists (6V, K) of the views, H⁺BᵀWg, that overlaps and targets alone would make of moved points."""
    return solve_views(unconstrained.overlaps.gram, points.vector)


def stream_point_sums(
    unconstrained: UnconstrainedPoses,
    noise_factor: float,
    of_points: Callable[[int, Indices, Array], Array],
    of_targets: Callable[[], Array],
    per_view: int = 0,
) -> PointGram:
    """Return the sums over the correspondences of each pair of views for K parameters that move points.

    e is the distance of a correspondence, g its change per unit of each parameter, B its change per twist of a view,
    w its weight: the sums are Σ w Bᵀg, Σ w g e and Σ w g gᵀ. Correspondences go by in blocks, so that memory does not
    grow with their number. Pairs of labelled points follow those of surfaces.

    Args:
        noise_factor: variance between surfaces over that of independent noise; labelled points are weighted by it.
        of_points: called with a view, numbers (N,) of its points and unit normals there (N, 3), scanner frame; returns
            how far the points move along them per unit of each parameter, (N, K), length_unit.
        of_targets: returns how all labelled points move per unit, (K, V, S, 3), scanner frame, length_unit.
        per_view: the first `per_view` of the K have a value of their own in each view. The sums then hold them twice,
            for the first and for the second view of a pair, before the others.
    """
    g = unconstrained.overlaps.gram

    def slopes(v: int, index: Indices, normal: Array) -> Array:
        """Return how far (N, K) points `index` of view v move along normals (N, 3), reference frame, per unit."""
        return of_points(v, index, frames.rotate(frames.inverse(unconstrained.poses[v]), normal))

    # By number of the match, so of the pair: Σ w Bᵀg, Σ w g e and Σ w g gᵀ, summed over its parts.
    sums = dict[int, tuple[Array, ...]]()
    for block in _match_blocks(unconstrained.overlaps.matches):
        changes = _distance_changes([m for _, m in block], slopes, per_view)
        end = 0
        for number, m in block:
            start, end = end, end + len(m.residual)
            g_rows = changes[start:end]
            weighted = g_rows * (m.weight * tukey(m.residual, g.scale))[:, None]
            B = frames.plane_rows(m.middle - g.centre, m.normal)
            more = (B.T @ weighted, weighted.T @ m.residual, weighted.T @ g_rows)
            sums[number] = tuple(map(np.add, sums[number], more)) if number in sums else more
    rows = [sums[number] for number in sorted(sums)]
    rows += _target_pair_sums(unconstrained, noise_factor, of_targets, per_view)
    vectors, residuals, squares = (np.array(column) for column in zip(*rows, strict=True))
    return PointGram(vectors, residuals, squares)


def _split_by_view(changes: Array, per_view: int) -> Array:
    """Return the changes of a distance per parameter, (…, K + per_view), from those by each view of a pair, (…, 2, K).

    The first `per_view` parameters have a value for each view: they come twice, for the first view and for the second.
    The others are the same for both views, whose changes are added.
    """
    own = [changes[..., view, :per_view] for view in range(2)] if per_view else []
    return np.concatenate([*own, changes[..., per_view:].sum(axis=-2)], axis=-1)


def _match_blocks(matches: Sequence[Match]) -> Iterator[list[tuple[int, Match]]]:
    """Yield blocks of at most `_BLOCK` correspondences: lists of a match, or a part of a large one, with its number.

    Matches are sorted by tiles of the views × views matrix, so that a block has few views.
    """
    block, rows = list[tuple[int, Match]](), 0
    for number, m in sorted(enumerate(matches), key=lambda item: (item[1].v // _TILE, item[1].w // _TILE, item[0])):
        for start in range(0, len(m.residual), _BLOCK):
            part = m.subset(slice(start, start + _BLOCK))
            if block and rows + len(part.residual) > _BLOCK:
                yield block
                block, rows = [], 0
            block.append((number, part))
            rows += len(part.residual)
    if block:
        yield block


def _distance_changes(matches: Sequence[Match], slopes: Callable[[int, Indices, Array], Array], per_view: int) -> Array:
    """Return the changes (N, K + per_view) of the distances of N correspondences per unit of K parameters.

    They come match after match, with columns as `_split_by_view` has them. `slopes` is called once a view, with all its
    points: a call costs more than its points.

    Args:
        slopes: called with a view, numbers (n,) of its points and their normals (n, 3); returns (n, K), how far these
            points move along the normals.
        per_view: the first `per_view` of the K have a value of their own in each view.
    """
    # By view: its matches, their rows among the N, and 1 where it is the second view, else 0.
    sides = defaultdict[int, list[tuple[Match, slice, int]]](list)
    end = 0
    for m in matches:
        start, end = end, end + len(m.residual)
        sides[m.v].append((m, slice(start, end), 0))
        sides[m.w].append((m, slice(start, end), 1))
    out = np.zeros((end, 0))
    for view in sorted(sides):
        index = np.concatenate([m.index_w if second else m.index_v for m, _, second in sides[view]])
        moved = slopes(view, index, np.concatenate([m.normal for m, _, _ in sides[view]]))
        out = out if out.shape[1] else np.zeros((end, moved.shape[1] + per_view))
        done = 0
        for m, rows, second in sides[view]:
            # The point of the second view counts negative, as in the distance.
            part = moved[done : done + len(m.residual)] * (1 - 2 * second)
            done += len(part)
            out[rows, second * per_view : (second + 1) * per_view] = part[:, :per_view]
            out[rows, 2 * per_view :] += part[:, per_view:]
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
