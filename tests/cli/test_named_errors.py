"""What cannot be written is named as it was asked for, not as the hidden file that is made for it."""

import os
from pathlib import Path

import pytest

from stitch.cli.main import main
from stitch.system.files import rewrite_folder, whole_file


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="nobody may make a folder in /proc")
def test_the_folder_that_was_asked_for_is_named(session, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", "/proc/xx"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.strip().startswith("stitch: /proc/xx: No such file or directory; to fix: name")


def test_the_file_that_was_asked_for_is_named(tmp_path):
    asked = tmp_path / "nowhere" / "diagnosis.json"
    with pytest.raises(OSError) as error, whole_file(asked) as scratch:
        scratch.write_text("")
    assert error.value.filename == str(asked)


def test_an_error_at_another_file_keeps_its_name(tmp_path):
    other = tmp_path / "nowhere" / "other"
    with pytest.raises(OSError) as error, whole_file(tmp_path / "a") as scratch:
        scratch.write_text("")
        other.write_text("")
    assert error.value.filename == str(other)


def test_a_scratch_folder_that_cannot_be_made_names_the_folder(tmp_path, monkeypatch):
    def refused(path, *arguments):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    monkeypatch.setattr("tempfile._os.mkdir", refused)
    with pytest.raises(PermissionError) as error, rewrite_folder(Path("run"), lambda inside: True):
        pass
    assert error.value.filename == "run"
