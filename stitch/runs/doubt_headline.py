"""A doubt of a session as a whole in one clause: what it means and what to do stands elsewhere."""

import re

_CLAUSE_END = re.compile(r"[:.] ")


def doubt_headline(doubt: str) -> str:
    """A doubt up to its first colon or full stop outside brackets."""
    ends = (found.start() for found in _CLAUSE_END.finditer(doubt) if _brackets_closed(doubt[: found.start()]))
    return f"{doubt[: next(ends, len(doubt.rstrip('.')))]}."


def _brackets_closed(text: str) -> bool:
    return text.count("(") == text.count(")")
