"""A run as people hold it: its parts, its report, its cell in a notebook, and the folder that the command writes."""

import html
import json
import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import RigidTransform

import stitch
from stitch.api import run as api_run
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.output.comparison.residual_tables import comparison_document
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.json_file import to_json
from stitch.session.reading.clouds import read_cloud
from tests.api.same import same_folder, taken
from tests.needs import needs_open3d


def test_the_hand_eye_as_an_object(found):
    eye = found.hand_eye
    assert np.array_equal(np.asarray(eye), found.T_mount) and (eye.name, eye.frame) == ("T_flange_scanner", "flange")
    assert isinstance(eye.transform, RigidTransform) and np.allclose(eye.transform.as_matrix(), found.T_mount)
    # Against nature: so many draws of the hand-eye, and how far they put the middle of the scans from where it is.
    xi = np.random.default_rng(0).multivariate_normal(np.zeros(6), eye.covariance, 20_000)
    moved = frames.transform(frames.exp(xi), eye.middle[None])[:, 0] - eye.middle
    assert np.isclose(eye.U.mm, 2 * np.sqrt((moved**2).sum(axis=1).mean()), rtol=0.03)
    assert np.isclose(eye.U.mrad, 2e3 * np.sqrt((xi[:, :3] ** 2).sum(axis=1).mean()), rtol=0.03)
    assert "T_flange_scanner" in repr(eye) and "U at the part" in repr(eye)


def test_u_is_in_millimetres_whatever_the_unit(found):
    eye, scale = found.hand_eye, np.repeat([1.0, 1e-3], 3)
    pose = frames.make(eye.pose[:3, :3], eye.pose[:3, 3] / 1e3)
    covariance = eye.covariance * np.outer(scale, scale)
    metres = replace(eye, pose=pose, covariance=covariance, middle=eye.middle / 1e3, length_unit="m")
    assert np.allclose(metres.U, eye.U)


def test_without_a_rigid_transform_the_matrix_is_named(found, monkeypatch):
    monkeypatch.delattr("scipy.spatial.transform.RigidTransform")
    with pytest.raises(InputError, match="to fix: use pose"):
        _ = found.views[0].transform


def test_the_views_are_where_the_run_puts_them(found):
    assert [view.name for view in found.views] == found.session.names
    for v, view in enumerate(found.views):
        assert np.array_equal(view.pose, found.poses[v])
        assert np.allclose(frames.exp(view.correction) @ view.pose_model, view.pose)
        assert np.allclose(view.transform.as_matrix(), view.pose)
    assert sum(view.points for view in found.views) == sum(v.cloud.count for v in found.session.views)


def test_residuals_are_those_of_the_file(found, tmp_path):
    found.save(tmp_path / "run", recording=False)
    assert found.residuals.equals(pq.read_table(tmp_path / "run" / "residuals.parquet"))


def test_the_stitched_cloud_goes_to_trimesh_with_its_colours(found):
    cloud = found.stitched.to_trimesh()
    assert isinstance(cloud, trimesh.PointCloud) and np.array_equal(cloud.vertices, found.stitched.points)
    assert np.array_equal(cloud.colors[:, :3], found.stitched.colours)
    assert cloud.metadata["residual"].shape == (len(found.stitched),)


def test_the_stitched_cloud_for_open3d_and_back(found):
    needs_open3d()
    legacy = found.stitched.to_open3d()
    assert np.array_equal(np.asarray(legacy.points), found.stitched.points) and legacy.has_normals()
    tensor = found.stitched.to_open3d(tensor=True)
    assert tensor.point["residual"].shape[0] == len(found.stitched)


def test_the_report_has_every_part_once(found, better):
    text = str(found)
    assert re.findall(r"^\[\[(.+?)\]\]", text, re.MULTILINE)[:3] == ["s", "Hand-eye", "Errors"]
    assert f"{found.hand_eye.U.mm:.2g} mm" in text and max(map(len, text.splitlines()[2:])) < 110
    added = str(better)
    assert "[[Effects]]\n  range_scale.s:" in added and "+ range_scale:" in added
    assert repr(better).startswith("Run('s', 5 views")


def test_a_cell_of_a_notebook_asks_no_server_and_holds_the_viewer(found):
    cell = found._repr_html_()
    page = html.unescape(re.search(r'srcdoc="([^"]*)"', cell)[1])
    assert page.startswith("<!doctype html>") and 'id="part-data"' in page and "function partDrawing" in page
    assert not re.search(r"(src|href)=\"(?!data:)", page) and "fetch(" not in page
    assert isinstance(found.plot(), Figure)


