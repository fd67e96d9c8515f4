"""Numbers and their units stay on one line."""

import re

_SPACE = "\u00a0"
_UNIT = r"(?:[kµm]?m|[µm]?rad|N|kg|°C?|deg|ppm|h|min|m?s|[kM]B|[%σ])(?![\w%])"
_BETWEEN = re.compile(rf"(?<=\d) (?={_UNIT}|± \d)|(?<=\d ±) (?=\d)|(?<=\bN) (?=m\b)")


def unbroken(text: str) -> str:
    """The text with no-break spaces before units and about ±: a line of a page ends elsewhere."""
    return _BETWEEN.sub(_SPACE, text)
