"""Two scanners in one cell, simulated by kinematics that share no code with the model."""

import json

import numpy as np
import pytest

import stitch
from data_synth.cells.scanner_cell import scanner_cell, write_scanners
from stitch.numerics import frames

CELL = scanner_cell("stands", 22, {"field_curvature": (1, 2.0)})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return stitch.run([stitch.load_session(path) for path in write_scanners(tmp_path_factory.mktemp("cell"), CELL)])


@pytest.fixture(scope="module")
def better(run):
    return stitch.add(run, "field_curvature@right")


def test_one_scanners_own_effect_is_named_for_that_one(run):
    assert stitch.diagnose(run).effects == ("field_curvature@right",)


def test_each_hand_eye_lies_within_three_sigma_and_is_known_better_than_alone(better):
    for place, true in zip(better.scanners, CELL.T_mount, strict=True):
        off = frames.log(frames.inverse(true) @ place.T_mount)
        assert (np.abs(off) < 3 * place.sigma).all()
        assert place.U_alone > place.U


def test_views_of_different_scanners_overlap(run):
    of_view = [view.scanner for view in run.session.views]
    across = [m for m in run.overlaps.matches if of_view[m.v] != of_view[m.w]]
    assert across


def test_a_saved_run_holds_a_folder_a_scanner_and_reads_back_the_same(better, tmp_path):
    folder = better.save(tmp_path / "run", recording=False)
    whole = json.loads((folder / "result.json").read_text())
    assert [row["scanner"] for row in whole["scanners"]] == ["left", "right"]
    for k, name in enumerate(("left", "right")):
        own = json.loads((folder / f"cell-{name}" / "result.json").read_text())
        assert own["scanner"] == name
        assert [row["view"] for row in own["views"]] == [f"v{v:03d}" for v in range(10)]
        assert np.array_equal(own["hand_eye"], better.scanners[k].T_mount)
        model = stitch.read_model(folder / f"cell-{name}")
        assert list(model.effects) == ["field_curvature"] * k
    again = stitch.load_run(folder)
    assert np.allclose(again.scanners[1].covariance, better.scanners[1].covariance)
    assert again.scanners[1].U_alone == pytest.approx(better.scanners[1].U_alone)
