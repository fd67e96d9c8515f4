"""Tests of one view's own displacement, or of a block's, under the scatter of the other poses.

The per-view evidence of overlaps is linear: z = X ξ + Σ L_v δ_v + ε, with ξ the hand-eye, δ_v a displacement of view v
(left twist in the reference frame) and cov(ε) of pose scatter and sensor noise. With P = C⁻¹ − C⁻¹X(XᵀC⁻¹X)⁻¹XᵀC⁻¹, the
statistic of an alternative with columns G is T = uᵀN⁻¹u, u = GᵀPz, N = GᵀPG: χ² with rank(N) degrees of freedom, with
non-centrality δᵀNδ where a blunder δ is present (Baarda 1968; Teunissen, Testing Theory, 2000).
"""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.integrity.view_model import SEEN, Projector
from stitch.statistics.tails import f_tail


@dataclass(frozen=True)
class AlternativeTest:
    """One alternative, tested."""

    statistic: float  # T
    degrees: int
    p_value: float  # under F, the scatter being estimated from the same data
    estimate: Array  # (6,) displacement, rotations in 1/lever
    normal: Array  # (6, 6) N: non-centrality of a displacement δ is δᵀNδ


def hstack_columns(columns: Array | None, more: Array) -> Array:
    """(n, ·) columns with more of them, where there are any."""
    return more if columns is None else np.column_stack([columns, more])


def test_alternative(under: Projector, columns: Array) -> AlternativeTest:
    """The alternative with `columns` (n, 6) under a null hypothesis."""
    N, u = columns.T @ under.P @ columns, columns.T @ under.projected
    inverse, degrees = _pseudo_inverse(N)
    statistic = float(u @ inverse @ u)
    nu = under.degrees - degrees
    if degrees == 0 or nu < 1:
        return AlternativeTest(0.0, degrees, 1.0, np.zeros(len(N)), N)
    # The scatter is estimated with the view in it: T/ν is a beta variable, told as the F of the left-out estimate.
    rest = max(under.degrees - statistic, 1e-9 * under.degrees)
    p = f_tail(statistic / degrees / (rest / nu), degrees, nu)
    return AlternativeTest(statistic, degrees, p, inverse @ u, N)


def _pseudo_inverse(N: Array) -> tuple[Array, int]:
    """Pseudo-inverse and rank of a symmetric matrix whose units may differ."""
    scale = 1 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    keep = values > SEEN * max(values[-1], 1e-300)
    scaled = vectors[:, keep] * scale[:, None]
    return np.asarray((scaled / values[keep]) @ scaled.T), int(keep.sum())
