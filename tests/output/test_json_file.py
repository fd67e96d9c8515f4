"""Where a run may go, and what of the folder there is its own."""

import json
from pathlib import Path

import pytest

from stitch.errors import InputError
from stitch.output.json_file import is_run_file, require_free, sessions_in


@pytest.fixture
def place(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "session.toml").touch()
    return tmp_path


def make_run(folder, session):
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps({"format": "stitch-run/1", "session": str(session)}))
    (folder / "model.toml").touch()
    return folder


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("s", "lies in the session"),
        ("s/runs/a", "lies in the session"),
        ("link", "lies in the session"),
        (".", "the session .* lies in it|one stands in"),
        ("own", "not a run folder"),
        ("other", "holds the run of .*force=True"),
        ("model", "not a run folder"),
        ("damaged", "not a run folder"),
    ],
)
def test_a_place_where_something_would_be_lost_is_refused(place, target, expected):
    (place / "link").symlink_to(place / "s")
    for name in ("own", "model", "damaged"):
        (place / name).mkdir()
    (place / "own" / "thesis.txt").touch()
    (place / "model" / "model.toml").touch()
    (place / "damaged" / "model.toml").touch()
    (place / "damaged" / "result.json").write_text("[" * 100_000)
    make_run(place / "other", place / "t")
    with pytest.raises(InputError, match=expected):
        require_free(place / target, [place / "s"], force=False)


def test_a_run_may_go_where_nothing_would_be_lost(place):
    (place / "empty").mkdir()
    make_run(place / "same", place / "s")
    make_run(place / "other", place / "t")
    for target in ("new", "empty", "same"):
        require_free(place / target, [place / "s"], force=False)
    require_free(place / "other", [place / "s"], force=True)


def test_of_a_rig_the_runs_inside_are_its_own(place):
    """The folder of one run may hold another run of the person's: that is none of its own."""
    rig, single = place / "rig", make_run(place / "single", place / "s")
    make_run(rig / "a", place / "a")
    make_run(rig / "b", place / "b")
    (rig / "model.toml").touch()
    make_run(single / "a", place / "a")
    assert sessions_in(rig) == [str(place / "a"), str(place / "b")]
    assert is_run_file(rig)(Path("a/result.json")) and not is_run_file(rig)(Path("a/notes.txt"))
    assert not is_run_file(single)(Path("a/result.json"))
    is_own = {
        name: is_run_file(single)(Path(name)) for name in ("result.json", "pictures/budget.png", "pictures/mine.png")
    }
    assert is_own == {"result.json": True, "pictures/budget.png": True, "pictures/mine.png": False}
