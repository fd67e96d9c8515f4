"""The code stays within budget.toml: its lines, and the functions that a run and a diagnosis enter.

The programs of the gallery: each is short, and does in an empty folder what its first line says.
"""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from bench.budget import BUDGET, code_lines, complaints
from tests.needs import needs_open3d

# Counted in a fresh process, where nothing is remembered and every thread is watched.
WALK = """
import sys, threading
from pathlib import Path
import stitch
import stitch.api.verbs, stitch.diagnosis.diagnose

root = str(Path(stitch.__file__).parent)
entered = set()

def watch(frame, event, _):
    code = frame.f_code
    if event == "call" and code.co_filename.startswith(root):
        # Functions and lambdas: no comprehensions, no bodies of modules and classes.
        if code.co_flags & 1 and code.co_name not in ("<listcomp>", "<setcomp>", "<dictcomp>", "<genexpr>"):
            entered.add((code.co_filename, code.co_qualname, code.co_firstlineno))

def count(work):
    entered.clear()
    threading.setprofile(watch)
    sys.setprofile(watch)
    result = work()
    sys.setprofile(None)
    threading.setprofile(None)
    print(len(entered), len({file for file, *_ in entered}))
    return result

session = stitch.load_session(sys.argv[1])
run = count(lambda: stitch.run(session))
count(lambda: stitch.diagnose(run))
"""
PROGRAMS = sorted((Path(__file__).parents[1] / "examples" / "python").glob("*.py"))
# What a program prints, and the file that it writes.
TOLD = {
    "feature_and_verify": ("The artefact passes", None),
    "live_loop": ("v008: does not belong", None),
    "open3d_in_and_out": ("T_flange_scanner", "stitched.ply"),
    "organised_clouds": ("T_flange_scanner", "stitched.glb"),
    "own_effect": ("", "error.png"),
    "twenty_sessions": ("cell-19", None),
}


def test_a_part_above_its_budget_and_a_budget_far_above_its_part_are_refused():
    assert complaints({"core": 90, "plugins": 50}, {"core": 90, "plugins": 51}) == []
    (over, loose) = complaints({"core": 91, "plugins": 40}, {"core": 90, "plugins": 51})
    assert "91" in over
    assert "lower its budget" in loose


def test_a_run_and_a_diagnosis_enter_no_more_functions_than_budgeted(tmp_path, stitch_command):
    stitch_command("synth", "blade", tmp_path / "s", "--views", "8", "--seed", "3")
    command = [sys.executable, "-c", WALK, str(tmp_path / "s")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]).stdout
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8"))
    for name, line in zip(("run", "diagnosis"), printed.splitlines(), strict=True):
        functions, files = map(int, line.split())
        assert functions <= budget[name]["functions"], name
        assert files <= budget[name]["files"], name


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.stem)
def test_a_program_is_short(program):
    assert code_lines(program) <= 14 and program.stem in TOLD


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.stem)
def test_a_program_does_what_it_says(program, tmp_path):
    if "open3d" in program.stem:
        needs_open3d()
    if "pandas" in program.read_text():
        pytest.importorskip("pandas")
    done = subprocess.run([sys.executable, program], cwd=tmp_path, capture_output=True, text=True, check=False)
    said, file = TOLD[program.stem]
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    assert file is None or (tmp_path / file).stat().st_size > 1000
