"""What no arm does: scatter, and displacements of single views, beyond which poses and scans contradict each other."""

from stitch.integrity.amounts import off_by
from stitch.integrity.snooping import Misplaced, Snooping
from stitch.measurement.session import Session
from stitch.units import METRES

# No arm scatters by more.
_ROTATION, _TRANSLATION_M = 0.010, 0.005
# No effect of an arm is believed to displace a single view by more than half of that.
_VIEW_ROTATION, _VIEW_M = 0.005, 0.0025


def judged_by_size(session: Session, found: Snooping) -> Snooping:
    """Suspected views that are surely off by more than what effects of an arm are believed to do are misplaced."""

    def too_far(m: Misplaced) -> bool:
        rotation, distance = m.at_least
        return rotation > _VIEW_ROTATION or distance * METRES[session.length_unit] > _VIEW_M

    return found.settled(too_far)


def contradicts(session: Session, found: Snooping) -> bool:
    """True if the poses contradict the scans beyond what any arm does."""
    lost = len(found.not_belonging) > len(session.views) / 2
    return lost or beyond_any_arm(session, found.rotation, found.translation)


def doubtful(session: Session, found: Snooping) -> bool:
    """True if all poses together scatter by what no arm is believed to do to a single view."""
    return found.rotation > _VIEW_ROTATION or found.translation * METRES[session.length_unit] > _VIEW_M


def beyond_any_arm(session: Session, rotation: float, translation: float) -> bool:
    """True if a rotation (rad) or a translation (length_unit) is larger than what any arm does."""
    return rotation > _ROTATION or translation > _TRANSLATION_M / METRES[session.length_unit]


def stands_off(session: Session, found: Misplaced) -> str:
    """How far a suspected view stands off, in words."""
    amount = off_by(found.at_least, found.at_least, session.length_unit)
    return f"stands off by at least {amount}" if amount else "stands out, by how much its surface does not tell"


def contradicted_by(session: Session, found: Snooping) -> str:
    """By how much the poses contradict the scans, in words."""
    return f"{1e3 * found.rotation:.3g} mrad and {found.translation:.3g} {session.length_unit}"