def test_a_run_that_is_read_says_what_its_diagnosis_said_in_the_same_numbers(found, tmp_path, stitch_command):
    folder = found.save(tmp_path / "run", recording=False)
    stitch_command("diagnose", folder)
    cell = html.unescape(stitch.load_run(folder)._repr_html_())
    assert "How sure:" in cell and "Not diagnosed yet" not in cell
    *_, model, _ = json.loads((folder / "result.json").read_text())["disagreement"]["steps"]
    screen = json.loads((folder / "diagnosis.json").read_text())["screen"]
    assert screen["now"]["mean"] == model["mean"]


def test_where_nothing_draws_the_cell_is_the_report(found, monkeypatch):
    monkeypatch.setattr(api_run, "entry_points", lambda group: ())
    assert found._repr_html_() == f"<pre>{html.escape(str(found))}</pre>"
    with pytest.raises(InputError, match="nothing that draws"):
        found.plot()


def test_a_viewer_in_the_cell_is_drawn_by_a_browser(found, browser):
    page = browser.new_page()
    page.set_content(found._repr_html_())
    frame = page.frame_locator("iframe")
    frame.locator("[data-now] canvas").wait_for(timeout=20_000)
    assert "the views disagree by" in frame.locator(".verdict").first.inner_text()
    # More colours than one: the part is drawn.
    drawn = frame.locator("[data-now] canvas").screenshot()
    assert len(np.unique(np.asarray(Image.open(BytesIO(drawn)).convert("RGB")).reshape(-1, 3), axis=0)) > 100
    page.close()


def test_a_saved_run_is_what_the_command_writes(loaded, cell_folder, tmp_path, stitch_command):
    stitch_command("run", cell_folder, "-o", tmp_path / "command")
    from_arrays = stitch.run(stitch.Session.from_arrays(**taken(loaded)))
    from_arrays.save(tmp_path / "arrays")
    assert same_folder(tmp_path / "command", tmp_path / "arrays")
    names = [sorted(path.name for path in (tmp_path / own).iterdir()) for own in ("command", "arrays")]
    assert names[0] == names[1]
    a, b = ((tmp_path / own / "recording.rrd").stat().st_size for own in ("command", "arrays"))
    assert abs(a - b) < 0.01 * a
    # Every command works on it, since its session lies beside it; a second time it is the same session.
    stitch_command("add", tmp_path / "arrays", "range_scale", "--no-recording")
    better, added = stitch.add(from_arrays, "range_scale"), stitch.load_run(tmp_path / "arrays")
    assert np.allclose(added.T_mount, better.T_mount, atol=1e-9) and added.effects == better.effects
    with pytest.raises(InputError, match="history of its own"):
        from_arrays.save(tmp_path / "arrays", recording=False)
    from_arrays.save(tmp_path / "arrays", recording=False, force=True)
    assert same_folder(tmp_path / "command", tmp_path / "arrays")


def test_what_is_added_and_dropped_is_what_the_commands_write(better, cell_folder, tmp_path, stitch_command):
    command, python = tmp_path / "command", tmp_path / "python"
    stitch_command("run", cell_folder, "-o", command, "--no-recording")
    first = (command / "model.toml").read_bytes()
    stitch_command("add", command, "range_scale", "--no-recording")
    better.save(python, recording=False)
    assert same_folder(command, python)
    # The command brings back the fit that the folder kept, bit for bit; from Python it is made anew, from elsewhere.
    stitch_command("drop", command, "range_scale", "--no-recording")
    restored, dropped = stitch.load_run(command), stitch.drop(better, "range_scale")
    assert (command / "model.toml").read_bytes() == first
    # Who edits a file where it stands edits no kept fit.
    assert (command / "model.toml").stat().st_nlink == 1
    apart = frames.log(frames.inverse(restored.T_mount) @ dropped.T_mount)
    assert (np.abs(apart) < 0.5 * np.sqrt(np.diag(restored.mount_covariance))).all()
    assert not restored.effects and not dropped.effects


def test_effects_fitted_at_once_are_what_the_command_writes(loaded, cell_folder, tmp_path, stitch_command):
    stitch_command("run", cell_folder, "-o", tmp_path / "command", "--no-recording", "--effects", "range_scale")
    stitch.run(loaded, effects=["range_scale"]).save(tmp_path / "python", recording=False)
    assert same_folder(tmp_path / "command", tmp_path / "python")


