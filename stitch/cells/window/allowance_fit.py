"""The allowance beside the pose: scale, shrinkage, what can be told, and the result.

From mean(d²) = Var(d) + mean(d)² a cost Var(d) + λ·mean(d)² can be chosen; the ordinary fit has λ = 1. With an unknown
allowance λ = 0: only the variance of the distances is made small (variance-minimisation matching), and their mean is
the allowance. A column of ones beside the six of the pose does the same and gives its sigma. Distances above and below
the allowance are two classes, plus and minus, each with its own scale, and the cleaner one counts for both: gates,
risers and flash all stand on one side.
"""

import numpy as np

from stitch.cells.window.allowance import Allowance, AllowancePrior, allowance_columns
from stitch.cells.window.biweight import MAD
from stitch.cells.window.cad import CadSurface
from stitch.errors import NoResultError
from stitch.frames import Array

# Share of an even allowance that no motion of the part imitates. Below, an error of the part's form would enter the
# allowance more than thirtyfold.
_MIN_SEPARABLE_SHARE = 1e-3
# A class of fewer than this share of the points has no scale of its own.
_CLASS = 0.1
# A field this far below the scatter of the points is none.
_MIN_FIELD_SHARE = 1e-3


def robust_spread(rest: Array, prior: AllowancePrior) -> float:
    """Robust sigma of distances (N,) less their allowance: of the cleaner class where one is to be found."""
    if prior.free:
        sides = [np.abs(rest[rest >= 0]), np.abs(rest[rest < 0])]
        if min(map(len, sides)) >= _CLASS * len(rest):
            return MAD * min(float(np.median(side)) for side in sides)
    return MAD * float(np.median(np.abs(rest)))


def separable_share(N: Array) -> float:
    """Share of an even allowance that no motion of the part imitates, from the normal matrix (6 + K, 6 + K).

    Raises:
        NoResultError: next to nothing; says which motion does.
    """
    motion = np.linalg.solve(N[:6, :6], N[:6, 6])
    share = float(1 - motion @ N[:6, 6] / N[6, 6])
    if share < _MIN_SEPARABLE_SHARE:
        shift = -motion[3:] / max(float(np.linalg.norm(motion[3:])), 1e-300)
        along = " ".join(f"{x:.2f}" for x in shift)
        raise NoResultError(
            f"the allowance cannot be told from a shift of the part along ({along}): all that was scanned looks to "
            "one side; scan opposite sides too, or state the stock, as --allowance 0.3"
        )
    return share


def varying_ridge(N: Array, coefficients: Array, scale: float, before: float) -> tuple[Array, float]:
    """(6 + K,) what shrinks the varying part, in units of N, and its size τ by MacKay's evidence (1992).

    Pose and mean are free. Of a flat field the evidence lets τ fall to nothing.

    Args:
        N: normal matrix of weights that are 1 where nothing is wrong.
        before: τ of the round before.
    """
    weights = np.zeros(len(N))
    varying = coefficients[1:]
    if not len(varying):
        return weights, before
    weights[7:] = (scale / before) ** 2
    left = np.diag(np.linalg.inv(N + np.diag(weights)))[7:] * weights[7:]
    size = np.sqrt(float(varying @ varying) / max(float((1 - left).sum()), 1e-3))
    size = max(float(size), _MIN_FIELD_SHARE * scale)
    weights[7:] = (scale / size) ** 2
    return weights, size


def summarise_allowance(
    points: Array, cad: CadSurface, prior: AllowancePrior, coefficients: Array, covariance: Array, N: Array
) -> Allowance | None:
    """The allowance as people want it, over the fit's points (N, 3), part frame; None where none was spoken of.

    Args:
        covariance: of pose and coefficients, (6 + K, 6 + K).
        N: their normal matrix.
    """
    if prior == AllowancePrior():
        return None
    B = allowance_columns(points, cad, prior)
    local, C, mean = prior.known + B @ coefficients, covariance[6:, 6:], B.mean(axis=0)
    return Allowance(
        value=prior.known + float(mean @ coefficients),
        sigma=float(np.sqrt(mean @ C @ mean)),
        lowest=float(local.min()),
        highest=float(local.max()),
        sigma_field=float(np.sqrt(np.einsum("ni,ij,nj->n", B, C, B).max())),
        prior=prior,
        separable_share=separable_share(N) if prior.free else 1.0,
        coefficients=coefficients,
        cad=cad,
    )
