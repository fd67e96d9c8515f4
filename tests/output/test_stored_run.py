"""A run of labelled points read back from its folder."""

import json

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run as stitched
from stitch.output.result_document import model_of
from stitch.output.run_folder import write_with_page
from stitch.output.stored_run import load_run
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
