"""Methods that register could take: published kernels, and members of the "plus and minus" family."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.fusion.correspondence_weights import agreement
from stitch.fusion.register import DPWVM, GICP, Method
from stitch.numerics.distributions import MAD_TO_SIGMA, mad_sigma, tukey
from stitch.numerics.frames import Array
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import robust_scale
from stitch.session.capture import Capture

_HUBER = 1.345  # 95 % efficient on normal errors (Holland & Welsch 1977)
# A pair's own noise counts as if so many correspondences had shown the noise of all.
_POOLED = 200


def by_tukey(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Confidence of the incidence times the biweight at the robust sigma of all pairs."""
    scale = robust_scale(matches)
    return [m.weight * tukey(m.residual, scale) for m in matches]


def by_huber(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """The same with Huber's weights."""
    limit = _HUBER * robust_scale(matches)
    return [m.weight * np.minimum(1.0, limit / np.maximum(np.abs(m.residual), 1e-300)) for m in matches]


def by_gicp(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Plane to plane: the inverse of nᵀ(C_v + C_w)n, n the mean normal; 1 where the two normals agree."""
    return [agreement(m, capture, poses) for m in matches]


def by_sign_classes(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """Source A's family as first read: exp(−(d−μ±)²/2σ±²) by the sign of d, over density, times confidence; λ = 1.

    Two views that agree perfectly get exp(−½(μ/σ)²), not 1; (v, w) and (w, v) are told apart.
    """
    base = [m.weight * _by_density(m, capture) for m in matches]
    d, b = np.concatenate([m.residual for m in matches]), np.concatenate(base)
    weight = b.copy()
    for side in (d >= 0, d < 0):
        mean = np.average(d[side], weights=b[side])
        sigma = MAD_TO_SIGMA * np.median(np.abs(d[side] - mean))
        weight[side] *= np.exp(-((d[side] - mean) ** 2) / (2 * max(sigma, 1e-12) ** 2))
    return np.split(weight, np.cumsum([len(m.residual) for m in matches])[:-1])


def by_own_variances(matches: Sequence[Match], capture: Capture, poses: Array) -> list[Array]:
    """The family made symmetric: both classes share one scale, each pair has its own.

    Biweight and confidence as Tukey's; over density, since crowded points share their errors; times the agreement of
    the normals, since of a thin edge and of flying points they differ; over the variance of the pair, since pairs of
    small or slanted overlap scatter more.
    """
    scale, out = robust_scale(matches), []
    for m in matches:
        n = len(m.residual)
        variance = (n * mad_sigma(m.residual) ** 2 + _POOLED * scale**2) / (n + _POOLED)
        own = m.weight * _by_density(m, capture) * agreement(m, capture, poses)
        out.append(own * tukey(m.residual, float(np.sqrt(variance))) * scale**2 / variance)
    return out


def _by_density(m: Match, capture: Capture) -> Array:
    area = capture.scans[m.v].area[m.index_v] * capture.scans[m.w].area[m.index_w]
    return np.asarray(np.clip(np.sqrt(area / np.median(area)), 0.2, 5.0))


CLOSED, DPWVM_STYLE = "GICP inside Tukey", "DPWVM-style"
METHODS: dict[str, Method] = {
    "Tukey": Method("tukey", by_tukey),
    "Huber": Method("huber", by_huber),
    "GICP": Method("plane", by_gicp),
    CLOSED: GICP,
    "sign classes": Method("sign", by_sign_classes),
    "symmetric, own variances": Method("own", by_own_variances),
    "DPWVM-style, λ = 1 for all": replace(DPWVM, offsets=False),
    DPWVM_STYLE: DPWVM,
}
