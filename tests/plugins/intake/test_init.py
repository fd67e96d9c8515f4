"""stitch init at the command line: what it writes, asks and refuses."""

import json

import numpy as np
import pytest

from data_synth.fixtures.raw_folders import Convention, raw_folder
from stitch.cli.main import main
from stitch.session.reading.session_folder import load_session


@pytest.fixture
def raw(session, tmp_path):
    """Three views of a simulated cell as a raw folder."""
    return raw_folder(session, tmp_path / "raw", Convention())


def ended(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    printed = capsys.readouterr()
    return end.value.code or 0, printed.out, printed.err


STATED = (
    "--rotation",
    "xyz-extrinsic",
    "--angles",
    "rad",
    "--unit",
    "mm",
    "--cloud-unit",
    "mm",
    "--mount",
    "eye_to_hand",
)


def test_what_is_stated_is_taken(raw, session, tmp_path, capsys):
    code, out, err = ended(capsys, "init", raw, *STATED, "--no-inverse", "--yes", "--json", "-o", tmp_path / "made")
    assert code == 0, err
    document = json.loads(out)
    assert document["views"] == 3 and {g["what"] for g in document["guesses"]} >= {"rotation", "mount", "pairing"}
    assert all(g["because"] in ("file", "scans", "usual") for g in document["guesses"])
    (poses,) = [entry for entry in document["inventory"] if entry["taken_for"] == "poses"]
    assert poses["rows"] == 3 and document["question"] is None and document["not_used"] == []
    made, true = load_session(tmp_path / "made"), load_session(session)
    for a, b in zip(made.views, true.views, strict=True):
        assert abs(a.T_base_flange - b.T_base_flange).max() < 1e-3
    assert not (raw / "session.toml").exists()
    code, _, err = ended(capsys, "init", raw, *STATED, "--yes", "-o", tmp_path / "made")
    assert code == 2 and "exists already; to fix: replace it with --force" in err
    other = [*STATED[:-1], "eye_in_hand"]
    code, _, err = ended(capsys, "init", raw, *other, "--yes", "-o", tmp_path / "made", "--force")
    assert code == 0 and load_session(tmp_path / "made").mount == "eye_in_hand"
    comment = (tmp_path / "made" / "session.toml").read_text(encoding="utf-8")
    assert "--force, with the flag" in comment and "(--rotation" in " ".join(comment.split())


def second_table(raw):
    """Other poses beside those of the clouds."""
    (raw / "robot.txt").write_text((raw / "RobotPoses.dat").read_text().replace("0.", "0.1"))


def test_what_is_only_guessed_is_known_to_the_session_until_a_person_states_otherwise(raw, tmp_path, capsys):
    code, _, err = ended(capsys, "init", raw, *STATED, "--no-inverse", "--yes", "-o", tmp_path / "made")
    assert code == 0 and load_session(tmp_path / "made").usual == {}, err
    toml = tmp_path / "made" / "session.toml"
    guessed = "# ? cloud_unit: mm; scans are 150 long\n# ? rotation: xyz-extrinsic, radians; told by\n"
    toml.write_text(guessed + toml.read_text())
    assert load_session(tmp_path / "made").usual == {"cloud_unit": "mm", "rotation": "xyz-extrinsic"}
    toml.write_text(toml.read_text().replace('cloud_unit = "mm"', 'cloud_unit = "cm"'))
    assert load_session(tmp_path / "made", scans=False).usual == {"rotation": "xyz-extrinsic"}


def test_a_box_leaves_out_what_stands_still_before_the_scanner(raw, session, tmp_path, capsys):
    clouds = [view.cloud.points for view in load_session(session).views]
    low, high = (np.quantile(np.concatenate(clouds), share, axis=0) for share in (0.1, 0.9))
    box = f"--within={','.join(f'{x:.6f}' for x in (*low, *high))}"
    code, _, err = ended(capsys, "init", raw, *STATED, "--no-inverse", "--yes", box, "-o", tmp_path / "made")
    assert code == 0, err
    for view, points in zip(load_session(tmp_path / "made").views, clouds, strict=True):
        assert view.cloud.count == ((points > low) & (points < high)).all(axis=1).sum() < len(points)
    code, _, err = ended(capsys, "init", raw, "--within", "1,1,1,0,0,0")
    assert code == 2 and "the lowest and the highest corner" in err


@pytest.mark.slow
def test_poses_that_fit_no_scans_make_no_session(raw, capsys):
    table = raw / "RobotPoses.dat"
    table.write_text("".join(f"0.{i},0.3,-0.{i},100,200,{300 + i}\n" for i in range(3)))
    code, _, err = ended(capsys, "init", raw, "--yes")
    assert code == 2 and "no session was written" in err and "Next" not in err
    assert not (raw / "session.toml").exists()


@pytest.mark.slow
def test_without_a_terminal_what_cannot_be_told_is_asked_for_by_its_flag(raw, capsys):
    table = raw / "RobotPoses.dat"
    table.write_text("".join(f"0.{i},0.3,-0.{i},100,200,{300 + i}\n" for i in range(3)))
    code, _, err = ended(capsys, "init", raw)
    assert code == 2 and "--rotation" in err and "--mount" in err and "--yes" in err
    assert not (raw / "session.toml").exists() and not (raw / "views.csv").exists()


@pytest.mark.slow
def test_a_terminal_is_asked_what_cannot_be_told(raw, capsys, monkeypatch):
    table = raw / "RobotPoses.dat"
    table.write_text("".join(f"0.{i},0.3,-0.{i},100,200,{300 + i}\n" for i in range(3)))
    # A typing error costs a question, not the work so far.
    answers = iter(["zyx-intrinsik", "", "", "zyx-intrinsic", "", "eye_in_hand", "y"])
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    told = lambda text, err, default="": asked.append(text) or next(answers) or default  # noqa: E731
    monkeypatch.setattr("typer.prompt", told)
    monkeypatch.setattr("typer.confirm", lambda text, default, err: next(answers) == "y")
    code, _, err = ended(capsys, "init", raw)
    assert code == 0, err
    first = ["rotation", "length_unit", "mount"]
    assert [text.split()[0] for text in asked] == [*first, "--rotation", *first[1:]]
    assert "--rotation zyx-intrinsik" in err
    text = (raw / "session.toml").read_text(encoding="utf-8")
    assert "zyx-intrinsic" in text and 'mount = "eye_in_hand"' in text


def test_a_terminal_is_asked_one_question_in_place_of_a_refusal(raw, capsys, monkeypatch):
    """Eight columns of which two are something else: they are shown, numbered, and named by an answer."""
    table = raw / "RobotPoses.dat"
    table.write_text("".join(f"{i}.5,7.25,{row}\n" for i, row in enumerate(table.read_text().splitlines())))
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.prompt", lambda text, err: asked.append(text) or "-,-,rx,ry,rz,x,y,z")
    monkeypatch.setattr("typer.confirm", lambda text, default, err: True)
    code, _, err = ended(capsys, "init", raw, *STATED, "--no-inverse")
    assert code == 0 and asked == ["--columns"], err
    assert "hold no pose that is known" in err and any(line.split()[:3] == ["1", "2", "3"] for line in err.splitlines())
    assert load_session(raw).views


@pytest.mark.parametrize(
    ("spoil", "arguments", "told"),
    [
        (lambda raw: (raw / "session.toml").write_text(""), (), "exists already"),
        (lambda raw: (raw / "RobotPoses.dat").unlink(), (), "--poses"),
        (lambda raw: [f.unlink() for f in raw.glob("*.ply")], (), "no clouds there, only 1 .dat"),
        (lambda raw: [f.rename(f.with_suffix(".zip")) for f in raw.glob("*.ply")], (), "unpack it"),
        (second_table, (), "several lists"),
        (lambda raw: None, ("--rotation", "zyx"), "--rotation zyx: to fix: use xyz-intrinsic"),
        (lambda raw: None, ("--columns", "x,y,z"), "3 names"),
        (lambda raw: None, ("--columns", "x,x,z,rx,ry,rz"), "x stands twice"),
        (lambda raw: None, ("--poses", "nowhere.csv"), "nowhere.csv: no such file"),
        (lambda raw: (raw / "RobotPoses.dat").write_text("1,2,3,4,5,6\n" * 9), (), "3 clouds and 9 poses"),
    ],
)
def test_what_cannot_be_a_session_is_refused_in_one_line(raw, capsys, spoil, arguments, told):
    spoil(raw)
    code, out, err = ended(capsys, "init", raw, "--yes", *arguments)
    assert code == 2 and told in err and not out
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err


@pytest.mark.parametrize("arguments", [(), ("--rows", "1-2")])
def test_a_question_is_asked_in_the_json_with_what_is_known_by_then(raw, capsys, arguments):
    """Without --yes nobody guesses: what cannot be told is the question, and nothing is written."""
    code, out, err = ended(capsys, "init", raw, "--json", *arguments)
    told = json.loads(out)
    assert code == 2 and "stitch:" in err and not (raw / "session.toml").exists()
    assert {"guesses", "inventory", "not_used", "question"} <= set(told)
    assert set(told["question"]) >= {"what", "options"}
    assert [set(row) for row in told["inventory"]] == [{"file", "list", "rows", "columns", "taken_for", "why_not"}]
    assert bool(told["guesses"]) is not arguments