@pytest.mark.usefixtures("few_effects")
def test_a_diagnosis_and_a_comparison_are_those_of_the_commands(found, tmp_path, stitch_command):
    folder = found.save(tmp_path / "run", recording=False)
    diagnosis = json.loads(stitch_command("diagnose", folder, "--json"))
    assert diagnosis.pop("of")  # of which state of the run folder it is
    assert json.loads(to_json(diagnosis_document(stitch.diagnose(found)))) == diagnosis
    comparison = json.loads(stitch_command("compare", folder, "--json"))
    assert json.loads(to_json(comparison_document(stitch.compare(found)))) == comparison


def test_another_session_beside_the_run_is_kept(arrays, found, tmp_path):
    clouds, poses = arrays
    first = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", check=False)
    replace(first, name="other").save(tmp_path / "run-session")
    held = replace(found, session=first, measured=first)
    with pytest.raises(InputError, match="holds another session"):
        held.save(tmp_path / "run", recording=False)


def test_a_run_of_views_that_were_left_out_keeps_them_in_its_session(loaded, tmp_path):
    """One pose is wrong by far: its view does not belong, and stays in what was measured."""
    given = taken(loaded)
    T = given["poses"].copy()
    T[2, :3, 3] += [40.0, 0, 0]
    session = stitch.Session.from_arrays(**given | {"poses": T, "joints": None, "robot": None, "check": False})
    run = stitch.run(session)
    assert [item.view for item in run.left_out] == ["v002"] and len(run.views) == 4
    run.save(tmp_path / "run", recording=False)
    assert len(stitch.load_session(tmp_path / "run-session").views) == 5
    assert "[[Left out]]\n  v002: " in str(run)


def test_exports_are_those_of_the_command(found, tmp_path, stitch_command):
    folder = found.save(tmp_path / "run", recording=False)
    for to in ("ros", "kuka", "arm-dh"):
        assert stitch.export_run(found, to) == stitch_command("export", folder, "--to", to)
    stitch_command("export", folder, "--to", "ply", "-o", tmp_path / "a.ply")
    assert stitch.export_run(found, "ply", tmp_path / "b.ply") is None
    assert np.array_equal(read_cloud(tmp_path / "a.ply").points, read_cloud(tmp_path / "b.ply").points)
    for to, says in (("dxf", "no such format"), ("ply", "where to")):
        with pytest.raises(InputError, match=says):
            stitch.export_run(found, to)


def test_effects_are_asked_for_by_name(found, better):
    for call, says in (
        (lambda: stitch.add(found, "no_such"), "no_such"),
        (lambda: stitch.drop(found, "range_scale"), "s: range_scale is not in its model; to fix: leave it out"),
        (lambda: stitch.add(better, "range_scale"), "s: range_scale is in its model already"),
        (lambda: stitch.run(found.session, effects=["no_such"]), "no_such"),
    ):
        with pytest.raises(InputError, match=says):
            call()


def test_the_model_of_a_run_serves_another_session(found, loaded):
    again = stitch.run(loaded, model=found)
    assert np.array_equal(again.T_mount, found.T_mount)


# Minutes of work: `make check` runs it, `make test` does not.
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["david", "cone", "sphere", "rubik", "gripperopen"])
def test_arrays_give_what_the_folder_gives(reghec, tmp_path, stitch_command, name):
    stitch_command("run", reghec(name), "-o", tmp_path / "command", "--no-recording")
    loaded = stitch.load_session(reghec(name))
    run = stitch.run(stitch.Session.from_arrays(**taken(loaded)))
    run.save(tmp_path / "arrays", recording=False)
    assert same_folder(tmp_path / "command", tmp_path / "arrays")
    # And once more as the camera gave them, in metres: those that the poses do not fit are refused.
    metres = {view.name: np.asarray(view.cloud.points / 1e3, np.float32) for view in loaded.views}
    given = taken(loaded) | {"clouds": metres}
    assert stitch.Session.from_arrays(**given, cloud_unit="m").length_unit == "mm"
    with pytest.raises(stitch.InputError, match='set cloud_unit = "m"'):
        stitch.Session.from_arrays(**given)
    with pytest.raises(stitch.InputError, match="the poses contradict what was measured: (inverse|mount)"):
        stitch.Session.from_arrays(**taken(loaded) | {"poses": np.linalg.inv(given["poses"])})
