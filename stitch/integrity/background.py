"""What the scans show beside the part: what stands still before the scanner, and what only one of them shows."""

from stitch.frames import Array
from stitch.integrity.in_the_way import in_the_way
from stitch.integrity.linkage import only
from stitch.integrity.problems import Problem
from stitch.integrity.snooping import Snooping
from stitch.integrity.standing_still import standing_still
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.session import Session


def background(session: Session, own: Capture, T_mount: Array, found: Snooping) -> list[Problem]:
    """One problem for each, with the views that show it.

    Args:
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    out, size, names = list[Problem](), part_size([own]), session.names
    still = standing_still(own.scans, own.poses(T_mount), found.tolerance, size)
    if still is not None:
        out.append(Problem("foreign", tuple(only(still.views, names)), still.said(session.length_unit)))
    if out or found.left_out or found.steps:
        # What stands still stands elsewhere on the part in every view, and so does the part itself where a view is off;
        # without that view it is asked again.
        return out
    stray = in_the_way(own.scans, found.freed.poses, size)
    if stray is not None:
        out.append(Problem("foreign", tuple(only(stray.views, names)), stray.said(names)))
    return out
