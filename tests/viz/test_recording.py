"""What people see: the recording of a small run, and of one to which an effect was added; its page; numbers that agree at every step.

What the marks of labelled points stand for, and where they stand.

The machine as a drawing: what errs is marked, and nothing where no arm is known.
"""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import PROBE_TURN, TABLE, TARGETS, flange, labelled_cell
from data_synth.fixtures.quiet_scenes import clean, plan_for
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.api.pipeline import diagnose, run
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.numerics.units import length_text
from stitch.output.comparison.model_history import model_history
from stitch.output.finding_screen import finding_screen
from stitch.output.result_document import result_document
from stitch.run_data import Note
from viz.colours import UNSEEN, signed_colours
from viz.course_recording import apart, log_course
from viz.diagnosis_recording import log_diagnosis
from viz.machine_drawing import machine_svg
from viz.model_timeline import one_above_the_other
from viz.page_parts import unbroken
from viz.rrd_file import RecordingFile
from viz.run_page import write_report
from viz.target_scene import ANY, NOTHING, bodies, mark_values, marks_of


def rerun(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name("rerun")
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=False)


def columns(path, column):
    """Entity → values of the last chunk that has this column."""
    batches = ((chunk.entity_path, chunk.to_record_batch()) for chunk in RrdReader(str(path)).stream())
    return {entity: batch.column(column)[-1].as_py() for entity, batch in batches if column in batch.schema.names}


def names_of_views(path):
    """As the blueprint has them."""
    reader = RrdReader(str(path))
    batches = (chunk.to_record_batch() for chunk in reader.stream(store=reader.blueprints()[-1]))
    named = ((batch, key) for batch in batches for key in batch.schema.names if "display_name" in key)
    return {name for batch, key in named for name in batch.column(key)[-1].as_py()}


def eyes(path):
    """Name of a 3D view → where its eye stands and looks, and what is up, as the blueprint has them."""
    reader, named, eye = RrdReader(str(path)), {}, {}
    for chunk in reader.stream(store=reader.blueprints()[-1]):
        batch, (_, *place) = chunk.to_record_batch(), chunk.entity_path.split("/")
        for key in batch.schema.names:
            if place[0] == "view" and key == "ViewBlueprint:display_name":
                named[place[1]] = batch.column(key)[-1].as_py()[0]
            elif place[0] == "view" and key.startswith("EyeControls3D:"):
                eye.setdefault(place[1], {})[key] = batch.column(key)[-1].as_py()
    return {named[view]: found for view, found in eye.items()}


def titles(rows):
    """Names of the views of a step, as result.json has its numbers."""
    return [f"{row['step']}: views disagree by {length_text(row['mean'], 'mm')} on average" for row in rows]


def test_the_recording_is_whole_and_small_and_shows_everything(recorded):
    result, path = recorded
    assert rerun("rrd", "verify", str(path)).returncode == 0
    assert path.stat().st_size < 15_000_000
    off = np.nanmean(np.abs(model_history(result).models[0].field.values), axis=1)
    farthest = [result.session.views[v].name for v in np.argsort(-off)[:4]]
    shown = {chunk.entity_path for chunk in RrdReader(str(path)).stream()}
    parts = {f"/part/{name}" for name in ("now", "before", "after")} | {f"/scans/{name}" for name in farthest}
    cell = {"/robot/arm", "/robot/flanges", "/robot/part", "/robot/scanner/scanner", "/robot/names"}
    drawn = {"/bars/views", "/colours/field/ticks", "/diagnosis/why/title"}
    assert parts | cell | drawn | {"/stitched", "/displacements", "/now", "/verdict", "/diagnosis/verdict"} <= shown


