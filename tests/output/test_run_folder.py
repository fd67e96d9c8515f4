"""Run folders through their commands: what is written agrees with itself, and nothing stale or half-made stays.

Where a run may go, and what of the folder there is its own.

A run read back from its folder; the Python file that its model names is run only where somebody allows it.
"""

import json
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from pyarrow.parquet import read_table

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.edits import set_cell
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.write import write_session
from stitch.api import pipeline, stepwise
from stitch.api.pipeline import change, run, run_rig
from stitch.api.pipeline import run as stitched
from stitch.cli.main import main
from stitch.effects import EFFECTS
from stitch.errors import InputError, NoResultError
from stitch.model.model_toml import read_model
from stitch.numerics import frames
from stitch.output import run_folder
from stitch.output.json_file import SCANS, is_run_file, require_free, sessions_in
from stitch.output.result_document import model_of
from stitch.output.run_folder import restore_fit, write_with_page
from stitch.output.stored_run import diagnosed_state, load_run, trusted_model
from stitch.recorder import SilentRecorder
from stitch.run_data import LedgerStep
from stitch.session import capture
from stitch.session.capture import prepare_capture
from stitch.session.kept_scans import read_scans
from stitch.session.reading.session_folder import load_session
from stitch.session.scan import prepare_scan
from tests.command_line import ended
from viz import run_page
from viz.page_parts import sections_of, with_sections
from viz.run_page import write_report

EFFECT = "scanner_thermal_scale"


@pytest.fixture(scope="module")
def folder(tmp_path_factory, stitch_command):
    """Two sessions of one cell; `r` is a run of the first, named its effect twice, `q` one of the second by r's model."""
    folder = tmp_path_factory.mktemp("runs")
    for seed, name in enumerate("so"):
        write_session(folder / name, measured_blade(seed, views=5, pixels=50), name)
    stitch_command("run", folder / "s", "-o", folder / "r", "--no-recording", "--effects", f"{EFFECT},{EFFECT}")
    stitch_command("run", folder / "o", "-o", folder / "q", "--no-recording", "--hand-eye", folder / "r")
    return folder


def told(run):
    return json.loads((run / "result.json").read_text())


def page(run):
    """The page without its pictures and the times that were taken."""
    text = re.sub(r'src="data:[^"]*"', "", (run / "report.html").read_text())
    return re.sub(r'<td>[\d.]+</td>(<td class="wide">)', r"\1", text)


def files(run):
    return {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}


@pytest.fixture
def prepared_anew(monkeypatch):
    """Names of the views whose scans are made ready by computation."""
    names = []
    monkeypatch.setattr(
        capture, "prepare_scan", lambda name, *points, **at: names.append(name) or prepare_scan(name, *points, **at)
    )
    return names


def test_scans_that_a_run_made_ready_are_taken_from_its_folder(folder, prepared_anew):
    anew = prepare_capture(load_session(folder / "s")).scans
    prepared_anew.clear()
    for kept, scan in zip(load_run(folder / "r").measurement.capture.scans, anew, strict=True):
        for field in fields(scan):
            if field.name != "tree":
                np.testing.assert_array_equal(getattr(kept, field.name), getattr(scan, field.name), field.name)
        np.testing.assert_array_equal(kept.tree.query(scan.points, k=2)[1], scan.tree.query(scan.points, k=2)[1])
    assert prepared_anew == []


def test_a_scan_that_changed_in_its_last_digit_is_made_anew(folder, prepared_anew):
    session = load_session(folder / "s")
    view = session.views[1]
    points = view.cloud.points.copy()
    points[7, 2] = np.nextafter(points[7, 2], 0)
    views = (session.views[0], replace(view, cloud=replace(view.cloud, points=points)), *session.views[2:])
    prepare_capture(replace(session, views=views), read_scans(folder / "r" / SCANS))
    assert prepared_anew == [view.name]


@pytest.mark.parametrize(
    "damage",
    [
        Path.unlink,
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(file.read_bytes()[:999]),
        lambda file: np.savez(file, counts=[3, 3]),
        lambda file: file.write_text("normals"),
    ],
)
def test_without_its_kept_scans_a_run_reads_as_before(folder, tmp_path, damage):
    copy = shutil.copytree(folder / "r", tmp_path / "r")
    damage(copy / SCANS)
    for kept, anew in zip(*(load_run(path).measurement.capture.scans for path in (folder / "r", copy)), strict=True):
        np.testing.assert_array_equal(kept.normals, anew.normals)


