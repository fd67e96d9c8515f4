"""How the views answer to parameters of effects: left twists of every view, as the overlaps would see them.

Effects of robot, mount and part move views as a whole. Effects of points change what the overlaps
measure; what they look like to the poses is H⁺BᵀWg, with g the change of the distance e per unit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.effects.chain import Chain, Term, shifts, twists
from stitch.frames import Array
from stitch.free_poses import FreePoses, visible_directions
from stitch.match import Match
from stitch.solve import tukey
from stitch.threads import parallel

POINTS = ("sensor", "shape")


@dataclass(frozen=True)
class PointGram:
    """Sums over the correspondences of P pairs for K parameters of point effects, about the Gram's centre."""

    vector: Array  # (P, 6, K) Σ w Bᵀg
    residual: Array  # (P, K) Σ w g e
    square: Array  # (P, K, K) Σ w g gᵀ


def pose_twists(chain: Chain, terms: Sequence[Term], term: Term, T_mount: Array, freed: FreePoses) -> Array:
    """(6V, P) of an effect of robot, links, mount or part."""
    found = twists(chain, terms, term, T_mount, freed.overlaps.gram.centre)
    return np.asarray(found.reshape(len(found), -1).T)


def point_gram(chain: Chain, terms: Sequence[Term], candidates: Sequence[Term], freed: FreePoses) -> PointGram:
    """Stream the pairs once for all parameters of the point effects in `candidates`."""
    matches, g = freed.overlaps.matches, freed.overlaps.gram
    used = [np.zeros(len(scan.points), bool) for scan in chain.capture.scans]
    for m in matches:
        used[m.v][m.index_v] = True
        used[m.w][m.index_w] = True
    index = [np.flatnonzero(u) for u in used]

    def slopes(v: int) -> Array:
        found = [shifts(chain, terms, term, v, freed.poses[v], index[v]) for term in candidates]
        # In the reference frame; single precision is plenty for a slope.
        turned = frames.rotate(freed.poses[v], np.concatenate(found).reshape(-1, 3))
        return turned.reshape(-1, len(index[v]), 3).astype(np.float32)

    by_view = list(parallel(slopes, range(len(index))))
    place = [np.cumsum(u) - 1 for u in used]

    def of_pair(m: Match) -> tuple[Array, Array, Array]:
        d = by_view[m.v][:, place[m.v][m.index_v]] - by_view[m.w][:, place[m.w][m.index_w]]
        change = np.einsum("kni,ni->nk", d.astype(float), m.normal)
        weight = m.weight * tukey(m.residual, g.scale)
        B = np.concatenate([np.cross(m.middle - g.centre, m.normal), m.normal], axis=1)
        weighted = change * weight[:, None]
        return B.T @ weighted, weighted.T @ m.residual, weighted.T @ change

    sums = list(parallel(of_pair, matches))
    return PointGram(*(np.array([s[i] for s in sums]) for i in range(3)))


def seen_twists(points: PointGram, freed: FreePoses) -> Array:
    """(6V, K) H⁺BᵀWg: what point effects do to poses that the overlaps alone determine."""
    g = freed.overlaps.gram
    K = points.vector.shape[2]
    b = np.zeros((g.views, 6, K))
    v, w = g.pairs.astype(np.int64).T
    np.add.at(b, v, points.vector)
    np.subtract.at(b, w, points.vector)
    values, vectors, scale = visible_directions(g)
    return np.asarray(
        scale[:, None] * (vectors @ ((vectors.T @ (scale[:, None] * b.reshape(-1, K))) / values[:, None]))
    )


def all_columns(
    chain: Chain, terms: Sequence[Term], candidates: Sequence[Term], T_mount: Array, freed: FreePoses
) -> tuple[list[Array], PointGram | None, list[slice | None]]:
    """Per candidate (6V, P); the point effects' sums, and where each candidate's columns are in them."""
    points = [c for c in candidates if c.effect.place in POINTS]
    sums = point_gram(chain, terms, points, freed) if points else None
    seen = seen_twists(sums, freed) if sums else None
    columns, where, at = [], list[slice | None](), 0
    for candidate in candidates:
        if candidate.effect.place in POINTS:
            assert seen is not None
            own = slice(at, at + len(candidate.values))
            columns.append(seen[:, own])
            where.append(own)
            at = own.stop
        else:
            columns.append(pose_twists(chain, terms, candidate, T_mount, freed))
            where.append(None)
    return columns, sums, where
