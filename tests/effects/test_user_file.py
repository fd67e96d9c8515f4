"""Effects that a user writes: taken up, or refused in one line."""

import numpy as np
import pytest

from stitch.effects import EFFECTS
from stitch.effects.user_file import load
from stitch.errors import InputError

USER = '''
from stitch.effects import effect, number

@effect("sensor", needs=["humidity_percent"], k=number("mm", typical=0.02, limit=1.0))
def humidity_bias(points, view, k):
    """x = x* + u·k·(humidity − first humidity)"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
'''


def test_a_users_effect_takes_its_place(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(USER)
    try:
        assert load(file) == ["humidity_bias"]
        assert EFFECTS["humidity_bias"].tier == "user"
        assert EFFECTS["humidity_bias"].formula.startswith("x = x*")
        assert load(file) == ["humidity_bias"]  # a second time is no conflict with itself
    finally:
        EFFECTS.pop("humidity_bias", None)


def test_a_file_counts_as_it_stands_and_nothing_is_written_beside_it(tmp_path):
    """Python's cache takes a file of the same second and length for the one before."""
    file = tmp_path / "mine.py"
    try:
        for size in (0.02, 0.03):
            file.write_text(USER.replace("0.02", str(size)))
            load(file)
            assert EFFECTS["humidity_bias"].specs["k"].typical == size
    finally:
        EFFECTS.pop("humidity_bias", None)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x = 1 +\n", "line 1"),
        ("from stitch.effects import effect, number\nraise ValueError('no')\n", "line 2"),
        ("x = 1\n", "no effect in it"),
        (USER.replace("humidity_bias", "range_scale"), "in the library already"),
        (USER.replace('"sensor"', '"elbow"'), "places are"),
    ],
)
def test_a_bad_effects_file_is_one_line(tmp_path, text, expected):
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(InputError, match=expected) as error:
        load(file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)


def test_what_goes_wrong_in_an_effect_of_ones_own_is_one_line(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(USER.replace("    return ", "    raise KeyError('dust')\n    return "))
    try:
        (name,) = load(file)
        with pytest.raises(InputError, match=rf"mine.py line \d+: effect {name}: KeyError: 'dust'") as error:
            EFFECTS[name].function(np.zeros((2, 3)), None, 0.1)
    finally:
        del EFFECTS["humidity_bias"]
    assert "\n" not in str(error.value)
