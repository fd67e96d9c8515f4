"""What a review knows of a run: undo and redo, commands, trust, one moment of a folder that changes, its diagnosis."""

import json
import re
import shutil
from pathlib import Path

import pytest

from stitch.errors import InputError
from viz.page_parts import unbroken
from viz.review import run_snapshot
from viz.review.residual_rows import read_rows
from viz.review.run_review import RunReview
from viz.review.run_snapshot import read_snapshot, told_diagnosis, undo_history


@pytest.fixture
def run(small_run, tmp_path):
    """A copy of one's own."""
    return Path(shutil.copytree(small_run, tmp_path / "r"))


@pytest.mark.parametrize(
    "steps, undo, redo",
    [
        ("", None, None),
        (" | a", "drop a", None),
        (" | a | ", None, "add a"),
        (" | a | a,b | a", "drop a", "add b"),
        (" | a | a,b | a | ", None, "add a"),
        (" | a |  | a", "drop a", None),
        # Another way forwards forgets the one that was left.
        (" | a |  | b", "drop b", None),
        ("a,b | b", "add a", None),
        (" | a,b", "drop a b", None),
        # Fitted again is no step; both ways at once is no single command.
        (" | a | a", "drop a", None),
        ("a | b", None, None),
    ],
)
def test_undo_and_redo_are_read_from_the_ledger(steps, undo, redo):
    ledger = [[name for name in step.strip().split(",") if name] for step in steps.split("|")]
    told = undo_history(ledger)
    as_words = {k: None if v is None else " ".join([v["command"], *v["effects"]]) for k, v in told.items()}
    assert as_words == {"undo": undo, "redo": redo}


def test_what_is_shown_is_what_the_files_say(run):
    found, result = read_snapshot(run), json.loads((run / "result.json").read_text())
    assert found.state["residual"] == pytest.approx(1e3 * result["residual_rms"])
    assert found.state["sentence"] == result["plain"] and not found.state["labelled"]
    page = (run / "report.html").read_text()
    assert unbroken(found.state["sentence"]) in page
    assert json.loads(found.part)["steps"][1]["mean"] == pytest.approx(found.state["steps"][1]["mean"])
    assert {t["name"] for t in found.state["comparison"]} >= {"view", "range", "place on the part"}


def test_doubts_stand_in_full_below_a_short_headline(run):
    file = run / "result.json"
    result = json.loads(file.read_text(encoding="utf-8"))
    doubt = "9% of what the scans show stands still before the scanner: a wall. State within, and run again."
    file.write_text(json.dumps(result | {"doubts": [doubt], "plain": f"{doubt} {result['plain']}"}), encoding="utf-8")
    state = read_snapshot(run).state
    assert state["sentence"].startswith("9% of what the scans show stands still before the scanner. ")
    assert state["sentence"].endswith(result["plain"]) and state["evidence"] == f"{doubt} {result['verdict']}"


def test_a_folder_that_is_rewritten_while_it_is_read_is_read_again(run, monkeypatch):
    """The result of one model beside the ledger of another is not shown."""
    read, calls = run_snapshot.read_documents, []

    def meanwhile(folder):
        documents = read(folder)
        if not calls:
            calls.append(1)
            other = json.loads((run / "result.json").read_text()) | {"residual_rms": 0.5}
            (run / "result.json").write_text(json.dumps(other))
        return documents

    monkeypatch.setattr(run_snapshot, "read_documents", meanwhile)
    assert read_snapshot(run).state["residual"] == pytest.approx(500.0)


@pytest.mark.parametrize(
    "name, text", [("diagnosis.json", "{"), ("compare.json", '{"tables": [{}]}'), ("result.json", "[]")]
)
def test_a_damaged_file_is_named(run, name, text):
    (run / name).write_text(text)
    with pytest.raises(InputError, match=re.escape(name)):
        read_snapshot(run)
    told = RunReview(run).state()
    assert name in told["problem"]


def test_damaged_residuals_are_named(run):
    (run / "residuals.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match=r"residuals\.parquet"):
        read_rows(run, json.loads((run / "result.json").read_text()), labelled=False)


def test_python_of_a_run_that_somebody_sent_waits_for_consent(run, tmp_path):
    file = tmp_path / "sent.py"
    file.write_text("raise SystemExit")
    model = run / "model.toml"
    model.write_text(f'effects_file = "{file}"\n' + model.read_text())
    review = RunReview(run)
    assert review.state()["trust"] == {"file": str(file), "text": "raise SystemExit"}
    assert "--trust" not in review.arguments("diagnose", {})
    review.trust = True
    assert review.state()["trust"] is None
    assert review.arguments("diagnose", {}) == ["diagnose", str(run), "--trust"]
    # When the effects have been taken out, what was allowed can still be put back.
    model.write_text(model.read_text().partition("\n")[2])
    assert review.arguments("diagnose", {}) == ["diagnose", str(run), "--effects-file", str(file)]


def test_what_a_page_asks_for_beside_single_effects_are_commands_too(run):
    review = RunReview(run)
    assert review.arguments("next", {}) == ["next", str(run)]
    assert review.arguments("explain", {}) == ["explain", str(run)]
    assert review.arguments("export", {}) == ["export", str(run), "--to", "ros"]
    assert review.arguments("group", {}) == ["add", str(run), "--group"]


def test_own_effects_stay_in_the_run_folder_and_go_with_every_command(run):
    review = RunReview(run)
    path = review.keep_own_effects("# mine\n")
    assert review.state()["own"] == "# mine\n"
    assert review.arguments("own", {}) == ["effects", "--effects-file", str(path)]
    assert review.arguments("own", {"diagnose": True}) == ["diagnose", str(run), "--effects-file", str(path)]
    # Until a command has read it well, the others do without.
    assert review.arguments("compare", {}) == ["compare", str(run)]
    review.use_own_effects()
    assert review.arguments("add", {"effects": ["a", "b"]}) == [
        "add", str(run), "a", "b", "--no-recording", "--effects-file", str(path)]  # fmt: skip
    assert review.arguments("note", {"text": "--step 0", "by": ""}) == ["note", str(run), "--", "--step 0"]
    (run / "recording.rrd").touch()
    assert "--no-recording" not in review.arguments("drop", {"effects": ["a"]})


EVIDENCE = "backlash is missing (b5 = 0.0004 rad)."


@pytest.mark.parametrize(
    "document, told",
    [
        ({"plain": "Missing in the model: backlash."}, ("Missing in the model: backlash.", EVIDENCE)),
        # Written before there was a sentence for everybody.
        ({}, (EVIDENCE, "")),
    ],
)
def test_no_sentence_stands_twice(document, told):
    found = told_diagnosis({"verdict": "missing_effect", "effects": ["backlash"], "sentence": EVIDENCE} | document, 1e3)
    assert (found["plain"], found["sentence"]) == told
