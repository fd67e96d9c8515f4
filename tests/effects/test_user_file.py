"""Effects of one's own: what their file may say and do, and what they may return."""

import time

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


def test_an_error_in_an_effect_of_ones_own_is_one_line(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(USER.replace("    return ", "    raise KeyError('dust')\n    return "))
    try:
        (name,) = load(file)
        with pytest.raises(InputError, match=rf"mine.py line \d+: effect {name}: KeyError: 'dust'") as error:
            EFFECTS[name].function(np.zeros((2, 3)), None, 0.1)
    finally:
        del EFFECTS["humidity_bias"]
    assert "\n" not in str(error.value)


FILE = """
import sys
import numpy as np
from stitch.effects import effect, number

@effect("{place}", k=number("mm", typical={typical}, limit={limit}))
def of_my_own(points, view, k):
    "x"
    {body}
"""


@pytest.fixture
def effect(tmp_path):
    def make(body="return points", place="sensor", typical="0.02", limit="1.0"):
        file = tmp_path / "mine.py"
        file.write_text(FILE.format(body=body, place=place, typical=typical, limit=limit))
        load(file)
        return EFFECTS["of_my_own"].function

    yield make
    EFFECTS.pop("of_my_own", None)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("return None", "returns None; to fix: return real numbers of shape"),
        ("return points[:-1]", "an array of shape (1, 3)"),
        ("return points * 1j", "complex numbers"),
        ("return points.astype(object)", "objects"),
        ("return points / 0.0", "NaN or infinity in 6 of 6"),
        ("return 'x'", "returns a str"),
        ("sys.exit(0)", "line 9: effect of_my_own: ends the program"),
        ("points += k", "read-only"),
        ("raise BaseException('b')", "BaseException: b"),
    ],
)
def test_an_effect_of_ones_own_that_returns_no_points_is_refused_in_one_line(effect, body, expected):
    with pytest.raises(InputError) as error, np.errstate(all="ignore"):
        effect(body)(np.ones((2, 3)), None, k=0.1)
    assert expected in str(error.value) and "mine.py" in str(error.value) and "\n" not in str(error.value)


def test_points_that_are_not_known_need_not_be_known_after_an_effect(effect):
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_array_equal(effect("return points + k")(points, None, k=1.0), points + 1)


@pytest.mark.parametrize("size", ["0", "-1", "float('nan')", "'x'", "None", "1j", "True"])
@pytest.mark.parametrize("key", ["typical", "limit"])
def test_sizes_must_be_positive_numbers(effect, key, size):
    before = dict(EFFECTS)
    with pytest.raises(InputError, match=f"{key} of k is .*; to fix: write a positive number"):
        effect(**{key: size})
    assert before == EFFECTS, "a file that is refused leaves no effect behind"


def test_an_effect_that_never_ends_is_interrupted(effect, monkeypatch):
    monkeypatch.setenv("STITCH_EFFECT_SECONDS", "0.5")
    function, began = effect("while True: pass"), time.monotonic()
    with pytest.raises(InputError, match="does not end within 0.5 s"):
        function(np.ones((2, 3)), None, k=0.1)
    assert time.monotonic() - began < 10


def test_patience_with_an_effect_is_a_number_of_seconds(effect, monkeypatch):
    monkeypatch.setenv("STITCH_EFFECT_SECONDS", "soon")
    with pytest.raises(InputError, match="STITCH_EFFECT_SECONDS is 'soon'"):
        effect()
