"""A Rerun recording that is written when it is complete.

Rerun's own file sink writes from a thread of its own: on a full disk it reports nothing and waits without end.
"""

import os
import uuid
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from stitch.system.packages import arrow_alone
from viz.page_parts import unbroken

os.environ.setdefault("RERUN_ANALYTICS", "off")
arrow_alone()


def words(markdown: str) -> rr.TextDocument:
    """A text with numbers that stay with their units."""
    return rr.TextDocument(unbroken(markdown), media_type=rr.MediaType.MARKDOWN)


def id_of(session: str) -> str:
    """The same for all recordings of one session, so that a viewer takes them for one."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"stitch:{session}"))


class RecordingFile:
    """A recording in memory, and the file that it becomes."""

    def __init__(
        self, name: str, path: Path, recording: str | None = None, default: rrb.Blueprint | None = None
    ) -> None:
        self.stream = rr.RecordingStream(name, recording_id=recording)
        self._path = path
        self._memory = self.stream.memory_recording()
        if default is not None:
            self.stream.send_blueprint(default, make_active=False, make_default=True)

    def write(self) -> None:
        """Write what was recorded and end the recording.

        Raises:
            OSError: the disk is full, or the folder cannot be written.
        """
        self._path.write_bytes(self._memory.drain_as_bytes())
        self.stream.disconnect()
