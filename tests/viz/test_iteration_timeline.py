"""The timelines iteration and view: every stage and iteration, every scan once, moved as the run moved it; all in the picture."""

import re
from dataclasses import replace
from shutil import copyfile

import numpy as np
import pytest
from rerun.chunk import RrdReader

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import change, run
from stitch.numerics import frames
from viz.blueprint import eye_for
from viz.iteration_timeline import Moment, log_moments
from viz.recording import RerunRecorder
from viz.rrd_file import RecordingFile


def rows(path, entity, column):
    """(times by timeline, value) of every row of an entity that has the column."""
    out = []
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and column in batch.schema.names:
            lines = {
                name: batch.column(name).to_pylist() for name in ("iteration", "view") if name in batch.schema.names
            }
            values = batch.column(column).to_pylist()
            out += [({name: times[i] for name, times in lines.items()}, value) for i, value in enumerate(values)]
    return out


def titles(path):
    """Headings of the timeline `iteration`, in its order."""
    told = [
        (times["iteration"], text[0])
        for times, text in rows(path, "/moment", "TextDocument:text")
        if "iteration" in times
    ]
    return [text.splitlines()[0].removeprefix("## ") for _, text in sorted(told)]


def pose_at(path, name, iteration):
    """T_reference_scanner (4, 4) of a view at a place of the timeline; Rerun's matrices go column by column."""
    T = np.eye(4)
    for column, put in (("Transform3D:mat3x3", np.s_[:3, :3]), ("Transform3D:translation", np.s_[:3, 3])):
        found = [v[0] for times, v in rows(path, f"/views/{name}", column) if times.get("iteration") == iteration]
        T[put] = np.reshape(found[0], (3, 3)).T if column.endswith("mat3x3") else found[0]
    return T


def test_the_timeline_has_every_stage_and_iteration(recorded):
    result, path = recorded
    # The last of `correct` is the rms after its last step.
    corrected, registered = len(result.convergence["correct"]) - 1, len(result.convergence["register"])
    assert titles(path) == [
        "raw scans",
        "coarse",
        *(f"correct, iteration {k + 1}" for k in range(corrected)),
        "correct ended",
        *(f"register, iteration {k + 1}" for k in range(registered)),
        "register ended",
        "fuse",
    ]


def test_every_scan_is_there_once_and_moves_as_the_run_moved_it(recorded):
    result, path = recorded
    reached = titles(path)
    for v, view in enumerate(result.session.views):
        clouds = rows(path, f"/views/{view.name}", "Points3D:positions")
        assert len(clouds) == 1
        times, points = clouds[0]
        assert times == {"iteration": 0, "view": v}
        assert len(points) == min(len(view.cloud.points), 10_000)
        assert pose_at(path, view.name, reached.index("register ended")) == pytest.approx(result.poses[v], abs=1e-4)


def test_motions_are_as_many_times_larger_as_is_said(recorded):
    result, path = recorded
    at = titles(path).index("correct ended")
    (said,) = [text[0] for times, text in rows(path, "/now", "TextDocument:text") if times["iteration"] == at]
    factor = float(re.search(r"displaced (\d+) times as far", said)[1])
    where = frames.transform(result.poses[0], result.session.views[0].cloud.points[::50])
    moved = {v: pose_at(path, view.name, at) for v, view in enumerate(result.session.views)}

    def displacement(T, v):
        return frames.transform(T @ frames.inverse(result.poses[v]), where) - where

    shown = np.array([displacement(moved[v], v) for v in moved])
    true = np.array([displacement(result.poses_model[v], v) for v in moved])
    # A motion that all views share is not shown.
    np.testing.assert_allclose(
        shown - shown.mean(axis=0), factor * (true - true.mean(axis=0)), atol=0.02 * np.ptp(shown)
    )
    assert factor >= 10


def test_the_recording_after_a_change_has_the_iterations_before_it(recorded, tmp_path):
    result, path = recorded
    before = titles(path)
    copyfile(path, tmp_path / "t.rrd")
    change(result, ["joint_offset"], RerunRecorder(tmp_path / "t.rrd"))
    after = titles(tmp_path / "t.rrd")
    fitted = before.index("correct ended") + 1
    assert after[:fitted] == before[:fitted]
    assert after[fitted] == "+ joint_offset: fit, iteration 1"
    assert "+ joint_offset: correct ended" in after and after[-1] == "fuse"


def test_a_view_that_is_left_out_stays_until_then(recorded, tmp_path):
    result, _ = recorded
    whole = replace(result.session, views=(*result.session.views, replace(result.session.views[0], name="stray")))
    places = np.concatenate([result.poses, result.poses[:1]])
    moments = [
        Moment("correct", f"correct, iteration {k}", tuple(whole.names[: 6 - k // 2]), places[: 6 - k // 2])
        for k in range(4)
    ]
    file = RecordingFile("stitch", tmp_path / "left-out.rrd")
    log_moments(file.stream, result, moments, whole, None)
    file.write()
    path = tmp_path / "left-out.rrd"
    assert [times for times, _ in rows(path, "/views/stray", "Clear:is_recursive")] == [{"iteration": 2}]
    assert [times for times, _ in rows(path, "/views/stray", "Points3D:positions")] == [{"iteration": 0}]
    assert not rows(path, "/views/v000", "Clear:is_recursive")


def test_labelled_points_move_in_the_timeline_too(tmp_path):
    session = labelled_cell(3, views=12)[0]
    result = run(session, recorder=RerunRecorder(tmp_path / "t.rrd"))
    reached = titles(tmp_path / "t.rrd")
    assert reached[:3] == ["raw scans", "coarse", "fit, iteration 1"]
    assert reached[-2:] == ["correct ended", "register ended"]
    last = pose_at(tmp_path / "t.rrd", session.names[3], len(reached) - 1)
    assert last == pytest.approx(result.poses[3], abs=1e-3)


HALF_FIELD = np.tan(np.radians(55.0) / 2)  # of the viewer's field, upwards


@pytest.mark.parametrize("sides", [(500.0, 300.0, 80.0), (60.0, 60.0, 400.0), (1.0, 0.02, 0.5), (3.0, 3.0, 3.0)])
@pytest.mark.parametrize("aspect", [0.68, 1.5])
def test_all_is_in_the_picture_and_fills_it(sides, aspect):
    generator = np.random.default_rng(int(sum(sides)))
    points = generator.uniform(-0.5, 0.5, (400, 3)) * sides + [700.0, -20.0, 5.0]
    axes = frames.exp(generator.standard_normal(6))[:3, :3]
    eye = eye_for(points, axes, axes[1], aspect)
    position, target = (np.array(at.as_arrow_array().to_pylist()[0]) for at in (eye.position, eye.look_target))
    ahead = (target - position) / np.linalg.norm(target - position)
    np.testing.assert_allclose(ahead, -axes[2], atol=1e-4)
    depth = (points - position) @ ahead
    across = np.abs((points - position) @ axes[0] / depth) / (aspect * HALF_FIELD)
    upwards = np.abs((points - position) @ axes[1] / depth) / HALF_FIELD
    assert max(across.max(), upwards.max()) < 1
    assert max(across.max(), upwards.max()) > 0.8