def test_why_is_drawn_to_scale_and_colours_the_arms(tmp_path):
    """Heights are in proportion to what was measured, upwards, and the largest offset has the strongest colour."""
    course = {
        "follows": "view order",
        "unit": "",
        "of": "the part",
        "value_unit": "mm",
        "views": [0, 1, 2],
        "at": [0.0, 1.0, 2.0],
        "measured": [0.0, 0.1, 0.2],
        "sigma": [0.01] * 3,
        "predicted": [0.0, 0.1, 0.2],
        "predicted_sigma": [0.01] * 3,
    }
    file = RecordingFile("stitch", tmp_path / "d.rrd")
    log_course(file.stream, course, ["a", "b", "c"], 1e3)
    file.write()
    places = np.array(columns(tmp_path / "d.rrd", "Points2D:positions")["/diagnosis/why/dots"])
    steps = np.diff(places, axis=0)
    assert steps[0] == pytest.approx(steps[1], rel=1e-4) and steps[0][1] < 0 < steps[0][0]
    colours = columns(tmp_path / "d.rrd", "LineStrips3D:colors")["/robot/arm"]
    assert len(set(colours)) == 3
    assert columns(tmp_path / "d.rrd", "Points2D:labels")["/diagnosis/why/names"] == ["a", "b", "c"]


def test_of_places_that_lie_together_one_is_named():
    """Over a torque views crowd: from the left each that leaves room for the words of the last that is named."""
    assert apart(np.array([5.0, 0.0, 1.0, 9.9, 4.1]), 4.0) == [1, 4, 3]


def test_no_name_of_a_view_covers_another():
    up = np.array([0.0, 0.6, 0.8])
    views = [np.random.default_rng(seed).uniform(-100, 100, (5000, 3)) for seed in range(4)]
    heights = np.sort(one_above_the_other(views, up) @ up)
    low, high = (f(np.concatenate(views) @ up) for f in (np.min, np.max))
    assert np.allclose(np.diff(heights), (high - low) / 4, rtol=0.2)


def test_titles_and_words_say_what_the_result_says(recorded):
    result, path = recorded
    stated = result_document(result)["disagreement"]["steps"]
    before, after = titles([stated[1], stated[-1]])
    after = f"{after} (single views moved)"
    assert {before, after} <= names_of_views(path)
    # The viewer cannot link eyes: before and after at least open with the same.
    eye = eyes(path)
    assert set(eye[before]) == {f"EyeControls3D:{what}" for what in ("position", "look_target", "eye_up")}
    assert eye[before] == eye[after]
    said = told_at(path)
    last = said[max(said)]
    assert unbroken(titles(stated[-1:])[0].partition(": ")[2]) in last


@pytest.mark.slow
def test_what_was_suggested_shows_another_map_before_than_after(few_effects, tmp_path, stitch_command):
    """What `add --suggested` tried on the way must not count as the change."""
    cell = measured_blade(3, views=10, pixels=90, hidden={"joint_compliance": 2.0}, repeatability=(5e-6, 0.005))
    write_session(tmp_path / "s", cell, "s")
    stitch_command("run", tmp_path / "s", "-o", tmp_path / "r", "--no-recording")
    stitch_command("add", tmp_path / "r", "--suggested")
    stated = json.loads((tmp_path / "r" / "result.json").read_text())["disagreement"]["steps"]
    assert [row["step"] for row in stated] == ["coarse", "hand-eye alone", "+ joint_compliance", "register"]
    recording = tmp_path / "r" / "recording.rrd"
    assert set(titles(stated[1:3])) <= names_of_views(recording)
    colours = columns(recording, "Mesh3D:vertex_colors")
    before, after = (np.array(colours[f"/part/{name}"]) for name in ("before", "after"))
    assert np.mean(before != after) > 0.5
    # The diagnosis lies in the same file, in place of the line that asks for it.
    assert rerun("rrd", "verify", str(recording)).returncode == 0
    words = columns(recording, "TextDocument:text")["/diagnosis/verdict"][0]
    assert unbroken(json.loads((tmp_path / "r" / "diagnosis.json").read_text())["sentence"]) in words


