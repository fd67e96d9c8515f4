"""`stitch effects`: the library as JSON, and files of effects that cannot be loaded."""

import json

import pytest

from stitch.cli.main import main
from stitch.effects import EFFECTS


def test_effects_as_json(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["effects", "part_slip", "--json"])
    assert not ended.value.code
    (told,) = json.loads(capsys.readouterr().out)
    assert told["effect"] == "part_slip" and [p["unit"] for p in told["parameters"]] == ["rad", "view"]


USER = """
from stitch.effects import effect, number

@effect("sensor", k=number("mm", typical=0.02, limit=1.0))
def of_my_own(points, view, k):
    return points
"""


@pytest.mark.parametrize(("name", "expected"), [("mine.txt", "mine.py"), ("mine.py", "'of_my_own' has no docstring")])
def test_effects_that_cannot_be_loaded_are_refused(tmp_path, capsys, name, expected):
    (tmp_path / name).write_text(USER)
    with pytest.raises(SystemExit) as ended:
        main(["effects", "--effects-file", str(tmp_path / name)])
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"stitch: {tmp_path / name}: ") and expected in printed and printed.count("\n") == 1
    assert "of_my_own" not in EFFECTS
