"""The picture and the numbers of what was chosen among labelled points: views, targets, bins of a property."""

import json
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Indices
from viz.packed_numbers import packed_values
from viz.review.chosen_field import Choice, chosen_rows
from viz.review.residual_rows import ResidualRows
from viz.target_marks import ANY, NOTHING, mark_values


def numbered_marks(rows: ResidualRows, part: str) -> Indices:
    """(M, 2) view and target of the marks of a viewer's data (JSON), as numbers of the rows.

    Raises:
        InputError: data of a page that an older version wrote, or of another run.
    """
    data = json.loads(part)
    try:
        return np.array([_numbered(view, target, rows) for view, target in data["marks"]], np.int64)
    except (KeyError, ValueError):
        raise InputError(
            "report.html: is not of this run as it stands; to fix: `stitch report RUN --no-diagnosis`"
        ) from None


def _numbered(view: str | None, target: str | None, rows: ResidualRows) -> tuple[int, int]:
    if view is None and target is None:
        return NOTHING, NOTHING
    return (
        ANY if view is None else rows.views.index(view),
        ANY if target is None else rows.targets.index(target),
    )


def chosen_points(
    rows: ResidualRows, marks: Indices, choice: Choice, comparison: dict[str, Any] | None, um: float
) -> dict[str, Any]:
    """Plain data as of a field, errors in µm; the values are those of the marks.

    Args:
        marks: (M, 2) as `numbered_marks` has them.
        comparison: compare.json, whose tables have the bins.

    Raises:
        InputError: a view, a target, a property or a bin that the run does not have.
    """
    mask = chosen_rows(rows, choice, comparison)
    distances = rows.residual[mask] * um
    return {
        "views": len(np.unique(rows.view[mask])),
        "correspondences": len(distances),
        "rms": float(np.sqrt(np.mean(distances**2))) if len(distances) else None,
        "signed": None,
        "mean": None,
        "values": packed_values(mark_values(marks, rows.view[mask], rows.target[mask], distances)),
    }
