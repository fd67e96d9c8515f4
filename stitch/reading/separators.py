"""A table whose cells are apart by something else than commas, as spreadsheets of many countries write it."""

import re
import shlex
from pathlib import Path

from stitch.errors import InputError

_OTHERS = {";": "semicolons", "\t": "tabs"}


def require_commas(file: Path, header: str) -> None:
    """Refuse a table whose first line holds semicolons or tabs and no comma.

    Raises:
        InputError: names what it is separated by, and how to fix it.
    """
    separator = next((s for s in _OTHERS if s in header.strip()), None)
    if separator is None or "," in header:
        return
    cell = rf"(?:^|[{separator}\n])\s*[+-]?\d+,\d+\s*(?=$|[{separator}\r\n])"
    decimal = re.search(cell, file.read_text(encoding="utf-8", errors="replace")) is not None
    mend = f"save it with commas between the cells{' and decimal points' * decimal}"
    if file.name == "views.csv":
        folder = shlex.quote(str(file.parent))
        mend += (
            f", or let `stitch init {folder} --poses {shlex.quote(str(file))} -o OTHER` make a session of it as it is"
        )
    raise InputError(
        f"{file} line 1: is separated by {_OTHERS[separator]}{', with decimal commas' * decimal}; to fix: {mend}"
    )