def test_a_model_that_is_used_as_it_is_stays_as_it_is(folder):
    first, second = told(folder / "r"), told(folder / "q")
    assert second["effects"] == first["effects"] and first["effects"][EFFECT]["k"]["sigma"] > 0
    assert read_model(folder / "q").effects == read_model(folder / "r").effects
    assert second["hand_eye"] == first["hand_eye"] and second["hand_eye_sigma"] == first["hand_eye_sigma"]
    assert [told(folder / run)["stages"][0]["note"] for run in "rq"] == [
        "given in session.toml", "of another run, used as it is",
    ]  # fmt: skip


def test_an_effect_named_twice_counts_once(folder):
    assert json.loads((folder / "r" / "ledger.json").read_text())[0]["effects"] == [EFFECT]
    ledger = pipeline.change(load_run(folder / "q"), ["range_scale", "range_scale"]).ledger
    assert ledger[-1].effects == ("range_scale",)


@pytest.mark.parametrize("name", ["r", "q"])
def test_a_page_made_anew_is_the_page_of_the_run(folder, name, stitch_command):
    run = folder / name
    before, text = files(run), page(run)
    (run / "report.html").unlink()
    stitch_command("report", run, "--no-diagnosis")
    assert page(run) == text
    shown = np.array([float(number) for number in re.findall(r"\d+\.\d+", text)])
    assert f"{1e3 * told(run)['residual_rms']:.1f}" in text
    assert np.abs(shown - told(run)["hand_eye"][0][3]).min() < 1e-6
    assert {k: v for k, v in files(run).items() if k != "report.html"} == {
        k: v for k, v in before.items() if k != "report.html"
    }


@pytest.mark.slow
def test_a_page_of_a_rig_shows_the_hand_eye_of_all(folder, tmp_path):
    runs = run_rig([load_session(folder / name) for name in "so"])
    write_with_page(runs[1], tmp_path)
    again = load_run(tmp_path)
    np.testing.assert_array_equal(again.T_mount, runs[0].T_mount)
    assert again.residual_rms == runs[1].residual_rms and again.heldout_rms == runs[1].heldout_rms


def test_a_model_that_was_edited_gets_no_page_of_another(folder, tmp_path):
    run = shutil.copytree(folder / "r", tmp_path / "r")
    k = repr(told(run)["effects"][EFFECT]["k"]["value"])
    (run / "model.toml").write_text((run / "model.toml").read_text().replace(k, "1e-5"))
    line = ended("report", run, code=2).err.strip()
    assert "\n" not in line and "model.toml: changed after the run" in line
    assert files(run)["report.html"] == files(folder / "r")["report.html"]


def test_a_diagnosis_of_this_very_model_is_not_made_anew(folder, tmp_path, monkeypatch, stitch_command):
    """The page keeps what it said, and nothing is added where it names nothing; of another state it is forgotten."""
    run = shutil.copytree(folder / "q", tmp_path / "r")
    page = run / "report.html"
    document = {"verdict": "adequate", "plain": "Nothing.", "sentence": "Nothing at all.", "notes": []}
    document |= {"next_command": "Next: stitch export RUN --to ros", "of": diagnosed_state(load_run(run), run)}
    (run / "diagnosis.json").write_text(json.dumps(document))
    (run / "compare.json").write_text("{}")
    said = {"missing": "<p>asked</p>", "screen": '<script id="screen-data"></script>'}
    page.write_text(with_sections(page.read_text(), said))

    def again(*_):
        raise AssertionError("diagnosed again")

    monkeypatch.setattr(pipeline, "diagnose", again)
    stitch_command("report", run)
    assert said.items() <= sections_of(page.read_text()).items()
    told = stitch_command("add", run, "--suggested")
    assert "Nothing at all.\nNothing was added" in told and f"Next: stitch export {run} --to ros" in told
    (run / "diagnosis.json").write_text(json.dumps(document | {"of": "another"}))
    stitch_command("report", run, "--no-diagnosis")
    assert "Not diagnosed yet" in page.read_text() and "asked</p>" not in page.read_text()


STALE = ("diagnosis.json", "diagnosis.rrd", "compare.json", "mesh.ply", "recording.rrd", "robot.toml", "robot.urdf")


@pytest.fixture
def changing(folder, tmp_path, monkeypatch):
    """A copy of `q` with everything beside it that commands make of a model; changes take no time."""
    run = shutil.copytree(folder / "q", tmp_path / "q")
    (run / "pictures").mkdir(exist_ok=True)
    for name in (*STALE, "pictures/budget.png"):
        (run / name).write_text("of the old model")
    result = replace(load_run(run), ledger=())
    monkeypatch.setattr(pipeline, "change", lambda state, effects, recorder: result)
    return run, result


