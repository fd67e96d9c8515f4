"""What bends an arm, in views.csv: payload_kg and j1_torque_nm …, known in every view or in none."""

import re
from collections.abc import Sequence
from pathlib import Path

from stitch.errors import InputError
from stitch.reading.csv_number import finite_number

_PAYLOAD = "payload_kg"
_TORQUE = re.compile(r"j([1-9]\d*)_torque_nm$")
# No arm carries a hundred tonnes, no drive exerts a million N·m.
_LARGEST_KG, _LARGEST_NM = 1e5, 1e6


def require_loads(file: Path, header: Sequence[str], cells: Sequence[tuple[int, dict[str, str]]], joints: int) -> None:
    """Refuse loads of some views or some joints alone: gravity would silently take their place.

    Args:
        cells: line number and cells by column of every row.
        joints: how many the table has.

    Raises:
        InputError: names the line or the columns, and how to fix it.
    """
    filled = [name for name in header if any(row[name] for _, row in cells)]
    torques = [name for name in filled if _TORQUE.match(name)]
    if torques and joints and sorted(torques) != sorted(f"j{i + 1}_torque_nm" for i in range(joints)):
        raise InputError(
            f"{file} line 1: torques of {', '.join(torques)}, but the table has {joints} joints; to fix: write one "
            "column a joint, or take them out"
        )
    for name in [*torques, *(name for name in filled if name == _PAYLOAD)]:
        for line, row in cells:
            value = finite_number(file, line, name, row[name], "write a number in every row, or take the column out")
            if name == _PAYLOAD and value < 0:
                raise InputError(f"{file} line {line}: {name} is {value:g}; to fix: write a mass, 0 for none")
            if abs(value) > (_LARGEST_KG if name == _PAYLOAD else _LARGEST_NM):
                raise InputError(f"{file} line {line}: {name} is {value:g}, as on no arm; to fix: correct its unit")
