"""Normal equations over view pairs.

Every pair (v, w) sees e = e₀ + B(δ_v − δ_w) with B = [m × n, n], m the midpoint and n the mean
normal: the symmetric point-to-plane distance under left twists δ of the two poses in the reference
frame. Taking one midpoint for both sides keeps the common motion of all views exactly free. A
correction of the hand-eye ξ (right perturbation, scanner frame) moves view v by Ad(T_v) ξ, so the
hand-eye fit, the per-view fit and their statistics all read the same 6x6 Gram matrices: memory is
O(pairs), never O(points x parameters).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch.frames import Array, Mask
from stitch.observations.surfaces.match import Match
from stitch.statistics.robust import mad_sigma, tukey

# Residuals beyond 4 robust sigmas are not surface distances; for normal errors that cuts 0.006 %.
RMS_GATE = 4.0
_PAIR_FIELDS = ("pairs", "matrix", "vector", "square", "weight", "count", "raw_square", "labelled")


@dataclass(frozen=True)
class Gram:
    """Sums over the correspondences of P pairs of V views, about `centre`."""

    views: int
    pairs: Array  # (P, 2) int
    matrix: Array  # (P, 6, 6) Σ w BᵀB
    vector: Array  # (P, 6) Σ w Bᵀe
    square: Array  # (P,) Σ w e²
    weight: Array  # (P,) Σ w; 0 for labelled points
    count: Array  # (P,) correspondences inside the robust gate; 0 for labelled points
    raw_square: Array  # (P,) Σ e² inside the robust gate
    scale: float  # robust sigma of e
    centre: Array  # (3,)
    labelled: Mask  # (P,) pairs of labelled points (`target_pairs.py`), in the surfaces' unit of variance

    @property
    def rms(self) -> float:
        """Root mean square of e inside the robust gate."""
        return float(np.sqrt(self.raw_square.sum() / max(self.count.sum(), 1)))

    @property
    def lever(self) -> float:
        """Rms distance by which a radian about `centre` displaces the correspondences along their normals."""
        total = self.matrix.sum(axis=0)
        return float(np.sqrt(np.trace(total[:3, :3]) / max(np.trace(total[3:, 3:]), 1e-300)))

    def only(self, keep: Mask) -> "Gram":
        """The sums of some pairs (P,)."""
        return replace(self, **{name: getattr(self, name)[keep] for name in _PAIR_FIELDS})

    def append(self, **sums: Any) -> "Gram":
        """The sums, and after them those of further pairs of labelled points (P', ...) that have no surface."""
        count = len(sums["pairs"])
        nothing = np.zeros(count)
        everything: dict[str, Any] = sums | {
            "weight": nothing,
            "count": nothing.astype(int),
            "raw_square": nothing,
            "labelled": nothing == 0,
        }
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), everything[name]]) for name in _PAIR_FIELDS
        }
        return replace(self, **joined)

    @property
    def variance(self) -> float:
        """Weighted mean of e² between surfaces."""
        return float(self.square[~self.labelled].sum() / max(self.weight.sum(), 1e-300))


def robust_scale(matches: Iterable[Match]) -> float:
    """Robust sigma of the residuals of all pairs: they are symmetric about zero, so no centring."""
    residuals = [m.residual for m in matches]
    return mad_sigma(np.concatenate(residuals)) if residuals else float("nan")


def gram(
    matches: Sequence[Match], views: int, centre: Array, scale: float, weights: Sequence[Array] | None = None
) -> Gram:
    """Accumulate the pairs; Tukey weights at `scale` unless `weights` gives them per match, (M,) each.

    Args:
        centre: (3,) about which twists of the views count, reference frame.
    """
    rows = [_pair_sums(m, centre, scale, None if weights is None else weights[i]) for i, m in enumerate(matches)]
    sums = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    pairs = np.array([(m.v, m.w) for m in matches])
    return Gram(views=views, pairs=pairs, scale=scale, centre=centre, labelled=np.zeros(len(pairs), bool), **sums)


def _pair_sums(m: Match, centre: Array, scale: float, weight: Array | None) -> dict[str, Any]:
    """The sums over one pair, by their names in `Gram`."""
    e = m.residual
    if weight is None:
        weight = m.weight * tukey(e, scale)
    B = np.concatenate([np.cross(m.middle - centre, m.normal), m.normal], axis=1)
    weighted = B * weight[:, None]
    inside = np.abs(e) < RMS_GATE * scale
    return {
        "matrix": weighted.T @ B,
        "vector": weighted.T @ e,
        "square": float(weight @ e**2),
        "weight": float(weight.sum()),
        "count": int(inside.sum()),
        "raw_square": float((e[inside] ** 2).sum()),
    }


def assemble(g: Gram, keep: Array | Mask | None = None) -> tuple[Array, Array]:
    """H (6V, 6V) and b (6V,) of all pairs: the cost is ½ δᵀHδ + bᵀδ; `keep` masks pairs."""
    H = np.zeros((g.views, 6, g.views, 6))
    b = np.zeros((g.views, 6))
    for i, (v, w) in enumerate(g.pairs):
        if keep is not None and not keep[i]:
            continue
        H[v, :, v] += g.matrix[i]
        H[w, :, w] += g.matrix[i]
        H[v, :, w] -= g.matrix[i]
        H[w, :, v] -= g.matrix[i]
        b[v] += g.vector[i]
        b[w] -= g.vector[i]
    n = 6 * g.views
    return H.reshape(n, n), b.reshape(n)


def pair_squares(g: Gram, twists: Array) -> Array:
    """Σ w e² of every pair (P,) after the views moved by `twists` (V, 6), without new matches."""
    difference = twists[g.pairs[:, 0]] - twists[g.pairs[:, 1]]
    linear = np.einsum("pi,pi->p", g.vector, difference)
    quadratic = np.einsum("pi,pij,pj->p", difference, g.matrix, difference)
    return np.asarray(g.square + 2 * linear + quadratic)
