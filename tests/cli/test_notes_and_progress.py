"""What others may read of the work: remarks in the ledger, progress as lines, values of the views in compare.json."""

import json
import shutil

import numpy as np
import pytest

from stitch.cli.main import main
from stitch.errors import InputError

HUMIDITY = [40.0, 43.0, 46.0]


@pytest.fixture(scope="module")
def run_folder(_blade_on_disk, tmp_path_factory, stitch_command):
    """A run of three views, of which views.csv knows the humidity."""
    folder = tmp_path_factory.mktemp("notes")
    views = shutil.copytree(_blade_on_disk, folder / "s") / "views.csv"
    header, *rows = views.read_text().splitlines()
    rows = [f"{row},{h}" for row, h in zip(rows, HUMIDITY, strict=True)]
    views.write_text("\n".join([f"{header},humidity_percent", *rows]) + "\n")
    stitch_command("run", folder / "s", "-o", folder / "r", "--no-recording")
    return folder / "r"


def test_a_note_stays_in_the_ledger_when_the_model_changes(run_folder, stitch_command, monkeypatch, capsys):
    stitch_command("note", run_folder, "clamp was loose", "--by", "Q")
    stitch_command("note", run_folder, "  measured again ", "--step", "0")
    monkeypatch.setenv("STITCH_PROGRESS", "json")
    capsys.readouterr()
    stitch_command("add", run_folder, "range_scale", "--no-recording")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines() if line.startswith('{"progress"')]
    steps = json.loads((run_folder / "ledger.json").read_text())
    told = [(note["by"], note["text"]) for note in steps[0]["notes"]]
    assert told == [("Q", "clamp was loose"), ("", "measured again")]
    assert [step["effects"] for step in steps] == [[], ["range_scale"]]
    assert "notes" not in steps[1]
    fit = [line["iteration"] for line in lines if line["progress"] == "fit"]
    assert fit == list(range(1, len(fit) + 1)) != []
    assert lines[-1]["progress"] == "writing"
    assert lines[-1]["residual_um"] == pytest.approx(1e3 * steps[1]["residual_rms"])


@pytest.mark.parametrize("words", [["  "], ["x" * 2001], ["fine", "--step", "9"]], ids=["empty", "long", "no step"])
def test_a_note_that_cannot_be_kept_changes_nothing(run_folder, words, capsys):
    before = (run_folder / "ledger.json").read_bytes()
    with pytest.raises(SystemExit) as ended:
        main(["note", str(run_folder), *words])
    assert ended.value.code == InputError.exit_code
    assert capsys.readouterr().err.startswith("stitch: ")
    assert (run_folder / "ledger.json").read_bytes() == before


def test_compare_tells_where_every_view_stood(run_folder, stitch_command):
    told = json.loads(stitch_command("compare", run_folder, "--json"))
    names = [line.split(",")[0] for line in (run_folder.parent / "s" / "views.csv").read_text().splitlines()[1:]]
    assert [view["view"] for view in told["views"]] == names
    np.testing.assert_allclose([view["values"]["humidity_percent"] for view in told["views"]], HUMIDITY)
