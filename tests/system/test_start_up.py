"""What a command loads before it does anything: libraries that others need keep nobody waiting."""

import json
import subprocess
import sys

import pytest

DEAR = {"scipy.stats", "matplotlib", "rerun", "trimesh", "open3d", "dask", "distributed", "cv2", "jsonschema"}
# What a command needs to say what it could do.
LIGHT = DEAR | {"numpy", "scipy", "pyarrow", "asyncio"}


def loaded(code):
    """Modules of a process that has run some code."""
    told = f"import json, sys\n{code}\nprint('modules', json.dumps(list(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", told], capture_output=True, check=False, text=True)
    assert not out.returncode, out.stderr
    return set(json.loads(out.stdout.rpartition("modules ")[2]))


@pytest.mark.parametrize(
    ("module", "also_without"),
    [("stitch", {"numpy"}), ("stitch.cli.main", LIGHT), ("stitch.cli.run", set())],
)
def test_dear_libraries_are_loaded_when_they_are_needed(module, also_without):
    assert not loaded(f"import {module}") & (DEAR | also_without)


def test_a_run_loads_nothing_of_the_diagnosis():
    """Nor of plug-ins, pictures and meshes: all that it needs from the first file to the page."""
    on_use = "from stitch.system.process import load_on_use; load_on_use('numpy.f2py', 'numpy.testing')\n"
    modules = loaded(f"{on_use}import stitch.cli.run, stitch.api.pipeline, stitch.output.run_folder, viz.run_page")
    assert {"stitch.fusion.register", "scipy.optimize", "numpy.f2py"} <= modules
    without = {"scipy.cluster", "scipy.interpolate", "scipy.ndimage", "yaml", "numpy.f2py.rules", "unittest"}
    assert not modules & (DEAR | without | {"stitch.diagnosis", "stitch.plugins"})
    asked = "import scipy.optimize, numpy; numpy.testing.assert_allclose(1, 1); numpy.f2py.run_main"
    assert {"numpy.f2py.rules", "unittest"} <= loaded(on_use + asked)


def test_a_run_from_arrays_loads_no_plug_in_but_the_search_of_a_convention():
    code = """
import numpy, stitch
from data_synth.fixtures.blade_cells import measured_blade
cell = measured_blade(0, views=4, mount="eye_in_hand", pixels=30)
clouds, poses = [cloud.points for cloud in cell.clouds], numpy.array(cell.T_base_flange)
stitch.run(stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", check=CHECK))
"""
    plug_ins = {name for name in loaded(code.replace("CHECK", "False")) if name.startswith("stitch.plugins")}
    assert not plug_ins
    searching = {name for name in loaded(code.replace("CHECK", "True")) if name.startswith("stitch.plugins.")}
    assert searching and all(name.startswith("stitch.plugins.intake") for name in searching)


def test_scans_are_read_and_prepared_while_scipy_is_loaded():
    assert "scipy" not in loaded("import stitch.session.reading.session_folder, stitch.session.capture")


@pytest.mark.parametrize("line", ["--version", "--help"])
def test_the_list_of_commands_loads_no_mathematics(line):
    code = f"from stitch.cli.main import main\ntry:\n    main({line.split()})\nexcept SystemExit:\n    pass"
    assert not loaded(code) & LIGHT


def test_no_command_s_help_loads_mathematics():
    """In one process, one after another: the first that loads something dear is named."""
    code = f"""
import sys
import typer
from stitch.cli.main import build

def helps(group, words=()):
    for name in group.commands:
        command = group.commands[name]
        yield " ".join((*words, name)), command.get_help(typer.Context(command, info_name=name))
        yield from helps(command, (*words, name)) if hasattr(command, "commands") else ()

told = 0
for name, text in helps(typer.main.get_command(build())):
    dear = {LIGHT!r} & set(sys.modules)
    assert not dear, f"stitch {{name}} --help loads {{sorted(dear)}}"
    told += "Examples:" in text
assert told > 25, told
"""
    assert not loaded(code) & LIGHT


def test_an_arm_without_meshes_needs_no_library_of_meshes():
    assert "trimesh" not in loaded("import viz.recording, viz.run_page")


def test_a_batch_on_one_process_needs_no_cluster():
    assert not loaded("import stitch.plugins.watch.batch.command") & {"distributed", "dask", "tornado", "asyncio"}


def test_page_recording_and_diagnosis_are_drawn_without_a_plotting_library():
    assert "matplotlib" not in loaded("import viz.recording, viz.run_page, viz.sections, viz.two_runs_page")
