"""Tables as spreadsheets save them: what is wrong is said, with the line and the mend."""

import pytest

from data_synth.fixtures.edits import edit
from stitch.errors import InputError
from stitch.session.reading.session_folder import load_session


def refusal(session):
    with pytest.raises(InputError) as error:
        load_session(session)
    return str(error.value)


def test_semicolons_are_named(session):
    file = session / "views.csv"
    file.write_text(file.read_text().replace(",", ";"))
    told = refusal(session)
    assert "views.csv line 1: is separated by semicolons; to fix: save it with commas" in told
    assert f"stitch init {session} --poses {file} -o" in told and "decimal" not in told


def test_decimal_commas_are_named_with_the_semicolons(session):
    file = session / "views.csv"
    file.write_text(file.read_text().replace(",", ";").replace(".ply", "#").replace(".", ",").replace("#", ".ply"))
    assert "semicolons, with decimal commas; to fix: save it with commas between the cells and decimal points" in (
        refusal(session)
    )


def test_tabs_are_named(session):
    file = session / "views.csv"
    file.write_text(file.read_text().replace(",", "\t"))
    assert "line 1: is separated by tabs" in refusal(session)


def test_semicolons_in_the_cells_of_a_table_with_commas_are_left_alone(session):
    rows = (session / "views.csv").read_text().splitlines()
    more = ["note;n", *["a;b"] * (len(rows) - 1)]
    told = "\n".join(f"{row},{cell}" for row, cell in zip(rows, more, strict=True)) + "\n"
    (session / "views.csv").write_bytes(b"\xef\xbb\xbf" + told.encode())
    assert len(load_session(session).views) == len(rows) - 1


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_the_line_of_the_first_byte_that_is_no_utf8(session, mark):
    file = session / "views.csv"
    file.write_bytes(mark + file.read_text().replace("v001", "Fl\u00fcgel", 1).encode("latin-1"))
    assert "views.csv line 3: not UTF-8 text, byte 0xfc is" in (told := refusal(session))
    assert told.endswith("to fix: save it as CSV UTF-8")


def test_utf16_is_named(session):
    file = session / "views.csv"
    file.write_bytes(file.read_text().encode("utf-16"))
    assert refusal(session).endswith("views.csv line 1: is UTF-16 text, not UTF-8; to fix: save it as CSV UTF-8")


def test_the_description_says_its_line_too(session):
    edit(session / "session.toml", "length_unit", "# F\u00fcgung\nlength_unit")
    told = (session / "session.toml").read_text(encoding="utf-8")
    (session / "session.toml").write_bytes(told.encode("latin-1"))
    line = told.splitlines().index("# F\u00fcgung") + 1
    assert f"session.toml line {line}: not UTF-8 text" in refusal(session)
