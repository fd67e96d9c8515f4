"""How well the scatter is known in a direction: Satterthwaite's degrees of freedom.

The variance s of a combination of what was seen is Σ λ_i s_i over the components of `variance_components.py`, whose
REML estimates have the information ½ tr(P C_i P C_j). An estimate of s of relative variance 2/ν is worth a
χ² of ν degrees of freedom (Satterthwaite 1946; Kenward & Roger 1997, Biometrics 53:983).
"""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.statistics.least_squares import column_space
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.variance_components import VarianceFit, whitener
from stitch.statistics.variance_prior import prior_information

# More is as good as knowing it.
_MANY = 1e4


@dataclass(frozen=True)
class Satterthwaite:
    """The components in units of the scatter, and how well their variances are known."""

    white: Array  # (c, B, m, m)
    spread: Array  # (c, c) covariance of the log variances

    def degrees_of_freedom(self, white: Array) -> float:
        """Degrees of freedom of the scatter along whitened columns (B, m, p), on average over them."""
        directions = column_space(white.reshape(-1, white.shape[2])).reshape(*white.shape[:2], -1)
        if not directions.shape[2]:
            return _MANY
        shares = np.einsum("bik,cbij,bjk->c", directions, self.white, directions, optimize=True) / directions.shape[2]
        return float(min(2 / max(shares @ self.spread @ shares, 2 / _MANY), _MANY))


def satterthwaite(mixed: MixedModel, null: VarianceFit) -> Satterthwaite:
    """From the fit without the columns that are asked for."""
    half = whitener(mixed, null.variances)
    white = null.variances[:, None, None, None] * (half @ mixed.components @ half.transpose(0, 2, 1))
    mean = half @ mixed.A
    U = column_space(mean.reshape(-1, mean.shape[2])).reshape(*mean.shape[:2], -1)
    KU = white @ U
    within = np.einsum("bik,cbil->ckl", U, KU, optimize=True)
    # tr(M K_i M K_j) with M = 1 − UUᵀ.
    information = 0.5 * (
        np.einsum("cbij,dbij->cd", white, white, optimize=True)
        - 2 * np.einsum("cbik,dbik->cd", KU, KU, optimize=True)
        + np.einsum("ckl,dkl->cd", within, within, optimize=True)
    )
    information += np.diag(prior_information(null.variances, mixed.further))
    return Satterthwaite(white, np.linalg.pinv(information, rcond=1e-9, hermitian=True))
