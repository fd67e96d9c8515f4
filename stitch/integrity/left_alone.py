"""One view tested under the scatter that the others have without it: it cannot hide in what it inflates itself."""

from stitch.frames import Array
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import AlternativeTest, hstack_columns, test_alternative
from stitch.statistics.tails import f_tail


def leave_one_out_test(model: ViewModel, columns: Array | None, view: int) -> tuple[AlternativeTest, float]:
    """One view tested under the scatter that all others have without it, and the chance of that.

    One of six views hides in a scatter that it inflates itself. Rotations and translations share the degrees of freedom
    of a scatter taken from the rest: half of them count.
    """
    own = model.views[view]
    under = projector(model, model.fit(hstack_columns(columns, own)), columns)
    # Where a scan slides it rests anywhere.
    tested = test_alternative(under, model.held_responses[view])
    free = max((under.degrees - tested.degrees) // 2, 1)
    return tested, f_tail(tested.statistic / max(tested.degrees, 1), max(tested.degrees, 1), free)