def test_nothing_of_the_old_model_stays_beside_the_new_one(changing, stitch_command):
    run, _ = changing
    stitch_command("drop", run, EFFECT, "--no-recording")
    assert {path.name for path in run.iterdir() if path.is_file()} == {
        "model.toml", "result.json", "ledger.json", "stitched.ply", "residuals.parquet", "report.html", SCANS,
    }  # fmt: skip


def test_the_way_back_to_an_earlier_fit_takes_no_fit(changing, folder, stitch_command):
    """All that was made of the model comes back bit for bit, as one more step; not once a scan or a table has changed."""
    run, _ = changing
    (run / "result.json").touch()  # written last, as a run writes it
    before = files(run)
    stitch_command("drop", run, EFFECT, "--no-recording")
    steps = len(json.loads((run / "ledger.json").read_text()))
    assert not restore_fit(run, [], recording=False)
    assert restore_fit(run, [EFFECT], recording=True)
    after = files(run)
    assert after.keys() == before.keys() and all(
        after[name] == before[name] for name in before.keys() - {"ledger.json"}
    )
    ledger = json.loads(after["ledger.json"])
    assert len(ledger) == steps + 1 == ledger[-1]["step"] + 1 and ledger[-1]["effects"] == [EFFECT]
    (folder / "o" / "views.csv").touch()
    assert not restore_fit(run, [EFFECT], recording=True)


@pytest.mark.parametrize("error", [NoResultError("no"), KeyboardInterrupt()])
def test_a_change_that_fails_leaves_the_run_as_it_was(changing, monkeypatch, error):
    run, _ = changing
    before = files(run)

    def fails(state, effects, recorder):
        scratch = next(run.parent.glob(f".{run.name}.stitch-*"))
        (scratch / "recording.rrd").write_text("half")
        raise error

    monkeypatch.setattr(pipeline, "change", fails)
    with pytest.raises(SystemExit) as stop:
        main(["drop", str(run), EFFECT, "--no-recording"])
    assert stop.value.code
    assert files(run) == before and not list(run.parent.glob(f".{run.name}.*"))


def test_of_what_was_suggested_the_run_that_stays_is_recorded_and_not_fitted_again(
    changing, monkeypatch, stitch_command
):
    """Two runs are tried and the first stays: recording, history and result speak of that one."""
    run, result = changing
    step, last = LedgerStep((), 0.1, 0.1, 0.1, np.eye(4)), LedgerStep((), 0.1, result.heldout_rms, 0.1, result.T_mount)
    fitted, told_of = replace(result, ledger=(step, last)), []

    def suggest(state, at_most, known, recorder):
        for number, tried in enumerate((fitted, replace(result, model=replace(result.model)))):
            recorder.start(tried.session)
            recorder.iteration("fit", number, result.poses, 0.1, np.nan)
            recorder.finish(tried)
        return replace(fitted, tried={"backlash": "idle"}), [], None

    def told_to(folder):
        own = SilentRecorder()
        own.iteration = lambda stage, index, *_: told_of.append((stage, index))
        own.finish = lambda run: told_of.append(run.tried)
        return [own]

    monkeypatch.setattr(pipeline, "change", None)
    monkeypatch.setattr(stepwise, "suggest", suggest)
    monkeypatch.setattr("stitch.output.run_folder.recordings", told_to)
    monkeypatch.setattr("stitch.cli.diagnose.write_diagnosis", lambda found, state, run: {})
    monkeypatch.setattr("stitch.output.plain_finding.next_step_line", lambda found, run: "")
    stitch_command("add", run, "--suggested")
    assert told_of == [("fit", 0), {"backlash": "idle"}]
    steps = json.loads((run / "ledger.json").read_text())
    assert len(steps) == len(fitted.ledger)
    assert steps[-1]["hand_eye"] == told(run)["hand_eye"] and steps[-1]["heldout_rms"] == told(run)["heldout_rms"]


def test_where_nothing_is_to_be_added_the_present_result_is_printed(changing, monkeypatch, stitch_command):
    run, result = changing
    monkeypatch.setattr(stepwise, "suggest", lambda *_: (None, [], None))
    monkeypatch.setattr("stitch.cli.diagnose.write_diagnosis", lambda found, state, run: {})
    assert json.loads(stitch_command("add", run, "--suggested", "--json")) == told(run)
    assert result.model.T_mount.tolist() == told(run)["hand_eye"]


