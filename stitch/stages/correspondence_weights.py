"""What each correspondence counts in `register`: plane to plane (GICP) inside Tukey's biweight.

Of the families compared in docs/register.md the best. Both factors are 1 where two views agree, and neither depends on
the order of the views.
"""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.gram import robust_scale
from stitch.observations.surfaces.match import Match
from stitch.statistics.robust import tukey

# Variance along the normal over that across it (Segal, Haehnel & Thrun 2009).
_EPSILON = 1e-3


def plane_weights(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Weights (M,) per match: agreement of the normals times the biweight of the distance.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    scale = robust_scale(matches)
    return [agreement(m, capture, poses) * tukey(m.residual, scale) for m in matches]


def agreement(m: Match, capture: Capture, poses: Array) -> Array:
    """(M,) weight of two planes whose normals part by θ: 1/(cos² + sin²/ε) of θ/2.

    The inverse of nᵀ(C_v + C_w)n, with n the mean normal and C variances ε along a point's normal and 1 across it, over
    its value at θ = 0. What is not the same plane, as the two sides of a thin edge or points that fly behind a
    silhouette, counts little even where the distance happens to be small.
    """
    T_w_v = frames.inverse(poses[m.w]) @ poses[m.v]
    normals = frames.rotate(T_w_v, capture.scans[m.v].normals[m.index_v])
    cosine = np.einsum("ij,ij->i", normals, capture.scans[m.w].normals[m.index_w])
    sine2 = np.clip(1 - cosine, 0.0, 2.0) / 2
    return np.asarray(1 / (1 - sine2 + sine2 / _EPSILON))
