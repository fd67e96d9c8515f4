"""A run read back from its folder; the Python file that its model names is run only where somebody allows it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import change, run
from stitch.api.pipeline import run as stitched
from stitch.effects import EFFECTS
from stitch.errors import InputError
from stitch.model.model_toml import read_model
from stitch.output import run_folder
from stitch.output.result_document import model_of
from stitch.output.run_folder import write_with_page
from stitch.output.stored_run import load_run, trusted_model
from stitch.session.reading.session_folder import load_session
from viz.run_page import write_report


def test_labelled_points_of_a_folder_lie_where_its_run_put_them(tmp_path):
    """One of them is a gross error, and must stay out."""
    session, *_ = labelled_cell(5, views=24)
    session.views[7].sighting.points[2] += [3.0, -2.0, 1.0]
    loaded = load_session(write_labelled(tmp_path / "s", session))
    found = stitched(loaded, effects=["joint_offset"])
    assert len(found.outliers) == 1
    (tmp_path / "r").mkdir()
    write_with_page(found, tmp_path / "r")
    again = load_run(tmp_path / "r")
    for name in ("positions", "orientation"):
        np.testing.assert_array_equal(getattr(again.targets.landmarks, name), getattr(found.targets.landmarks, name))
    np.testing.assert_allclose(again.targets.target_rms, found.targets.target_rms, rtol=1e-9)
    np.testing.assert_array_equal(again.targets.heldout, found.targets.heldout)
    assert again.targets.rms == pytest.approx(found.residual_rms, rel=1e-9)
    for same in (again, stitched(loaded, model_of(found))):
        np.testing.assert_array_equal(same.terms[0].sigmas, found.terms[0].sigmas)
    # A scatter of the poses that nobody knows is no damage.
    document = json.loads((tmp_path / "r" / "result.json").read_text())
    document["repeatability"] = {"rotation": None, "translation": None}
    (tmp_path / "r" / "result.json").write_text(json.dumps(document))
    unknown = load_run(tmp_path / "r")
    assert np.isnan(unknown.repeatability.translation) and np.isnan(unknown.repeatability.rotation)
    for told, shown in ((again, True), (unknown, False)):
        write_report(told, tmp_path / "page.html")
        assert ("Scatter of the robot" in (tmp_path / "page.html").read_text()) == shown


EFFECT = """
from pathlib import Path
from stitch.effects import effect, number
Path(__file__).with_name("executed").touch()

@effect("sensor", k=number("mm", typical=0.02, limit=1.0))
def of_a_stranger(points, view, k):
    "x"
    return points
"""


@pytest.fixture
def model(tmp_path):
    (tmp_path / "sent.py").write_text(EFFECT)
    file = tmp_path / "model.toml"
    rows = [list(map(float, row)) for row in np.eye(4)]
    file.write_text(
        f'format = "stitch-model/1"\nlength_unit = "mm"\nmount = "eye_to_hand"\n'
        f'effects_file = "{tmp_path / "sent.py"}"\n[hand_eye]\ncorrected = {rows}\n'
    )
    yield file
    EFFECTS.pop("of_a_stranger", None)


@pytest.mark.parametrize("whole_folder", [False, True])
def test_no_file_of_effects_runs_by_itself(model, whole_folder):
    with pytest.raises(InputError, match=r"names effects in .*sent.py.*--trust.*--effects-file"):
        trusted_model(model.parent if whole_folder else model)
    assert not (model.parent / "executed").exists() and "of_a_stranger" not in EFFECTS


def test_a_file_of_effects_runs_where_it_is_trusted(model):
    assert trusted_model(model, trust=True)[1] == str(model.parent / "sent.py")
    assert "of_a_stranger" in EFFECTS


def test_a_file_of_ones_own_takes_its_place(model):
    own = model.parent / "own.py"
    own.write_text(EFFECT.replace("of_a_stranger", "of_my_own").replace("executed", "mine"))
    try:
        assert trusted_model(model, effects_file=own)[1] == str(own)
        assert "of_my_own" in EFFECTS and not (model.parent / "executed").exists()
    finally:
        EFFECTS.pop("of_my_own", None)


def test_values_must_be_numbers(model):
    model.write_text(model.read_text() + '[effects.range_scale.s]\nvalue = nan\nunit = ""\n')
    with pytest.raises(InputError, match=r"effects.range_scale.s is nan; to fix"):
        trusted_model(model, trust=True)


def test_a_file_is_named_while_an_effect_of_it_is_in_use(tmp_path):
    """Otherwise a model that needs no Python of anybody would ask for consent to run some."""
    file, folder = tmp_path / "mine.py", tmp_path / "r"
    file.write_text(
        EFFECT.replace("of_a_stranger", "of_my_own").replace("return points", "return points * (1 + 1e-3 * k)")
    )
    session = load_session(write_labelled(tmp_path / "s", labelled_cell(views=12)[0]))
    folder.mkdir()
    try:
        run_folder.write_with_page(replace(run(session), effects_file=str(file)), folder)
        assert read_model(folder).effects_file is None
        for effects in (["of_my_own"], ["of_my_own", "joint_offset"], ["joint_offset"]):
            run_folder.write_with_page(change(load_run(folder, file), effects), folder)
            used = "of_my_own" in effects
            assert read_model(folder).effects_file == (str(file) if used else None)
    finally:
        EFFECTS.pop("of_my_own", None)
    assert load_run(folder).model.effects == ["joint_offset"]
