"""Why a file is missing, what may not be read, and names that may stand in tables and name folders."""

import errno
import json
from pathlib import Path

import pytest

from stitch.errors import InputError
from stitch.model.model_toml import read_model
from stitch.output.stored_run import read_ledger, read_result
from stitch.session.reading.session_folder import load_session
from stitch.session.reading.text_files import read_text, require_folder_name, require_name


@pytest.fixture
def run(tmp_path):
    """The documents of a run, as far as they say what the folder is."""
    folder = tmp_path / "r"
    folder.mkdir()
    (folder / "model.toml").write_text('format = "stitch-model/1"\n')
    (folder / "result.json").write_text(json.dumps({"format": "stitch-run/1", "session": "/data/blade-17"}))
    (folder / "ledger.json").write_text("[]")
    return folder


def test_a_run_is_no_session(run):
    with pytest.raises(InputError, match=r"r: is a run of /data/blade-17, not a session; to fix: name the session$"):
        load_session(run)


def test_the_runs_of_a_rig_are_no_session(run):
    for name in ("a", "b"):
        (run / name).mkdir()
        (run / name / "result.json").write_text(json.dumps({"format": "stitch-run/1", "session": f"/data/{name}"}))
    (run / "result.json").unlink()
    with pytest.raises(InputError, match="is a run of /data/a, /data/b, not a session"):
        load_session(run)


def test_scans_beside_another_result_are_still_to_be_made_a_session(tmp_path):
    (tmp_path / "result.json").write_text('{"ok": true}')
    with pytest.raises(InputError, match="session.toml: not found; .* `stitch init"):
        load_session(tmp_path)


def test_no_folder_says_what_to_name(tmp_path):
    with pytest.raises(InputError, match=r"to fix: name a folder that exists, .*nosuch does not$"):
        load_session(tmp_path / "nosuch")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"to fix: name a folder, .*file is a file$"):
        load_session(tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "read"), [("model.toml", read_model), ("result.json", read_result), ("ledger.json", read_ledger)]
)
def test_a_run_that_has_lost_a_file_is_damaged(run, name, read):
    (run / name).unlink()
    with pytest.raises(InputError, match=f"r: damaged, its {name} is missing; to fix: `stitch run`"):
        read(run)


def test_a_folder_that_is_no_run_is_not_called_damaged(tmp_path):
    with pytest.raises(InputError, match="model.toml: not found; name a run folder"):
        read_model(tmp_path)


def test_what_may_not_be_read_says_so(session, monkeypatch):
    """Rights do not bind the user who tests this everywhere; the refusal of the system is acted."""
    opened = Path.open

    def refused(self, *arguments, **more):
        if self.name in ("v001.ply", "locked.toml"):
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return opened(self, *arguments, **more)

    (session / "locked.toml").write_text("")
    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=r"view v001 .*v001.ply: may not be read; to fix: change its rights"):
        load_session(session)
    with pytest.raises(InputError, match=r"locked.toml: may not be read; to fix: change its rights"):
        read_text(session / "locked.toml", "write it")


@pytest.mark.parametrize("name", ["..", ".", "../x", "/abs", "a/b", "a\\b", "", " ", ".hidden", " a", "µ" * 150])
def test_names_that_cannot_name_a_folder_are_refused(name):
    with pytest.raises(InputError, match=r"session.toml: name .*; to fix: "):
        require_folder_name("session.toml", name, "name")


@pytest.mark.parametrize("name", ["a\0b", "a\nb", "\x1b[31m", "x" * 201])
def test_names_that_nobody_can_print_are_refused(name):
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
