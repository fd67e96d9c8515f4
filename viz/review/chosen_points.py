"""The numbers of what was chosen among labelled points: some views, bins of a property."""

from typing import Any

import numpy as np

from viz.review.chosen_field import Choice, chosen_rows
from viz.review.residual_rows import ResidualRows


def chosen_points(rows: ResidualRows, choice: Choice, comparison: dict[str, Any] | None, um: float) -> dict[str, Any]:
    """The numbers of a choice; plain data as of a field, without one, errors in µm.

    Args:
        comparison: compare.json, whose tables have the bins.

    Raises:
        InputError: a view, a property or a bin that the run does not have.
    """
    mask = chosen_rows(rows, choice, comparison)
    distances = rows.residual[mask] * um
    return {
        "views": len(np.unique(rows.view[mask])),
        "correspondences": len(distances),
        "rms": float(np.sqrt(np.mean(distances**2))) if len(distances) else None,
        "signed": None,
        "mean": None,
        "values": "",
    }
