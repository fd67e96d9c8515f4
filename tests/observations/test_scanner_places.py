"""Two scanners in one cell, simulated by kinematics that share no code with the model."""

import json

import numpy as np
import pytest

import stitch
from data_synth.cells.scanner_cell import scanner_cell, write_scanners
from stitch.numerics import frames
from tests.command_line import ended


@pytest.fixture(scope="module")
def cell():
    return scanner_cell("stands", 22, {"field_curvature": (1, 2.0)}, views=8, rays=60)


@pytest.fixture(scope="module")
def run(cell, tmp_path_factory):
    return stitch.run([stitch.load_session(path) for path in write_scanners(tmp_path_factory.mktemp("cell"), cell)])


@pytest.fixture(scope="module")
def better(run):
    return stitch.add(run, "field_curvature@right")


@pytest.fixture(scope="module")
def folder(better, tmp_path_factory):
    return better.save(tmp_path_factory.mktemp("saved") / "run", recording=False)


def test_one_scanners_own_effect_is_named_for_that_one(run):
    assert stitch.diagnose(run).effects == ("field_curvature@right",)


def test_each_hand_eye_lies_within_three_sigma_and_is_known_better_than_alone(cell, better):
    for place, true in zip(better.scanners, cell.T_mount, strict=True):
        off = frames.log(frames.inverse(true) @ place.T_mount)
        assert (np.abs(off) < 3 * place.sigma).all()
        assert place.U_alone > place.U


def test_views_of_different_scanners_overlap(run):
    of_view = [view.scanner for view in run.session.views]
    across = [m for m in run.overlaps.matches if of_view[m.v] != of_view[m.w]]
    assert across


def test_a_saved_run_holds_a_folder_a_scanner_and_reads_back_the_same(better, folder):
    whole = json.loads((folder / "result.json").read_text())
    assert [row["scanner"] for row in whole["scanners"]] == ["left", "right"]
    for k, name in enumerate(("left", "right")):
        own = json.loads((folder / f"cell-{name}" / "result.json").read_text())
        assert own["scanner"] == name
        assert [row["view"] for row in own["views"]] == [f"v{v:03d}" for v in range(8)]
        assert np.array_equal(own["hand_eye"], better.scanners[k].T_mount)
        model = stitch.read_model(folder / f"cell-{name}")
        assert list(model.effects) == ["field_curvature"] * k
    again = stitch.load_run(folder)
    assert np.allclose(again.scanners[1].covariance, better.scanners[1].covariance)
    assert again.scanners[1].U_alone == pytest.approx(better.scanners[1].U_alone)


def test_a_saved_run_gives_the_hand_eye_of_the_scanner_that_is_named_and_asks_where_none_is(better, folder, tmp_path):
    for stated in ([], ["--scanner", "top"]):
        assert "--scanner left or right" in ended("export", folder, "--to", "opencv", *stated, code=2).err
    for name in ("left", "right"):
        ended("export", folder, "--to", "opencv", "--scanner", name, "-o", tmp_path / name)
        text = (tmp_path / name).read_text()
        assert text == stitch.export_run(better, "opencv", scanner=name)
        T = text.split("data: [")[1].split("]")[0]
        place = next(place for place in better.scanners if place.name == name)
        assert np.allclose(np.fromstring(T, sep=",").reshape(4, 4), place.T_mount)


def test_the_folder_of_one_scanner_has_no_page_and_says_where_it_is(better, folder, tmp_path):
    assert f"to fix: name {folder}" in " ".join(ended("report", folder / "cell-left", code=2).err.split())
    given = ("--hand-eye", folder, "-o", tmp_path / "again")
    told = ended("run", better.session.parts[0].path, *given, code=2).err
    assert "--hand-eye RUN/SESSION" in " ".join(told.split())
