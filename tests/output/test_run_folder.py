"""Run folders through their commands: what is written agrees with itself, and nothing stale or half-made stays."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from pyarrow.parquet import read_table

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.edits import set_cell
from data_synth.write import write_session
from stitch.api import pipeline, stepwise
from stitch.api.pipeline import run_rig
from stitch.cli.main import main
from stitch.errors import NoResultError
from stitch.model.model_toml import read_model
from stitch.numerics import frames
from stitch.output.run_folder import restore_fit, write_with_page
from stitch.output.stored_run import diagnosed_state, load_run
from stitch.recorder import SilentRecorder
from stitch.run_data import LedgerStep
from stitch.session.reading.session_folder import load_session
from viz import run_page
from viz.page_parts import sections_of, with_sections

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


def test_a_model_that_was_edited_gets_no_page_of_another(folder, tmp_path, capsys):
    run = tmp_path / "r"
    run.mkdir()
    for name, data in files(folder / "r").items():
        (run / name).write_bytes(data)
    k = repr(told(run)["effects"][EFFECT]["k"]["value"])
    (run / "model.toml").write_text((run / "model.toml").read_text().replace(k, "1e-5"))
    with pytest.raises(SystemExit) as stop:
        main(["report", str(run)])
    line = capsys.readouterr().err.strip()
    assert stop.value.code == 2 and "\n" not in line and "model.toml: changed after the run" in line
    assert files(run)["report.html"] == files(folder / "r")["report.html"]


def test_a_diagnosis_of_this_very_model_is_not_made_anew(folder, tmp_path, monkeypatch, capsys, stitch_command):
    """The page keeps what it said, and nothing is added where it names nothing; of another state it is forgotten."""
    run, page = tmp_path / "r", tmp_path / "r" / "report.html"
    run.mkdir()
    for name, data in files(folder / "q").items():
        (run / name).write_bytes(data)
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
    run = tmp_path / "q"
    (run / "pictures").mkdir(parents=True)
    for name, data in files(folder / "q").items():
        (run / name).write_bytes(data)
    for name in (*STALE, "pictures/budget.png"):
        (run / name).write_text("of the old model")
    result = replace(load_run(run), ledger=())
    monkeypatch.setattr(pipeline, "change", lambda state, effects, recorder: result)
    return run, result


def test_nothing_of_the_old_model_stays_beside_the_new_one(changing, stitch_command):
    run, _ = changing
    stitch_command("drop", run, EFFECT, "--no-recording")
    assert {path.name for path in run.iterdir() if path.is_file()} == {
        "model.toml", "result.json", "ledger.json", "stitched.ply", "residuals.parquet", "report.html",
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

    def told_to(folder, recording, earlier):
        own = SilentRecorder()
        own.iteration = lambda stage, index, *_: told_of.append((stage, index))
        own.finish = lambda run: told_of.append(run.tried)
        return own

    monkeypatch.setattr(pipeline, "change", None)
    monkeypatch.setattr(stepwise, "suggest", suggest)
    monkeypatch.setattr("stitch.cli.change.recorder_for", told_to)
    monkeypatch.setattr("stitch.cli.diagnose.write_diagnosis", lambda found, state, run: {})
    monkeypatch.setattr("stitch.output.plain_finding.suggested_command", lambda found, run: "")
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
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "run"), "--no-recording"])
    assert not ended.value.code
    table = read_table(tmp_path / "run" / "residuals.parquet")
    assert sorted(set(table.column_names)) == sorted(table.column_names)
    columns = {name: np.array(values) for name, values in table.to_pydict().items()}
    assert np.abs(columns["residual"]).max() < 4 and np.abs(columns["nx"]).max() <= 1
    assert ("ball0" in columns["partner"], "v001" in columns["partner"]) == (kind != "clouds", kind != "points")
    for view, *known in (("v000", 0, 5, 7), ("v001", np.nan, 6, np.nan)):
        own = columns["view"] == view
        for name, value in zip(("time_s", "covariate_residual", "covariate_nx"), known, strict=True):
            assert np.array_equal(np.unique(columns[name][own]), [value], equal_nan=True)