def test_a_page_that_fails_leaves_the_old_one(changing, monkeypatch):
    run, result = changing
    before = files(run)
    write = type(run).write_text

    def breaks(path, text, **options):
        write(path, text[: len(text) // 2], **options)
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(type(run), "write_text", breaks)
        with pytest.raises(OSError, match="disk full"):
            run_page.write_report(result, run / "report.html")
    assert files(run) == before


def sees_points(folder):
    """Six labelled points on the flange, seen with 20 µm of noise."""
    loaded, rng = load_session(folder), np.random.default_rng(0)
    balls, rows = rng.normal(size=(6, 3)) * 50, ["view,target,x,y,z"]
    for view in loaded.views:
        T_scanner_flange = frames.inverse(loaded.scanner.T_mount) @ view.T_base_flange
        seen = frames.transform(T_scanner_flange, balls) + rng.normal(size=(6, 3)) * 0.02
        rows += [f"{view.name},ball{i},{x},{y},{z}" for i, (x, y, z) in enumerate(seen)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("kind", ["clouds", "points", "both"])
def test_residuals_with_gaps_in_the_times_and_covariates_named_like_columns(session, tmp_path, kind):
    if kind != "clouds":
        sees_points(session)
    if kind == "points":
        for row in (1, 2, 3):
            set_cell(session / "views.csv", row, "cloud", "")
    rows = (session / "views.csv").read_text().splitlines()
    more = ("time_s,residual,nx", "0,5,7", ",6,", "9,5,8")
    (session / "views.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(rows, more, strict=True)) + "\n")
    ended("run", session, "-o", tmp_path / "run", "--no-recording")
    table = read_table(tmp_path / "run" / "residuals.parquet")
    assert sorted(set(table.column_names)) == sorted(table.column_names)
    columns = {name: np.array(values) for name, values in table.to_pydict().items()}
    assert np.abs(columns["residual"]).max() < 4 and np.abs(columns["nx"]).max() <= 1
    assert ("ball0" in columns["partner"], "v001" in columns["partner"]) == (kind != "clouds", kind != "points")
    for view, *known in (("v000", 0, 5, 7), ("v001", np.nan, 6, np.nan)):
        own = columns["view"] == view
        for name, value in zip(("time_s", "covariate_residual", "covariate_nx"), known, strict=True):
            assert np.array_equal(np.unique(columns[name][own]), [value], equal_nan=True)


@pytest.fixture
def place(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "session.toml").touch()
    return tmp_path


def make_run(folder, session):
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps({"format": "stitch-run/1", "session": str(session)}))
    (folder / "model.toml").touch()
    return folder


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("s", "lies in the session"),
        ("s/runs/a", "lies in the session"),
        ("link", "lies in the session"),
        (".", "the session .* lies in it|one stands in"),
        ("own", "not a run folder"),
        ("other", "holds the run of .*force=True"),
        ("model", "not a run folder"),
        ("damaged", "not a run folder"),
    ],
)
def test_a_place_where_something_would_be_lost_is_refused(place, target, expected):
    (place / "link").symlink_to(place / "s")
    for name in ("own", "model", "damaged"):
        (place / name).mkdir()
    (place / "own" / "thesis.txt").touch()
    (place / "model" / "model.toml").touch()
    (place / "damaged" / "model.toml").touch()
    (place / "damaged" / "result.json").write_text("[" * 100_000)
    make_run(place / "other", place / "t")
    with pytest.raises(InputError, match=expected):
        require_free(place / target, [place / "s"], force=False)


def test_a_run_may_go_where_nothing_would_be_lost(place):
    (place / "empty").mkdir()
    make_run(place / "same", place / "s")
    make_run(place / "other", place / "t")
    for target in ("new", "empty", "same"):
        require_free(place / target, [place / "s"], force=False)
    require_free(place / "other", [place / "s"], force=True)


def test_of_a_rig_the_runs_inside_are_its_own(place):
    """The folder of one run may hold another run of the person's: that is none of its own."""
    rig, single = place / "rig", make_run(place / "single", place / "s")
    make_run(rig / "a", place / "a")
    make_run(rig / "b", place / "b")
    (rig / "model.toml").touch()
    make_run(single / "a", place / "a")
    assert sessions_in(rig) == [str(place / "a"), str(place / "b")]
    assert is_run_file(rig)(Path("a/result.json")) and not is_run_file(rig)(Path("a/notes.txt"))
    assert not is_run_file(single)(Path("a/result.json"))
    is_own = {
        name: is_run_file(single)(Path(name)) for name in ("result.json", "pictures/budget.png", "pictures/mine.png")
    }
    assert is_own == {"result.json": True, "pictures/budget.png": True, "pictures/mine.png": False}


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


EFFECTS_FILE = """
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
    (tmp_path / "sent.py").write_text(EFFECTS_FILE)
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
    own.write_text(EFFECTS_FILE.replace("of_a_stranger", "of_my_own").replace("executed", "mine"))
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
        EFFECTS_FILE.replace("of_a_stranger", "of_my_own").replace("return points", "return points * (1 + 1e-3 * k)")
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
