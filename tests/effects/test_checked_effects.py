"""What an effect of one's own may return, and what its file may say and do."""

import time

import numpy as np
import pytest

from stitch.effects import EFFECTS
from stitch.effects.user_file import load
from stitch.errors import InputError

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
def test_what_it_must_not_do(effect, body, expected):
    with pytest.raises(InputError) as error, np.errstate(all="ignore"):
        effect(body)(np.ones((2, 3)), None, k=0.1)
    assert expected in str(error.value) and "mine.py" in str(error.value) and "\n" not in str(error.value)


def test_what_is_not_known_before_need_not_be_known_after(effect):
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_array_equal(effect("return points + k")(points, None, k=1.0), points + 1)


@pytest.mark.parametrize("size", ["0", "-1", "float('nan')", "'x'", "None", "1j", "True"])
@pytest.mark.parametrize("key", ["typical", "limit"])
def test_sizes_must_be_positive_numbers(effect, key, size):
    before = dict(EFFECTS)
    with pytest.raises(InputError, match=f"{key} of k is .*; to fix: write a positive number"):
        effect(**{key: size})
    assert before == EFFECTS, "a file that is refused leaves no effect behind"


def test_one_that_never_ends_is_interrupted(effect, monkeypatch):
    monkeypatch.setenv("STITCH_EFFECT_SECONDS", "0.5")
    function, began = effect("while True: pass"), time.monotonic()
    with pytest.raises(InputError, match="does not end within 0.5 s"):
        function(np.ones((2, 3)), None, k=0.1)
    assert time.monotonic() - began < 10


def test_of_two_lengths_of_patience_only_a_number_counts(effect, monkeypatch):
    monkeypatch.setenv("STITCH_EFFECT_SECONDS", "soon")
    with pytest.raises(InputError, match="STITCH_EFFECT_SECONDS is 'soon'"):
        effect()
