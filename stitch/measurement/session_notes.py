"""What is said of a session before anything is fitted: how a stated payload counts, and what does not count."""

from stitch.measurement.gaps import gaps_note
from stitch.measurement.session import Session
from stitch.measurement.torques import payload_note


def session_notes(session: Session) -> list[str]:
    """A sentence each; `check` and `run` say the same."""
    return [note for note in (payload_note(session), gaps_note(session)) if note]
