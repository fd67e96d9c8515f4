"""What is said of a session as a whole before its verdict, though it runs."""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.arm_limits import contradiction_in_words, scatter_is_doubtful
from stitch.integrity.background import background_problems
from stitch.integrity.snooping import Snooping
from stitch.integrity.three_views import check_three_views
from stitch.measurement.capture import Capture
from stitch.measurement.session import Session

_LISTED = 3


def snooping_warnings(session: Session, own: Capture, found: Snooping, T_mount: Array) -> tuple[str, ...]:
    """What is no part, steps, and poses that contradict the scans as no arm of use does.

    Args:
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    names = session.names
    beside = (problem.fix for problem in background_problems(session, own, T_mount, found))
    said = (*beside, *(step.describe(names, session.length_unit) for step in found.steps))
    if not scatter_is_doubtful(session, found):
        few = check_three_views(session, found)
        return said if few is None else (few, *said)
    twists = frames.log(found.unconstrained.poses @ frames.inverse(own.poses(T_mount)))
    middles = np.array([points.mean(axis=0) for points in own.visible_points])
    moved = np.linalg.norm(
        twists[:, 3:] + np.cross(twists[:, :3], frames.transform(own.poses(T_mount), middles[:, None])[:, 0]), axis=1
    )
    worst = [v for v in np.argsort(-moved) if v not in found.left_out][:_LISTED]
    farthest = ", ".join(f"{names[v]} ({moved[v]:.3g} {session.length_unit})" for v in worst)
    return (
        f"No arm scatters by {contradiction_in_words(session, found)}: several rows or scans are wrong, and the views hold "
        f"together by their surfaces alone; hand-eye and pose errors mean little. Look first at {farthest}.",
        *said,
    )
