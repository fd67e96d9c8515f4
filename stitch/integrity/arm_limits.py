"""What no arm does: scatter, and displacements of single views, beyond which poses and scans contradict each other."""

from stitch.integrity.amounts import displacement_text
from stitch.integrity.snooping import MisplacedView, Snooping
from stitch.measurement.session import Session
from stitch.units import METRES

# No arm scatters by more.
_ROTATION, _TRANSLATION_M = 0.010, 0.005
# No effect of an arm is believed to displace a single view by more than half of that.
_VIEW_ROTATION, _VIEW_M = 0.005, 0.0025


def apply_displacement_limits(session: Session, found: Snooping) -> Snooping:
    """Suspected views that are surely off by more than what effects of an arm are believed to do are misplaced."""

    def too_far(m: MisplacedView) -> bool:
        rotation, distance = m.at_least
        return rotation > _VIEW_ROTATION or distance * METRES[session.length_unit] > _VIEW_M

    return found.with_misplaced(too_far)


def poses_contradict_scans(session: Session, found: Snooping) -> bool:
    """True if the poses contradict the scans beyond what any arm does."""
    lost = len(found.not_belonging) > len(session.views) / 2
    return lost or beyond_any_arm(session, found.rotation, found.translation)


def scatter_is_doubtful(session: Session, found: Snooping) -> bool:
    """True if all poses together scatter by what no arm is believed to do to a single view."""
    return found.rotation > _VIEW_ROTATION or found.translation * METRES[session.length_unit] > _VIEW_M


def beyond_any_arm(session: Session, rotation: float, translation: float) -> bool:
    """True if a rotation (rad) or a translation (length_unit) is larger than what any arm does."""
    return rotation > _ROTATION or translation > _TRANSLATION_M / METRES[session.length_unit]


def displacement_in_words(session: Session, found: MisplacedView) -> str:
    """How far a suspected view stands off, in words."""
    amount = displacement_text(found.at_least, found.at_least, session.length_unit)
    return f"stands off by at least {amount}" if amount else "stands out, by how much its surface does not tell"


def contradiction_in_words(session: Session, found: Snooping) -> str:
    """By how much the poses contradict the scans, in words."""
    return f"{1e3 * found.rotation:.3g} mrad and {found.translation:.3g} {session.length_unit}"
