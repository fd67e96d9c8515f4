"""A finite number in a cell of a table, or one line that says where it is not."""

from pathlib import Path

import numpy as np

from stitch.errors import InputError


def number(file: Path, line: int, column: str, cell: str, mend: str = "write a finite number") -> float:
    """A finite number.

    Raises:
        InputError: names file, line, column and the mend.
    """
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{file} line {line}: {column} is {cell.strip()!r}; {mend}")
    return value
