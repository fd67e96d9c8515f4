"""The programs of the gallery: each is short, and does in an empty folder what its first line says."""

import subprocess
import sys
from pathlib import Path

import pytest

from bench.budget import code_lines
from tests.needs import needs_open3d

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
