"""`stitch check --deep`: its JSON stands on standard output whatever is wrong, one object a session."""

import json
import shutil

import pytest

from stitch.cli.main import main

KINDS = {
    "exchanged", "shifted", "reversed", "inverse", "mount", "euler", "degrees", "quaternion", "unit", "scale",
    "mirrored", "joint_row", "duplicate_scan", "duplicate_pose", "displaced", "foreign", "reclamped", "disconnected",
}  # fmt: skip


@pytest.fixture
def in_metres(session, tmp_path):
    """The simulated cell with clouds whose unit is stated a thousand times too large."""
    folder = shutil.copytree(session, tmp_path / "metres")
    file = folder / "session.toml"
    file.write_text('cloud_unit = "m"\n' + file.read_text(encoding="utf-8"), encoding="utf-8")
    return folder


def deep(capsys, *folders):
    with pytest.raises(SystemExit) as end:
        main(["check", "--deep", *map(str, folders), "--json"])
    printed = capsys.readouterr()
    return end.value.code or 0, json.loads(printed.out), printed.err


def test_a_unit_that_cannot_be_is_a_problem_as_any_other(in_metres, capsys):
    code, told, _ = deep(capsys, in_metres)
    assert code == 2 and told["ok"] is False
    (problem,) = told["problems"]
    assert problem["kind"] == "unit" and problem["kind"] in KINDS and problem["views"] == []
    assert "cloud_unit" in problem["fix"] and "\n" not in problem["fix"]


def test_one_cloud_in_another_unit_is_named(session, tmp_path, capsys):
    folder = shutil.copytree(session, tmp_path / "one")
    cloud = sorted((folder / "clouds").iterdir())[1]
    cloud.write_text("".join(f"{x} {y} 400000\n" for x in range(0, 90000, 3000) for y in range(0, 90000, 3000)))
    views = folder / "views.csv"
    cloud = cloud.rename(cloud.with_suffix(".xyz"))
    views.write_text(views.read_text(encoding="utf-8").replace(f"{cloud.stem}.ply", cloud.name), encoding="utf-8")
    code, told, _ = deep(capsys, folder)
    assert code == 2 and [(p["kind"], p["views"]) for p in told["problems"]] == [("unit", [cloud.stem])]


def test_a_session_that_cannot_be_read_hides_no_other(in_metres, tmp_path, capsys):
    code, told, err = deep(capsys, tmp_path / "nowhere", in_metres)
    assert code == 2 and [row["ok"] for row in told] == [False, False]
    assert told[0]["problems"] == [] and "not found" in told[0]["errors"][0] and "not found" in err
    assert told[1]["problems"][0]["kind"] == "unit"
