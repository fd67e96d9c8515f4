"""Both solutions of one stand, after the check that its readings belong together."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from stitch.cells.base_to_base.contradiction import DistanceComparison, compare_distances
from stitch.cells.base_to_base.stand import Stand
from stitch.cells.base_to_base.stand_fit import BaseFit, fit_stand
from stitch.cells.base_to_base.stand_projection import Projection, project
from stitch.errors import NoResultError

# A distance that differs by more than this many sigmas is a wrong reading, not noise (one in two million).
CONTRADICTION_SIGMAS = 5.0


@dataclass(frozen=True)
class BaseResult:
    """Both solutions and the comparisons behind them."""

    length_unit: str
    fit: BaseFit
    projection: Projection | None
    no_projection: str | None  # why there is none
    comparisons: tuple[DistanceComparison, ...]


def solve_stand(stand: Stand) -> BaseResult:
    """Check, then solve by least squares and, where it applies, by the source's projection.

    Raises:
        NoResultError: the readings contradict each other, or leave the second base open.
    """
    comparisons = compare_distances(stand)
    wrong = [c for c in comparisons if c.sigmas > CONTRADICTION_SIGMAS]
    if wrong:
        raise NoResultError(
            "rod and joints contradict each other: "
            + "; ".join(comparison_text(c, stand.length_unit) for c in wrong)
            + ". No transform is given; read these points again"
        )
    solution = fit_stand(stand)
    if solution.p_value < 2 * norm.sf(CONTRADICTION_SIGMAS):
        raise NoResultError(
            f"the readings contradict each other: chi-square {solution.chi_square:.1f} with {solution.redundancy} "
            f"redundant readings; {_worst(stand, solution)}. Read that point again, or state larger sigmas"
        )
    try:
        return BaseResult(stand.length_unit, solution, project(stand), None, comparisons)
    except NoResultError as error:
        return BaseResult(stand.length_unit, solution, None, str(error), comparisons)


def comparison_text(c: DistanceComparison, unit: str) -> str:
    """One comparison in words and numbers."""
    a, b = c.pair
    return (
        f"{a} to {b} is {c.by_stand:.4f} {unit} by the stand and {c.by_robot:.4f} {unit} by the robot, a difference of "
        f"{c.difference:+.4f} {unit} or {c.sigmas:.1f} sigma"
    )


def base_document(result: BaseResult) -> dict[str, Any]:
    """Plain numbers for JSON: lengths in length_unit, angles in rad."""
    solution, projection = result.fit, result.projection
    return {
        "length_unit": result.length_unit,
        "T_base1_base2": solution.T_base1_base2.tolist(),
        "sigma": {"rotation": solution.sigma[:3].tolist(), "translation": solution.sigma[3:].tolist()},
        "covariance": solution.covariance.tolist(),
        "T_base1_stand": solution.T_base1_stand.tolist(),
        "rail_residuals": solution.rail_residuals.tolist(),
        "rod_residuals": solution.rod_residuals.tolist(),
        "chi_square": solution.chi_square,
        "redundancy": solution.redundancy,
        "p_value": solution.p_value,
        "projection": None if projection is None else _projection_document(projection),
        "no_projection": result.no_projection,
        "distances": [
            {"pair": c.pair, "by_stand": c.by_stand, "by_robot": c.by_robot, "sigma": c.sigma, "sigmas": c.sigmas}
            for c in result.comparisons
        ],
    }


def _projection_document(projection: Projection) -> dict[str, Any]:
    return {
        "T_base1_base2": projection.T_base1_base2.tolist(),
        "gamma_beta_alpha": [None if np.isnan(a) else float(a) for a in projection.gamma_beta_alpha],
        "offsets": projection.offsets.tolist(),
    }


def _worst(stand: Stand, solution: BaseFit) -> str:
    names = stand.rail.names + stand.rod.names
    sizes = np.linalg.norm(np.vstack([solution.rail_residuals, solution.rod_residuals]), axis=1)
    worst = int(np.argmax(sizes))
    return f"the largest misfit is {sizes[worst]:.4g} {stand.length_unit} at {names[worst]}"
