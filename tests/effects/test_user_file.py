"""Effects of one's own: what their file may say and do, and what they may return.

Effects that a script or a notebook defines: a run with one is saved with its source, and read again.
"""

import time
from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import stitch
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.session import public_session
from stitch.effects import EFFECTS, effect, twist, user_file
from stitch.effects.user_file import load
from stitch.effects.user_source import EFFECTS_FILE, source_of
from stitch.errors import InputError
from stitch.output.run_folder import lock_run_folder

USER = '''
from stitch.effects import effect, number

@effect("sensor", needs=["humidity_percent"], k=number("mm", typical=0.02, limit=1.0))
def humidity_bias(points, view, k):
    """x = x* + u·k·(humidity − first humidity)"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
'''
_RATE = 1e-3
_WEIGHTS = np.array([1.0, 0.5])


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


TEMPLATE = """
import sys
import numpy as np
from stitch.effects import effect, number

@effect("{place}", k=number("mm", typical={typical}, limit={limit}))
def of_my_own(points, view, k):
    "x"
    {body}
"""


@pytest.fixture
def own_effect(tmp_path):
    def make(body="return points", place="sensor", typical="0.02", limit="1.0"):
        file = tmp_path / "mine.py"
        file.write_text(TEMPLATE.format(body=body, place=place, typical=typical, limit=limit))
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
def test_an_effect_of_ones_own_that_returns_no_points_is_refused_in_one_line(own_effect, body, expected):
    with pytest.raises(InputError) as error, np.errstate(all="ignore"):
        own_effect(body)(np.ones((2, 3)), None, k=0.1)
    assert expected in str(error.value) and "mine.py" in str(error.value) and "\n" not in str(error.value)


def test_points_that_are_not_known_need_not_be_known_after_an_effect(own_effect):
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_array_equal(own_effect("return points + k")(points, None, k=1.0), points + 1)


@pytest.mark.parametrize("size", ["0", "-1", "float('nan')", "'x'", "None", "1j", "True"])
@pytest.mark.parametrize("key", ["typical", "limit"])
def test_sizes_must_be_positive_numbers(own_effect, key, size):
    before = dict(EFFECTS)
    with pytest.raises(InputError, match=f"{key} of k is .*; to fix: write a positive number"):
        own_effect(**{key: size})
    assert before == EFFECTS, "a file that is refused leaves no effect behind"


def test_an_effect_that_never_ends_is_interrupted(own_effect, monkeypatch):
    monkeypatch.setenv("STITCH_EFFECT_SECONDS", "0.5")
    function, began = own_effect("while True: pass"), time.monotonic()
    with pytest.raises(InputError, match="does not end within 0.5 s"):
        function(np.ones((2, 3)), None, k=0.1)
    assert time.monotonic() - began < 10


def test_patience_with_an_effect_is_a_number_of_seconds(own_effect, monkeypatch):
    monkeypatch.setenv("STITCH_EFFECT_SECONDS", "soon")
    with pytest.raises(InputError, match="STITCH_EFFECT_SECONDS is 'soon'"):
        own_effect()


def _course(views):
    """What a script has beside its effect."""
    return _RATE * views.number * _WEIGHTS[0]


@pytest.fixture
def own():
    """An effect as a script defines it; it names a helper, a number, an array and a module of this one."""

    @effect("mount", xi=twist("", 3e-4, 0.1))
    def of_a_script(views, xi):
        """M·exp(ξ·view/1000)"""
        return np.outer(_course(views), xi)

    yield EFFECTS["of_a_script"]
    EFFECTS.pop("of_a_script", None)


@pytest.fixture
def ran(own):
    return stitch.run(public_session(labelled_cell(4, 14)[0]), effects=["of_a_script"])


def test_what_a_program_defines_is_a_users_and_not_the_librarys(own):
    assert own.tier == "user" and not own.origin


