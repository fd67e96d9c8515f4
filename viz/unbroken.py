"""Numbers and their units stay on one line."""

import re

_SPACE = "\u00a0"
_UNIT = r"(?:[kµm]?m|[µm]?rad|N|kg|°C?|deg|ppm|h|min|m?s|[kM]B|[%σ])(?![\w%])"
_VALUE = r"[−\-]?\d"
_BETWEEN = re.compile(
    rf"(?<=\d) (?={_UNIT}|± \d)|(?<=\d ±) (?=\d)|(?<=\bN) (?=m\b)|(?<=\w) (?== {_VALUE})|(?<=\w =) (?={_VALUE})"
)


def unbroken(text: str) -> str:
    """The text with no-break spaces before units, about ± and =: a line of a page ends elsewhere."""
    return _BETWEEN.sub(_SPACE, text)
