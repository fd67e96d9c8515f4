"""`stitch doctor` names each package that is there or missing, what is not without it, and the command that brings it."""

import json
from zipfile import ZipFile

import pytest

import stitch
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.plugins import doctor
from stitch.system.packages import PACKAGES, command_for
from tests.command_line import ended


@pytest.fixture
def without_laspy(monkeypatch):
    """An installation in which laspy is missing and the rest is there."""
    monkeypatch.setattr(doctor, "installed", lambda name: None if name == "laspy" else "1.0")


def test_json_lists_all_packages(without_laspy):
    packages = json.loads(ended("doctor", "--json").out)["packages"]
    assert [row["name"] for row in packages] == list(PACKAGES)
    assert {tuple(row) for row in packages} == {("name", "version", "for", "command")}
    (missing,) = [row for row in packages if row["version"] is None]
    assert missing == {
        "name": "laspy",
        "version": None,
        "for": "clouds as LAS and LAZ",
        "command": command_for("formats"),
    }


def test_people_see_what_is_missing_and_what_to_type(without_laspy):
    text = ended("doctor").out
    assert f"{len(PACKAGES) - 1} of {len(PACKAGES)} packages are there" in text
    (row,) = [line for line in text.splitlines() if line.split()[:1] == ["laspy"]]
    assert "clouds as LAS and LAZ" in row and command_for("formats") in row


def test_a_full_open3d_counts_as_one_of_ours(monkeypatch):
    def version(name):
        if name == "open3d":
            return "0.19.0+cuda"
        raise doctor.PackageNotFoundError(name)

    monkeypatch.setattr(doctor, "version", version)
    assert doctor.installed("open3d") == "0.19.0+cuda" and doctor.installed("scipy") is None


def test_a_run_says_which_versions_were_others(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "stitch.output.stored_run.read_result", lambda run: {"versions": {"stitch": "0.0.9", "numpy": "1.0"}}
    )
    monkeypatch.setattr(doctor, "installed", lambda name: "1.0")
    assert doctor.other_versions(tmp_path) == [{"name": "stitch", "run": "0.0.9", "here": "1.0"}]
    assert f"{tmp_path}: computed with stitch 0.0.9; here is 1.0" in " ".join(ended("doctor", tmp_path).out.split())


def test_a_folder_without_a_run_is_refused(tmp_path):
    told = ended("doctor", tmp_path, code=2)
    assert "name a run folder that `stitch run` wrote" in told.err


def test_a_bundle_holds_the_numbers_of_a_run_and_no_clouds(tmp_path):
    session = write_labelled(tmp_path / "s", labelled_cell(2, views=8)[0], "points")
    run = stitch.run(stitch.load_session(session)).save(tmp_path / "run", recording=False)
    ended("doctor", run, "-o", tmp_path / "bundle.zip")
    names = set(ZipFile(tmp_path / "bundle.zip").namelist())
    assert {"doctor.json", "run/model.toml", "run/result.json", "run/ledger.json", "session/session.toml"} <= names
    assert not any(name.endswith((".ply", ".parquet", ".html", ".rrd", "points.csv")) for name in names)
    ended("doctor", run, "-o", tmp_path / "bundle.zip", code=2)


def test_what_a_small_install_needs_is_json_where_that_is_asked_for():
    lines = ended("doctor", "--requirements", "small").out.split()
    assert json.loads(ended("doctor", "--requirements", "small", "--json").out) == {"requirements": lines}
