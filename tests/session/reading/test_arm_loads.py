"""Torques are known of every joint in every view, or of none."""

from pathlib import Path

import pytest

from stitch.errors import InputError
from stitch.session.reading.views_table import require_loads

BOTH = ["j1_torque_nm", "j2_torque_nm"]


@pytest.mark.parametrize(
    ("header", "rows", "told"),
    [
        (BOTH, [["5", "-6"], ["7", "8"]], None),
        (BOTH, [["", ""], ["", ""]], None),
        (BOTH[:1], [["5"], ["6"]], "line 1: torques of j1_torque_nm, but the table has 2 joints"),
        ([*BOTH, "j3_torque_nm"], [["5", "6", "7"]], "line 1: torques of .*j3_torque_nm, but the table has 2 joints"),
        (BOTH, [["5", "6"], ["7", ""]], "line 3: j2_torque_nm is ''; write a number in every row"),
        (BOTH, [["5", "6e9"]], "line 2: j2_torque_nm is 6e.09, as on no arm; to fix: correct its unit"),
    ],
)
def test_torques_are_whole_or_refused(header, rows, told):
    cells = [(line, dict(zip(header, row, strict=True))) for line, row in enumerate(rows, 2)]
    if told is None:
        return require_loads(Path("views.csv"), header, cells, joints=2)
    with pytest.raises(InputError, match=told):
        require_loads(Path("views.csv"), header, cells, joints=2)
