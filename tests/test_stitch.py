"""What `import stitch` offers, what it loads before it does anything, and that a wheel runs where nothing else is installed.

Errors speak the caller's language: what to type, and what to write in a program.
"""

import ast
import inspect
import json
import pickle
import re
import shutil
import subprocess
import sys
import sysconfig
import textwrap
import tomllib
import venv
from concurrent.futures import ProcessPoolExecutor
from contextlib import chdir
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from functools import cache, cached_property
from importlib import import_module, util
from multiprocessing import get_context
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.fixtures.sphere_scans import sphere_cell, write_spheres
from stitch.diagnosis.diagnosis import Proposal
from stitch.diagnosis.unmodelled_time_effects import TimeCurve
from stitch.errors import InputError, NoResultError, did_you_mean
from stitch.model.axis_places import AxisPlace
from stitch.observations.scanner_places import ScannerAlone, ScannerPlace
from stitch.observations.targets.outliers import Outlier
from stitch.output.json_file import to_json
from stitch.plugins.metrology.planning.plan import Plan
from stitch.plugins.watch.report import Change
from stitch.system.values import Value
from tests.api.test_api import HELD
from tests.command_line import ended

# How the docstring of a function begins.
VERBS = {"Compute", "Find", "Fit", "Read", "Return", "Stitch", "Write"}


