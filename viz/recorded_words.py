"""Text beside the pictures of a recording."""

import os

from viz.unbroken import unbroken

os.environ.setdefault("RERUN_ANALYTICS", "off")
import rerun as rr


def words(markdown: str) -> rr.TextDocument:
    """A text with numbers that stay with their units."""
    return rr.TextDocument(unbroken(markdown), media_type=rr.MediaType.MARKDOWN)
