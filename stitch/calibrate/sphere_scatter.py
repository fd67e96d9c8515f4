"""How the views of a sphere scatter: σ_p of the sphere's place, σ_ρ of its apparent radius, σ_c of the points.

All three are found by restricted maximum likelihood (Patterson & Thompson 1971).
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from stitch.calibrate.sphere_views import SphereView
from stitch.frames import Array

# Mean square over the numbers of a view, in sigmas: beyond it a view counts less (a view in 150 by chance).
_OUTLYING = 4.0


def view_covariances(
    views: Sequence[SphereView], response: Sequence[Array], scatter: Array, shares: Array
) -> list[Array]:
    """Covariance of each view's circle or sphere: common error of the points, shift, apparent radius.

    Args:
        response: (k + 1, 3) of each view to a shift of the sphere.
        shares: (V,) from 0 to 1, how much of a view counts.
    """
    out = []
    for view, S, share in zip(views, response, shares, strict=True):
        covariance = view.covariance * (1 + (scatter[2] / view.sigma) ** 2) + scatter[0] ** 2 * S @ S.T
        covariance[-1, -1] += scatter[1] ** 2
        out.append(covariance / share)
    return out


def find_shares(e: Sequence[Array], whole: Sequence[Array]) -> Array:
    """Shares (V,) that views with residuals e (k + 1,) may have, `whole` their covariances at share 1."""
    square = np.array([r @ np.linalg.solve(V, r) / len(r) for r, V in zip(e, whole, strict=True)])
    return np.asarray(np.minimum(1.0, _OUTLYING / np.maximum(square, 1e-12)) ** 2)


def find_scatter(
    views: Sequence[SphereView],
    e: Sequence[Array],
    jacobian: Sequence[Array],
    response: Sequence[Array],
    *,
    last: Array,
    shares: Array,
) -> Array:
    """(σ_p, σ_ρ, σ_c) of the largest restricted likelihood of the linear model."""

    def cost(log_scatter: Array) -> float:
        W = [
            np.linalg.inv(np.linalg.cholesky(V)) for V in view_covariances(views, response, np.exp(log_scatter), shares)
        ]
        J = np.concatenate([w @ j for w, j in zip(W, jacobian, strict=True)])
        r = np.concatenate([w @ x for w, x in zip(W, e, strict=True)])
        R, Q = np.linalg.qr(J)[::-1]
        spread = -sum(np.log(np.diag(w)).sum() for w in W)
        return float(2 * spread + 2 * np.log(np.abs(np.diag(R))).sum() + r @ r - np.sum((Q.T @ r) ** 2))

    start = np.log(last)
    # Below a thousandth of the points' sigma a scatter is none.
    floor = np.log(1e-3 * np.median([v.sigma for v in views]))
    bounds = [(max(x - 2, floor), max(x + 2, floor + 1)) for x in start]
    found = minimize(cost, np.maximum(start, floor), method="L-BFGS-B", bounds=bounds).x
    return np.asarray(np.exp(found))