def test_the_recording_says_where_a_joint_errs_without_a_name(tmp_path):
    session = labelled_cell(3, views=30)[0]
    found = diagnose(run(session))
    angle, error = np.array([-60.0, 0.0, 40.0]), np.array([-1e-4, 0.0, 2.5e-4])
    course = JointCurve(2, "j3_deg", 0.8, angle, error, np.full(3, 1e-5), view_values=angle, place="joint 2")
    file = RecordingFile("stitch", tmp_path / "d.rrd")
    log_diagnosis(file.stream, replace(found, curves=(course,)), finding_screen(found), session)
    file.write()
    said = columns(tmp_path / "d.rrd", "TextDocument:text")["/diagnosis/verdict"][0]
    assert unbroken("Joint 2 is off by -0.1 ± 0.01 mrad at j3 = -60°, and by 0.25 ± 0.01 mrad at j3 = 40°") in said


def test_page_needs_nothing_beside_it_and_says_everything(recorded, tmp_path):
    result, _ = recorded
    noted = replace(result.ledger[-1], notes=(Note("2026-03-01T10:00:00+00:00", "Q", "clamp <loose>"),))
    told = replace(result, ledger=(*result.ledger[:-1], noted))
    told = told.with_fit(unobservable=("translation along the axis of joint 6",))
    write_report(told, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert "blade &lt;1&gt;" in page
    assert "translation along the axis of joint 6" in page
    assert re.search(r"<b>hand-eye alone</b>: clamp &lt;loose&gt; <span>\(Q, 2026-03-01\)</span>", page)
    assert all(view.name in page for view in result.session.views)
    assert all(f"<td>{stage.name}</td>" in page for stage in result.stages)


def test_colours_say_below_above_and_unseen():
    below, level, above, unseen = signed_colours(np.array([-1.0, 0.0, 1.0, np.nan]), 1.0).astype(int)
    assert below[2] > below[0]
    assert above[0] > above[2]
    assert level.min() > 230
    assert tuple(unseen) == UNSEEN


def told_at(recording):
    """Place of the timeline `iteration` → the words beside the part."""
    chunks = (c.to_record_batch() for c in RrdReader(str(recording)).stream() if c.entity_path == "/now")
    rows = (zip(b.column("iteration"), b.column("TextDocument:text"), strict=True) for b in chunks)
    return {frame.as_py(): text.as_py()[0] for batch in rows for frame, text in batch}


def require_steps(recording, rows):
    """Rows of `disagreement.steps` of a result in mm: each is what some moment says, in their order."""
    told = [words for _, words in sorted(told_at(recording).items())]
    said = [unbroken(f"views disagree by {length_text(row['mean'], 'mm')} on average.") for row in rows]
    places = [next(i for i, words in enumerate(told) if text in words) for text in said]
    assert places == sorted(places)


def test_the_recording_of_a_small_run(recorded):
    run, path = recorded
    require_steps(path, result_document(run)["disagreement"]["steps"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rubik"])
def test_a_real_object_has_a_page_and_a_recording(reghec, name, tmp_path, stitch_command):
    stitch_command("run", reghec(name), "-o", tmp_path / "r")
    rows = json.loads((tmp_path / "r" / "result.json").read_text())["disagreement"]["steps"]
    require_steps(tmp_path / "r" / "recording.rrd", rows)
    page = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    shown = json.loads(re.search(r'id="part-data">(.*?)</script>', page, re.S)[1])["steps"]
    assert [(s["name"], s["mean"]) for s in shown] == [(r["step"], pytest.approx(1e3 * r["mean"])) for r in rows]


def test_a_mark_counts_what_it_stands_for():
    view, target, distance = np.array([0, 0, 1, 3]), np.array([0, 2, 2, 0]), np.array([3.0, 4.0, 12.0, 5.0])
    marks = np.array([(0, 2), (0, ANY), (ANY, 2), (ANY, 0), (3, 0), (2, ANY), (1, 0), (ANY, 1), (NOTHING, NOTHING)])
    square = [16, (9 + 16) / 2, (16 + 144) / 2, (9 + 25) / 2, 25]
    expected = np.append(np.sqrt(square), [np.nan] * 4)
    np.testing.assert_allclose(mark_values(marks, view, target, distance), expected)


@pytest.mark.parametrize("kind", ["carried targets", "carried scanner", "probe"])
def test_marks_stand_where_the_cell_has_them(kind):
    """By the true cell, whose chain is written down a second time; poses scatter by 20 µm."""
    mount = "eye_in_hand" if kind == "carried scanner" else "eye_to_hand"
    session, T_mount, _ = labelled_cell(1, views=12, mount=mount, probe=kind == "probe")
    marks = marks_of(run(session))
    joints = np.array([view.joints for view in session.views])
    T_base_flange = np.array([flange(q) for q in joints])
    own = marks.view >= 0
    if mount == "eye_in_hand":
        expected = (T_base_flange @ T_mount)[marks.view[own], :3, 3]
        balls = marks.T[marks.target >= 0, :3, 3]
        np.testing.assert_allclose(balls, TARGETS + TABLE, atol=0.2)
    else:
        expected = np.array(
            [
                (T_base_flange[v] @ [*TARGETS[k], 1.0])[:3]
                for v, k in zip(marks.view[own], marks.target[own], strict=True)
            ]
        )
        assert len(expected) == 12 * (1 if kind == "probe" else len(TARGETS))
    np.testing.assert_allclose(marks.T[own, :3, 3], expected, atol=0.2)
    if kind == "probe":
        turned = T_base_flange[marks.view[own], :3, :3] @ PROBE_TURN
        np.testing.assert_allclose(marks.T[own, :3, :3], turned, atol=1e-3)
    # All bodies together: every vertex belongs to its mark, and lies near it.
    surface = bodies(marks)
    away = np.linalg.norm(surface.vertices - marks.T[surface.patch[:, 0], :3, 3], axis=1)
    assert away.max() < 0.2 * np.ptp(marks.valued, axis=0).max()
    assert set(surface.patch[:, 0]) == set(range(len(marks.shape)))


@pytest.fixture(scope="module")
def erring_run():
    scene = clean("blade", rays=40)
    planned = plan_for(scene, 2, 6)
    return stitch.run(session_of(simulate(scene, {}, 2, planned=planned)))


def circles(svg):
    return re.findall(r'<circle [^>]*fill="([^"]*)"', svg)


def test_every_joint_is_drawn_and_the_one_that_errs_is_marked_and_moves(erring_run):
    svg = machine_svg(erring_run, ("joint 5",))
    fills = circles(svg)
    assert len(fills) == erring_run.session.robot.n_joints
    assert fills.count("var(--best)") == 1 and ">5</text>" in svg
    assert "stroke-dasharray" in svg.split("<polyline", 2)[2].split("/>")[0]


def test_without_a_cause_nothing_is_marked(erring_run):
    assert "var(--best)" not in machine_svg(erring_run)


@pytest.mark.parametrize(
    "errs, name", [("the scanner's mount", "mount"), ("the scanner", "scanner"), ("the part", "part")]
)
def test_mount_scanner_and_part_are_marked_where_they_err(erring_run, errs, name):
    svg = machine_svg(erring_run, (errs,))
    marked = re.search(r'fill="var\(--best\)"/><text[^>]*>(\w+)</text>', svg)
    assert marked[1] == name


def test_a_link_that_errs_is_marked_between_its_joints(erring_run):
    svg = machine_svg(erring_run, ("link 4",))
    assert svg.count('stroke="var(--best)"') == 1 and "var(--best)" not in "".join(circles(svg))


def test_suspects_are_marked_with_a_question_and_nothing_moves(erring_run):
    svg = machine_svg(erring_run, ("joint 2", "the robot's base"), suspected=True)
    assert ">2?</text>" in svg and ">base?</text>" in svg and svg.count('stroke-dasharray="5 4"') == 0
    assert "suspected: joint 2 and the robot's base" in svg


def test_everything_lies_within_the_picture(erring_run):
    points = re.findall(r'points="([^"]*)"', machine_svg(erring_run, ("joint 2",)))
    places = np.array([pair.split(",") for line in points for pair in line.split()], float)
    assert (places > 0).all() and (places < [230, 250]).all()


def test_without_an_arm_there_is_no_drawing(erring_run):
    assert machine_svg(replace(erring_run, session=replace(erring_run.session, robot=None))) == ""
