"""The residuals of a model as a review keeps them, and what is asked of them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Indices
from viz.review.chosen_field import Choice, PatchWeights, chosen_field, patch_weights
from viz.review.chosen_points import chosen_points, numbered_marks
from viz.review.residual_rows import ResidualRows, read_rows, read_sightings
from viz.review.run_snapshot import Snapshot


@dataclass(frozen=True)
class KnownResiduals:
    """Residuals of a model, how they count for the patches of the part, and the field of all of them."""

    model: str
    rows: ResidualRows
    weights: PatchWeights | None  # None of labelled points, which have marks
    marks: Indices  # (M, 2) of labelled points
    all: dict[str, Any]

    def chosen(self, choice: Choice, comparison: dict[str, Any] | None, um: float) -> dict[str, Any]:
        """Field and numbers of a choice.

        Raises:
            InputError: a view, a property or a bin that the run does not have.
        """
        if self.weights is None:
            return chosen_points(self.rows, self.marks, choice, comparison, um)
        if choice.place is not None and not choice.within:
            choice = replace(choice, within=2 * self.weights.radius)
        return chosen_field(self.rows, self.weights, choice, comparison, um)


def known_residuals(run: Path, found: Snapshot, um: float) -> KnownResiduals:
    """Read what a run left.

    Args:
        um: micrometres in one length_unit.

    Raises:
        InputError: a damaged file, or a page without the part.
    """
    everything, none = Choice(), np.zeros((0, 2), np.int64)
    if found.state["labelled"]:
        rows = read_sightings(run, found.result)
        marks = none if found.part is None else numbered_marks(rows, found.part)
        return KnownResiduals(found.model, rows, None, marks, chosen_points(rows, marks, everything, None, um))
    told = read_rows(run, found.result)
    if told is None or found.part is None:
        raise InputError(f"{run}: has no surfaces to show a part of")
    weights = patch_weights(told, found.part)
    return KnownResiduals(found.model, told, weights, none, chosen_field(told, weights, everything, None, um))
