"""Smooth errors of the scans themselves in words: the same in every view, or every view's own."""

from stitch.observations.surfaces.field_error import FieldError
from stitch.units import length_text


def beside_adequate(found: FieldError | None, length_unit: str) -> str:
    """What stands beside a model to which nothing is missing; empty where nothing is unusual."""
    if found is None:
        return ""
    same, changing = (length_text(size, length_unit, 2) for size in (found.rms, found.changing))
    said = [f"the scanner errs by {same} rms over its field, the same in every view"] if found.rms else []
    if found.changing:
        said.append(f"the scans err by {changing} rms, smoothly and every view by itself{_with_time(found)}")
    return f"; {' and '.join(said)}, which no pose corrects"


def smooth_errors(found: FieldError | None, length_unit: str) -> str:
    """Where nothing is named, what the scans err by, and what to do; None: as the views' poses show it."""
    same = f" ({length_text(found.rms, length_unit, 2)} rms)" if found is not None and found.rms else ""
    if found is None or not found.changing:
        return (
            f"the scanner errs by where in its field a point is seen, the same in every view{same}; have it "
            "calibrated, or describe how it errs by an effect of your own"
        )
    size = length_text(found.changing, length_unit, 2)
    return (
        f"the scans err smoothly, every view by itself ({size} rms{_with_time(found)}): a part that bends or moves, an "
        "arm that still settles while a scan is read, a scanner that warms up or errs by range, brightness or a finer "
        "law; scan the first pose again at the end: what differs then is of the part or of the time"
    )


def _with_time(found: FieldError) -> str:
    return ", as the session goes on" if found.with_time else ""
