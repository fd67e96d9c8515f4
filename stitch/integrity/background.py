"""What the scans show beside the part: what stands still before the scanner, and what only one of them shows."""

from stitch.frames import Array
from stitch.integrity.in_the_way import find_occluder
from stitch.integrity.linkage import names_of_views
from stitch.integrity.problems import SessionProblem
from stitch.integrity.snooping import Snooping
from stitch.integrity.standing_still import find_static_background
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.session import Session


def background_problems(session: Session, own: Capture, T_mount: Array, found: Snooping) -> list[SessionProblem]:
    """One problem for each, with the views that show it.

    Args:
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    out, size, names = list[SessionProblem](), part_size([own]), session.names
    still = find_static_background(own.scans, own.poses(T_mount), found.tolerance, size)
    if still is not None:
        out.append(
            SessionProblem("foreign", tuple(names_of_views(still.views, names)), still.describe(session.length_unit))
        )
    if out or found.left_out or found.steps:
        # What stands still stands elsewhere on the part in every view, and so does the part itself where a view is off;
        # without that view it is asked again.
        return out
    stray = find_occluder(own.scans, found.unconstrained.poses, size)
    if stray is not None:
        out.append(SessionProblem("foreign", tuple(names_of_views(stray.views, names)), stray.describe(names)))
    return out
