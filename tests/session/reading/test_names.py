"""Names that may stand in tables and name folders."""

import pytest

from stitch.errors import InputError
from stitch.session.reading.session_folder import load_session
from stitch.session.reading.text_files import require_folder_name, require_name


@pytest.mark.parametrize("name", ["..", ".", "../x", "/abs", "a/b", "a\\b", "", " ", ".hidden", " a", "µ" * 150])
def test_names_that_are_no_folder(name):
    with pytest.raises(InputError, match=r"session.toml: name .*; to fix: "):
        require_folder_name("session.toml", name, "name")


@pytest.mark.parametrize("name", ["a\0b", "a\nb", "\x1b[31m", "x" * 201])
def test_names_that_nobody_can_print(name):
    with pytest.raises(InputError) as error:
        require_name("views.csv line 3", name, "view")
    assert str(error.value).isprintable() and len(str(error.value)) < 250


@pytest.mark.parametrize(
    "name", ["blade-17", "Größe µ", "[red]x[red]", ":smile:", "O'Brien & Söhne", "a..b", "x" * 200]
)
def test_odd_names_stay_as_they_are(name):
    assert require_folder_name("session.toml", name, "name") == name


def test_a_session_without_a_name_has_that_of_its_folder(session, monkeypatch):
    file = session / "session.toml"
    file.write_text(file.read_text().replace('name = "s"\n', ""))
    monkeypatch.chdir(session)
    assert load_session(".").name == session.name