def test_a_run_with_an_effect_of_a_script_is_read_again(ran, own, tmp_path):
    saved = ran.save(tmp_path / "run", recording=False)
    del EFFECTS["of_a_script"]
    with pytest.raises(InputError, match="--trust"):
        stitch.load_run(saved)
    again = stitch.load_run(saved, trust=True)
    assert EFFECTS["of_a_script"].origin == str(saved / EFFECTS_FILE)
    assert (again.T_mount == ran.T_mount).all() and again.terms[0].values == pytest.approx(ran.terms[0].values)
    views = again.measurement.views
    np.testing.assert_allclose(
        again.terms[0].effect.function(views, xi=np.ones(6)), own.function(views, xi=np.ones(6)), rtol=1e-15
    )
    # Saved in its own place, where the file that it was read from goes, and elsewhere.
    with lock_run_folder(saved):
        again.save(saved, recording=False)
    elsewhere = again.save(tmp_path / "copy", recording=False)
    assert (elsewhere / EFFECTS_FILE).read_text() == (saved / EFFECTS_FILE).read_text()
    assert stitch.load_run(elsewhere, trust=True).effects == ["of_a_script"]


def test_a_run_without_such_an_effect_has_no_file_beside_it(ran, tmp_path):
    saved = stitch.drop(ran, "of_a_script").save(tmp_path / "run", recording=False)
    assert not (saved / EFFECTS_FILE).exists() and "effects_file" not in (saved / "model.toml").read_text()


@pytest.mark.parametrize(
    ("value", "said"),
    [(object(), "no file can hold"), (np.array([np.nan]), "no file can hold"), (lambda: 0, "no def and no assignment")],
)
def test_what_nobody_could_read_is_refused_before_anything_is_written(ran, tmp_path, monkeypatch, value, said):
    monkeypatch.setitem(globals(), "_RATE", value)
    with pytest.raises(InputError, match=said) as error:
        ran.save(tmp_path / "run", recording=False)
    assert "\n" not in str(error.value) and "to fix" in str(error.value)
    assert not list(tmp_path.iterdir())


def test_an_effect_without_source_is_refused():
    space = {"effect": effect, "twist": twist, "np": np}
    exec('@effect("mount", xi=twist("", 3e-4, 0.1))\ndef typed(views, xi):\n    "x"\n    return views', space)
    try:
        with pytest.raises(InputError, match="source of typed is not at hand"):
            source_of([EFFECTS["typed"]])
    finally:
        del EFFECTS["typed"]


def test_packages_offer_effects_and_a_broken_one_is_a_warning(monkeypatch, tmp_path):
    text = 'import numpy as np\nfrom stitch.effects import effect, twist\n\n@effect("mount", xi=twist("", 3e-4, 0.1))\n'
    (tmp_path / "lab_effects.py").write_text(text + 'def of_a_lab(views, xi):\n    "x"\n    return np.zeros((4, 6))\n')
    (tmp_path / "lab_broken.py").write_text("raise ValueError('no')\n")
    monkeypatch.syspath_prepend(tmp_path)
    entries = [EntryPoint(name, name, "stitch.effects") for name in ("lab_effects", "lab_broken")]
    monkeypatch.setattr(user_file, "entry_points", lambda group: entries)
    try:
        with pytest.warns(UserWarning, match="package lab_broken: its effects are left out: ValueError: no"):
            user_file.load_packages()
        of_a_lab = EFFECTS["of_a_lab"]
        assert of_a_lab.tier == "user" and of_a_lab.origin == "package lab_effects"
        (tmp_path / "mine.py").write_text(text + 'def mine(views, xi):\n    "x"\n    return np.zeros((4, 6))\n')
        user_file.load(tmp_path / "mine.py")
        assert {"of_a_lab", "mine"} <= EFFECTS.keys()  # a file takes the place of a file alone
        assert replace(of_a_lab) == EFFECTS["of_a_lab"]
    finally:
        EFFECTS.pop("of_a_lab", None)
        EFFECTS.pop("mine", None)
