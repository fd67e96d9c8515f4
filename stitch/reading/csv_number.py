"""Numbers in the cells of tables, or one line that says where there is none."""

from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.reading.text_file import shortened

# No quantity of a cell is larger in any unit; beyond, squares overflow.
_LARGEST = 1e30


def is_number(cell: str) -> bool:
    """True for what Python reads as a number, finite or not."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def finite_number(file: Path, line: int, column: str, cell: str, remedy: str = "write a finite number") -> float:
    """A finite number.

    Raises:
        InputError: names file, line and column, and how to fix it.
    """
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.abs(value) < _LARGEST:
        raise InputError(f"{file} line {line}: {column} is {shortened(cell.strip())}; {remedy}")
    return value
