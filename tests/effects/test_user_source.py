"""Effects that a script or a notebook defines: a run with one is saved with its source, and read again."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import stitch
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.session import public_session
from stitch.effects import EFFECTS, effect, twist, user_file
from stitch.effects.user_source import FILE, source_of
from stitch.errors import InputError
from stitch.output.run_folder import lock_run_folder

_RATE = 1e-3
_WEIGHTS = np.array([1.0, 0.5])


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
    assert EFFECTS["of_a_script"].origin == str(saved / FILE)
    assert (again.T_mount == ran.T_mount).all() and again.terms[0].values == pytest.approx(ran.terms[0].values)
    views = again.measurement.views
    np.testing.assert_allclose(
        again.terms[0].effect.function(views, xi=np.ones(6)), own.function(views, xi=np.ones(6)), rtol=1e-15
    )
    # Saved in its own place, where the file that it was read from goes, and elsewhere.
    with lock_run_folder(saved):
        again.save(saved, recording=False)
    elsewhere = again.save(tmp_path / "copy", recording=False)
    assert (elsewhere / FILE).read_text() == (saved / FILE).read_text()
    assert stitch.load_run(elsewhere, trust=True).effects == ["of_a_script"]


def test_a_run_without_such_an_effect_has_no_file_beside_it(ran, tmp_path):
    saved = stitch.drop(ran, "of_a_script").save(tmp_path / "run", recording=False)
    assert not (saved / FILE).exists() and "effects_file" not in (saved / "model.toml").read_text()


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
