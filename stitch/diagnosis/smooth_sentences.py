"""Smooth errors of the scans themselves in words: the same in every view, or every view's own."""

from stitch.observations.surfaces.field_error import FieldError
from stitch.units import length_text


def scanner_clause_if_adequate(found: FieldError | None, length_unit: str) -> str:
    """What stands beside a model to which nothing is missing; empty where nothing is unusual."""
    if found is None:
        return ""
    calibration = "" if found.by_view else ", but a calibration may"
    return f"; {_scanner_error_clause(found, length_unit)}, which no pose corrects{calibration}"


def scanner_clause_before_poses(found: FieldError | None, length_unit: str) -> str:
    """What is said of the scans before what poses do that has no name; empty where nothing is unusual."""
    if found is None:
        return ""
    follows = f" ({_CAUSES}), so that poses found from them scatter too" if found.by_view else ""
    return f"{_scanner_error_clause(found, length_unit)}{follows}; "


def scanner_error_sentence(found: FieldError | None, length_unit: str) -> str:
    """Where nothing is named, what the scans err by, and what to do; None: as the views' poses show it."""
    if found is not None and found.by_view:
        size = length_text(found.rms_by_view, length_unit, 2)
        return (
            f"the scans err smoothly, every view by itself ({size} rms{_drift_clause(found)}): {_CAUSES}; scan the first "
            "pose again at the end: what differs then is of the part or of the time"
        )
    size = f" ({length_text(found.rms, length_unit, 2)} rms)" if found is not None else ""
    more = "" if found is None else _per_view_clause(found)
    return (
        f"the scanner errs by where in its field a point is seen, the same in every view{size}{more}; have it "
        "calibrated, or describe how it errs by an effect of your own"
    )


_CAUSES = (
    "a part that bends or moves, an arm that still settles while a scan is read, a scanner that warms up or errs by "
    "range, brightness or a finer law"
)


def _scanner_error_clause(found: FieldError, length_unit: str) -> str:
    """The clearer of the two kinds, with its size."""
    if found.by_view:
        size = length_text(found.rms_by_view, length_unit, 2)
        return f"the scans err by {size} rms, smoothly and every view by itself{_drift_clause(found)}"
    size = length_text(found.rms, length_unit, 2)
    return f"the scanner errs by {size} rms over its field, the same in every view{_per_view_clause(found)}"


def _per_view_clause(found: FieldError) -> str:
    """What views have for themselves besides; how much is uncertain beside what they have in common."""
    return f", and in part every view by itself{_drift_clause(found)}" if found.rms_by_view else ""


def _drift_clause(found: FieldError) -> str:
    return ", as the session goes on" if found.with_time else ""