def imported_for_type_checkers():
    """Names and modules of the package's stub, names exported by `as` alone."""
    tree = ast.parse(Path(stitch.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {(alias.asname, node.module) for node in imports for alias in node.names if alias.asname == alias.name}


@pytest.mark.parametrize("name", stitch.__all__)
def test_every_public_name_resolves_in_its_module(name):
    module = import_module(stitch.MODULES[name])
    assert getattr(stitch, name) is getattr(module, name)
    # Where it is written, and not a module that happens to import it.
    assert getattr(stitch, name).__module__ == module.__name__


def test_one_table_gives_the_names_the_directory_and_the_types():
    assert stitch.__all__ == sorted(stitch.MODULES)
    assert set(stitch.__all__) <= set(dir(stitch))
    assert imported_for_type_checkers() == set(stitch.MODULES.items())
    assert all(util.find_spec(module) for module in stitch.MODULES.values())


def test_the_version_is_that_of_the_project():
    project = tomllib.loads((Path(stitch.__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    assert stitch.__version__ == project["project"]["version"] and "__version__" in dir(stitch)


def test_another_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'stitch' has no attribute 'stich'"):
        stitch.stich  # noqa: B018


@pytest.mark.parametrize("name", stitch.__all__)
def test_every_public_name_says_what_it_returns_or_is(name):
    public = getattr(stitch, name)
    first, *_ = inspect.getdoc(public).split(maxsplit=1)
    if inspect.isclass(public):
        # What dataclass writes where nobody does begins with the name and its arguments.
        assert not public.__doc__.startswith(f"{name}(")
        assert re.fullmatch(r"[A-Z]\w+,?", first) and first not in {"What", "How", "Everything", "Whether"}
    else:
        assert first in VERBS


def test_the_package_alone_is_imported_at_once():
    """In seconds of the processor: other processes may be at work."""
    code = "import time; began = time.process_time(); import stitch; print(time.process_time() - began)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert float(run.stdout) <= 0.15


@pytest.fixture(scope="module")
def small_library(library_of):
    """Few effects: what is tested is what holds them."""
    with library_of(("joint_offset", "joint_compliance", "backlash", "range_scale")):
        yield


@pytest.mark.usefixtures("small_library")
def test_the_example_of_the_package_runs(tmp_path, capsys):
    code = stitch.__doc__.split("\n", 1)[1]
    cell = measured_blade(0, views=6, mount="eye_in_hand", pixels=50)
    names = {"clouds": [cloud.points for cloud in cell.clouds], "poses": np.array(cell.T_base_flange)}
    with chdir(tmp_path):
        exec(compile(code, "the docstring of stitch", "exec"), names)
    assert capsys.readouterr().out.strip()
    assert names["run"].effects == ["range_scale"]
    assert (tmp_path / "runs" / "blade-17" / "result.json").is_file()
    assert stitch.drop(names["run"], "range_scale").effects == []


DEAR = {"scipy.stats", "matplotlib", "rerun", "trimesh", "open3d", "dask", "distributed", "cv2", "jsonschema"}


# What a command needs to say what it could do.
LIGHT = DEAR | {"numpy", "scipy", "pyarrow", "asyncio"}


@cache
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


CLEARED = """
import resource
from threading import Thread
import numpy as np
from stitch.system import process
{first}

def work():
    for _ in range(200):
        np.ones(500_000)

work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(2):
    thread = Thread(target=work)
    thread.start()
    thread.join()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
def test_memory_that_was_freed_is_not_cleared_again():
    """Two threads, each with an array of 4 MB, a thousand pages, made and freed 200 times."""

    def cleared(first):
        out = subprocess.run([sys.executable, "-c", CLEARED.format(first=first)], capture_output=True, check=True)
        return int(out.stdout)

    assert cleared("process.keep_freed_memory()") < 3_000 < cleared("process.return_large_arrays()") / 10


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
stitch.run(stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", check=False))
early = [name for name in sys.modules if name.startswith("stitch.plugins")]
assert not early, early
stitch.run(stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", check=True))
"""
    searching = {name for name in loaded(code) if name.startswith("stitch.plugins.")}
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


PICTURES = "import viz.recording, viz.run_page, viz.sections, viz.two_runs_page"


def test_an_arm_without_meshes_needs_no_library_of_meshes():
    assert "trimesh" not in loaded(PICTURES)


def test_a_batch_on_one_process_needs_no_cluster():
    assert not loaded("import stitch.plugins.watch.batch.command") & {"distributed", "dask", "tornado", "asyncio"}


def test_page_recording_and_diagnosis_are_drawn_without_a_plotting_library():
    assert "matplotlib" not in loaded(PICTURES)


# What displays, cameras and their drivers bring to a machine, and a bare one lacks.
STRIPPED = """
    import ctypes
    import sys
    real = ctypes.CDLL.__init__
    def stripped(self, name, *args, **kwargs):
        if any(lacking in str(name) for lacking in ("libusb", "libEGL", "libGL", "libX11")):
            raise OSError(f"{name}: as on a bare machine")
        real(self, name, *args, **kwargs)
    ctypes.CDLL.__init__ = stripped
    sys.modules["open3d"] = None
"""


# Parts of every Debian: the C library's and the compiler's. Pillow looks for fribidi and does without.
C_LIBRARY = ("libm.so", "librt.so", "libdl.so", "libpthread.so", "libutil.so")


ALWAYS = (*C_LIBRARY, "libstdc++.so", "libgcc_s.so", "libfribidi.so")


def run_python(code: str) -> str:
    """Standard output of a fresh interpreter; loading a library cannot be undone in this one."""
    code = textwrap.dedent(STRIPPED) + textwrap.dedent(code)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_scan_motions_mesh_and_cad_in_a_stripped_environment():
    said = run_python("""
        import numpy as np
        from data_synth.fixtures.blade_cells import captured_blade
        from stitch.plugins.cells import cad, scan_to_cad
        from stitch.fusion.fuse import fuse_points, place_scans
        from stitch.fit.coarse import motion_candidates
        from stitch.output.mesh import mesh_of
        measured, capture = captured_blade(0, views=4, pixels=60)
        assert motion_candidates([capture])
        placed = place_scans(capture.scans, measured.T_reference_scanner)
        fused = fuse_points(placed, capture.spacing, np.eye(4))
        assert len(mesh_of(fused.points, fused.normals).triangles)
        distance, _, _ = cad.nearest_partners(cad.cad_surface(measured.mesh), fused.points, fused.normals)
        print(float(np.median(np.abs(distance))) < 0.1)
    """)
    assert said == "True"


@pytest.mark.skipif(sys.platform != "linux", reason="reads which libraries are mapped from /proc")
def test_every_library_comes_with_python_or_a_package():
    mapped = """
        def mapped():
            paths = {line.split()[-1] for line in open("/proc/self/maps") if ".so" in line}
            return {path.rsplit("/", 1)[1] for path in paths if "site-packages" not in path and "lib-dynload" not in path}
    """
    everything = """
        import importlib, pkgutil
        # Python's own modules may load the system's ssl, sqlite and the like, which a Python always has.
        import bz2, ctypes, lzma, readline, sqlite3, ssl, uuid, zlib, pyexpat
        before = mapped()
        import data_synth, stitch, viz
        for package in (stitch, data_synth, viz):
            for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
                importlib.import_module(module.name)
        import embreex.rtcore_scene, kiss_icp.registration, manifold3d, matplotlib.pyplot, pyarrow.parquet, rerun
        print(*sorted(mapped() - before))
    """
    beyond = run_python(textwrap.dedent(mapped) + textwrap.dedent(everything)).split()
    assert [name for name in beyond if not name.startswith(ALWAYS)] == []


ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    # A build writes into its source, and packs what an earlier one left there.
    left_out = shutil.ignore_patterns(".*", "build", "*.egg-info", "__pycache__", "tests", "bench", "docs")
    source = shutil.copytree(ROOT, folder / "source", ignore=left_out)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, source]
    subprocess.run(pip, check=True, cwd=folder, capture_output=True)
    (built,) = folder.glob("stitch_scans-*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """The bin folder of an environment with the wheel; what it depends on is that of this environment."""
    folder = tmp_path_factory.mktemp("environment") / "venv"
    venv.create(folder, with_pip=False)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    python = folder / "bin" / "python"
    pip = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--force-reinstall", wheel]
    subprocess.run(pip, check=True, cwd=folder, capture_output=True)
    return folder / "bin"


@pytest.mark.slow
def test_the_wheel_holds_data_types_and_licence(wheel):
    names = set(ZipFile(wheel).namelist())
    assert {"stitch/py.typed", "stitch/__main__.py", "data_synth/scenes/blade.toml"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    for room in ("stitch", "viz", "data_synth"):
        tracked = {p.relative_to(ROOT).as_posix() for p in (ROOT / room).rglob("*") if p.is_file()}
        assert {name for name in tracked if "__pycache__" not in name} <= names


@pytest.mark.slow
def test_the_installed_program_runs_outside_the_checkout(environment, tmp_path):
    def run(*arguments):
        return subprocess.run(arguments, cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    place = run(environment / "python", "-c", "import stitch; print(stitch.__file__)")
    assert place.startswith(str(environment.parent))
    version = run(environment / "python", "-m", "stitch", "--version")
    assert version == run(environment / "stitch", "--version")
    run(environment / "stitch", "synth", "blade", "cell", "--views", "6", "--seed", "3")
    run(environment / "stitch", "run", "cell", "-o", "found")
    assert {"result.json", "report.html", "recording.rrd"} <= {p.name for p in (tmp_path / "found").iterdir()}


def same_values(one, other, met=()):
    """True where two objects hold the same, whatever they are made of; trees are no part of what is held."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
    if isinstance(one, dict):
        return list(one) == list(other) and all(same_values(one[key], other[key], met) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(same_values(*pair, met) for pair in zip(one, other, strict=True))
    if hasattr(one, "__dict__") and not isinstance(one, type) and not callable(one):
        if id(one) in met:  # it holds itself
            return True
        held = [{key: value for key, value in vars(each).items() if key != "tree"} for each in (one, other)]
        return same_values(*held, (*met, id(one)))
    return one == other or (one != one and other != other)


def members_of(value, depth=3):
    """What a value holds in fields and properties, some levels down."""
    if isinstance(value, (list, tuple)):
        inner = value[:2]
    elif isinstance(value, dict):
        inner = list(value.values())[:2]
    elif type(value) in HELD and is_dataclass(value):
        kind = type(value)
        own = [n for n in dir(kind) if isinstance(inspect.getattr_static(kind, n), property | cached_property)]
        inner = [getattr(value, name) for name in {*own, *(f.name for f in fields(value))}]
    else:
        inner = []
    yield value
    for other in inner if depth else ():
        yield from members_of(other, depth - 1)


@pytest.fixture(scope="module")
def values(tmp_path_factory, small_library):
    """An object of every class that public names hand out, by its name: those that others hold are found there."""
    folder = tmp_path_factory.mktemp("values")
    cell = measured_blade(0, views=5, mount="eye_in_hand", pixels=30)
    clouds, poses = [cloud.points for cloud in cell.clouds], np.array(cell.T_base_flange)
    session = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", check=False)
    batch = stitch.batch([session])
    run = batch.runs[0]
    place = len(run.stitched) // 2
    at, axis = run.stitched.points[place], run.stitched.normals[place]
    patch = stitch.Feature("patch", "plane", at=at, axis=axis, calibrated=0.0, calibrated_U=0.1)
    moved = tuple(replace(v, cloud=replace(v.cloud, points=v.cloud.points + 1e-6)) for v in session.views)
    balls = stitch.load_session(write_spheres(sphere_cell(3, "area"), folder / "ball"), at_most=None)
    live = stitch.live(mount="eye_in_hand")
    said = [live.add_view(cloud, pose) for cloud, pose in zip(clouds, poses, strict=True)]
    arm = stitch.run(stitch.load_session(write_labelled(folder / "arm", labelled_cell(2, views=8)[0], "points")))
    made = [
        *(kind("no") for kind in (stitch.StitchError, stitch.InputError, stitch.NoResultError)),
        *(session, batch, patch, stitch.check(session), stitch.diagnose(run), stitch.compare(run), stitch.explain(run)),
        *(stitch.measure(run, [patch]), stitch.verify(run, replace(session, views=moved), [patch])),
        *(
            stitch.watch(folder / "cell", [run.save(folder / "run", recording=False)]),
            stitch.read_model(folder / "run"),
        ),
        *(stitch.calibrate(balls, "sphere"), arm, said, live.next_pose(), Proposal("do", ("a", "b"))),
        *(Outlier(0, "a", 1.0, 2.0), Change(0, 1, 2, "step", None, 1.0, 0.1, 0.01, "mean")),
        Plan(session, (), None, None, (), None),
        AxisPlace("turn", "rotary", np.eye(3)[2], np.zeros(3), np.zeros(3), np.zeros(3)),
        ScannerPlace("left", np.eye(4), np.eye(6), 0.1, ScannerAlone("left", np.eye(4), np.eye(6))),
        stitch.add(run, "range_scale").model,
        TimeCurve(**{f.name: np.arange(3.0) if "Array" in str(f.type) else 1.0 for f in fields(TimeCurve)}),
    ]
    return {type(value).__name__: value for top in reversed(made) for value in reversed(list(members_of(top)))} | {
        "Table": run.residuals
    }


# Views of a session that grows, with its threads and its recording: no value. The table is pyarrow's.
NO_VALUES = {"LiveSession"}


def test_every_public_class_is_a_value_that_a_process_hands_back(values):
    public = {kind.__name__ for kind in HELD} | {
        name for name in stitch.__all__ if inspect.isclass(getattr(stitch, name))
    }
    assert public - NO_VALUES <= values.keys()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for name in sorted(public - NO_VALUES):
            value = values[name]
            came = pool.submit(deepcopy, value).result()
            assert type(came) is type(value) and str(came) == str(value), name
            if not isinstance(value, Exception):
                assert same_values(came, value), name
                assert came == value == deepcopy(value) and hash(came) == hash(value), name


def test_every_value_is_plain_data(values):
    for name, value in values.items():
        if isinstance(value, Value):
            assert json.loads(to_json(value.to_dict())), name


def test_a_value_with_one_other_number_is_another(values):
    for name, value in values.items():
        if isinstance(value, Value):
            own = {f.name: getattr(value, f.name) for f in fields(value) if f.compare and f.init}
            number = next(
                (n for n, x in own.items() if type(x) is float or (isinstance(x, np.ndarray) and x.size)), None
            )
            if number is not None:
                assert replace(value, **{number: np.add(own[number], 1).astype(float)}) != value, name


def test_a_run_that_came_from_another_process_goes_on(values):
    came = pickle.loads(pickle.dumps(values["Run"]))
    assert all("tree" not in vars(scan) for scan in came.measurement.capture.scans)
    assert str(stitch.diagnose(came).sentence) == values["Diagnosis"].sentence
    assert stitch.compare(came) == values["ResidualTables"]


def test_one_fix_in_the_message_serves_both_callers():
    error = InputError("views.csv line 3: no scan v7.ply; to fix: add it")
    assert str(error) == error.command_line == "views.csv line 3: no scan v7.ply; to fix: add it"
    assert error.what == "views.csv line 3: no scan v7.ply"
    assert error.fix_cli == error.fix_python == "add it"


def test_two_fixes_are_told_to_their_callers_alone():
    error = NoResultError("hand-eye: not seen", fix_cli="state --hand-eye RUN", fix_python="pass model=run")
    assert str(error) == "hand-eye: not seen; to fix: pass model=run"
    assert error.command_line == "hand-eye: not seen; to fix: state --hand-eye RUN"


def test_a_message_without_a_fix_is_only_itself():
    assert str(InputError("nothing")) == InputError("nothing").command_line == "nothing"


def test_what_an_error_says_survives_a_process_pool():
    error = InputError("a", fix_cli="b", fix_python="c")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.command_line, vars(again)) == (str(error), error.command_line, vars(error))


@pytest.mark.parametrize(
    ("written", "meant"),
    [("rangescale", "range_scale"), ("Range-Scale", "range_scale"), ("range_scal", "range_scale")],
)
def test_a_name_that_is_nearly_right_is_named(written, meant):
    assert did_you_mean(written, ["joint_offsets", "range_scale"]) == f"; did you mean {meant!r}?"


def test_a_name_that_is_like_none_suggests_none():
    assert did_you_mean("xyz", ["joint_offsets", "range_scale"]) == ""


def test_the_command_line_prints_the_fix_to_type(monkeypatch):
    def fails(*_):
        raise InputError("there already", fix_cli="state --force", fix_python="pass force=True")

    monkeypatch.setattr("stitch.cli.main.build", lambda: fails)
    told = ended(code=2)
    assert told.err.strip() == "stitch: there already; to fix: state --force"
