"""The distribution has a name of its own; no message, page or error names another that is not among its packages.

Open3D is imported light, leaves the whole of it to whoever asks for that, and says what it lacks.
"""

import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import yaml

import stitch
from bench.docs.page_examples import refused
from bench.licences import brought, complaints, kind, licence
from stitch.api.run import Stitched
from stitch.errors import InputError
from stitch.system import open3d_library
from stitch.system.packages import (
    DISTRIBUTION,
    PACKAGES,
    SMALL,
    command_for,
    command_of,
    import_extra,
    missing_package,
    small_requirements,
    stitch_version,
    unless_missing,
)
from tests.command_line import ended
from tests.needs import needs_open3d

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
WRITTEN = [
    *(ROOT / name for name in ("Makefile", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "mkdocs.yml")),
    *(
        f
        for room in ("stitch", "viz", "data_synth", "bench", "tests", "docs", "examples")
        for f in (ROOT / room).rglob("*")
    ),
]
ONE_CLOUD_OF_BOTH = """
import sys
from stitch.system.open3d_library import import_open3d
light = import_open3d("a test")
assert import_open3d("a test") is light
assert "open3d" not in sys.modules and not {"dash", "plotly", "ipywidgets"} & set(sys.modules)
cloud = light.geometry.PointCloud()
import open3d
assert isinstance(cloud, open3d.geometry.PointCloud) and open3d.visualization
assert import_open3d("a test") is open3d
"""


def name_of(requirement):
    """The distribution that a requirement asks for."""
    return re.match(r"[\w.-]+", requirement)[0].lower()


def installed_by(text):
    """What commands of a text install, as they name it, and what they do it with."""
    for words in re.findall(r"\bpip install\s+((?:--?[\w-]+\s+)*)'?([\w.{}()-]+(?:\[[^\]]*\])?)", text):
        yield words[1]


def test_the_name_is_that_of_the_project():
    assert PROJECT["name"] == DISTRIBUTION
    assert stitch.__version__ == stitch_version() == PROJECT["version"]
    assert {entry.dist.name for entry in entry_points(group="stitch.commands") if entry.name == "watch"} == {
        DISTRIBUTION
    }


def test_no_text_names_a_distribution_that_is_neither_ours_nor_a_dependency():
    asked = {name_of(r) for requirements in (PROJECT["dependencies"], *EXTRAS.values()) for r in requirements}
    strangers = []
    for file in WRITTEN:
        if file.suffix not in (".py", ".md", ".ipynb", ".j2", ".js", ".toml", ".yml", "") or not file.is_file():
            continue
        text = file.read_text("utf-8")
        for name in installed_by(text):
            own, _, extra = name.partition("[")
            if own == DISTRIBUTION:
                assert extra.rstrip("]") in ("", *EXTRAS, "{extra}"), f"{file}: {name}"
            elif own not in asked and not own.startswith(("{", "-")):
                strangers.append(f"{file.relative_to(ROOT)}: {name}")
        assert not re.search(r"""\bversion\(["']stitch["']\)|['" ]stitch\[[a-z]""", text), file
    assert strangers == []


def test_a_missing_package_is_one_line_with_the_command():
    with pytest.raises(
        InputError, match=re.escape(f"a.las: needs the package no_such; to fix: {command_for('formats')}")
    ):
        import_extra("no_such", "a.las", "formats")


def test_papers_name_version_and_licence():
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"version: {PROJECT['version']}\n" in citation and f"license: {PROJECT['license']}\n" in citation


def test_nothing_of_gpl_comes_with_the_base():
    licences = {name: licence(metadata) for name, metadata in brought().items()}
    assert {"numpy", "scipy", "pykdtree"} < set(licences) and "plyfile" not in licences
    assert complaints(licences) == []
    assert [name for name, stated in licences.items() if kind(stated) == "LGPL"] == ["pykdtree"]


@pytest.mark.parametrize(
    ("stated", "is_kind"),
    [
        ("GPL-3.0-or-later", "GPL"),
        ("GNU Affero General Public License v3", "GPL"),
        ("GNU General Public License v2 (GPLv2)", "GPL"),
        ("GNU Lesser General Public License v3 (LGPLv3)", "LGPL"),
        ("LGPL-3.0-only", "LGPL"),
        ("MIT OR GPL-3.0-only", ""),
        ("BSD-3-Clause", ""),
    ],
)
def test_a_licence_is_of_a_kind(stated, is_kind):
    assert kind(stated) == is_kind
    assert bool(complaints({"some": stated})) == (is_kind == "GPL")


def test_a_package_that_states_no_licence_is_told():
    assert complaints({"some": ""}) == ["some: states no licence; look it up before it comes with the base"]


def test_all_packages_that_are_asked_for_are_listed_with_what_they_are_for():
    extras = {name: asked for name, asked in EXTRAS.items() if name not in ("dev", "docs")}
    asked = {name_of(r) for requirements in (PROJECT["dependencies"], *extras.values()) for r in requirements}
    assert set(PACKAGES) == asked - {"open3d-cpu", DISTRIBUTION}
    assert EXTRAS["all"] == [f"{DISTRIBUTION}[{','.join(name for name in extras if name not in ('all', 'open3d'))}]"]
    del extras["all"]
    for extra, requirements in extras.items():
        assert {command_of(name_of(r)) for r in requirements} <= {
            command_for(extra),
            "pip install open3d-cpu",
            command_for("open3d"),
        }


def test_the_image_is_made_by_the_commands_of_the_readme():
    command, environment = re.findall(
        r"^(make \w+|\. [\w./]+)(?: .*)?$", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE
    )[:2]
    image = (ROOT / "examples/fleet/Dockerfile").read_text("utf-8")
    assert f"\nRUN {command}" in image and f"PATH=/stitch/{environment[2:].removesuffix('/activate')}:" in image


def test_the_services_of_the_compose_file_are_commands_with_options_that_exist():
    pytest.importorskip("distributed")
    place = ROOT / "examples/fleet"
    services = yaml.safe_load((place / "compose.yaml").read_text("utf-8"))["services"]
    for service in services.values():
        build = service["build"]
        assert (place / build["context"] / build["dockerfile"]).is_file()
        if "command" in service:
            assert refused(shlex.join(["stitch", *service["command"]])) is None
        else:
            _, name, *options = service["entrypoint"]
            (command,) = entry_points(group="dask_cli", name=name)
            command.load().make_context(name, options)


def test_open3d_is_no_dependency_of_the_base():
    assert not [r for r in PROJECT["dependencies"] if r.startswith("open3d")]
    assert command_of("open3d") == command_for("open3d")


@pytest.mark.parametrize(
    ("module", "line"),
    [
        (
            "rerun",
            "needs rerun-sdk, which is not installed (the recording and its viewer); to fix: pip install 'rerun-sdk>=",
        ),
        ("cv2.aruco", "needs opencv-python-headless, which is not installed (boards in scans, lenses that distort, "),
    ],
)
def test_a_package_that_an_import_misses_is_one_line_of_the_command(module, line, monkeypatch):
    error = ModuleNotFoundError(f"No module named {module!r}", name=module)
    assert missing_package(error).startswith(line)

    def lacks():
        raise error

    monkeypatch.setattr("stitch.cli.main.build", lacks)
    told = ended("run", code=2)
    assert told.err.startswith(f"stitch: {line}")
    assert missing_package(ModuleNotFoundError("no", name="stitch.nothing")) is None


def without_packages(names, words, folder):
    """The end of a command in a process in which packages cannot be imported."""
    lacked = [PACKAGES[name][0] for name in names]
    code = f"import sys; sys.modules.update(dict.fromkeys({lacked})); from stitch.__main__ import main; main()"
    return subprocess.run(
        [sys.executable, "-P", "-c", code, *words], cwd=folder, capture_output=True, text=True, check=False
    )


def test_the_small_requirements_are_those_of_the_project_with_an_older_numpy():
    asked = {name_of(requirement): requirement for requirement in PROJECT["dependencies"]}
    assert small_requirements() == [{"numpy": "numpy>=1.26"}.get(name, asked[name]) for name in SMALL]
    lines = without_packages(["typer", "numpy"], ["doctor", "--requirements", "small"], ROOT).stdout
    assert lines.splitlines() == small_requirements()


def test_a_small_install_runs_diagnoses_and_exports_and_says_what_it_leaves_out(session, tmp_path):
    large = [name for name in PACKAGES if name not in SMALL]
    ran = without_packages(large, ["run", str(session), "-o", "run"], tmp_path)
    assert ran.returncode == 0 and "Hand-eye" in ran.stdout
    for name in ("rerun-sdk", "pyarrow", "jinja2"):
        assert f"Left out: it needs {name}, which is not installed" in ran.stderr
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"model.toml", "result.json", "stitched.ply"}
    for words in (["diagnose", "run"], ["export", "run", "--to", "ros"]):
        assert without_packages(large, words, tmp_path).returncode == 0
    page = without_packages(large, ["report", "run"], tmp_path)
    assert page.returncode == 2 and "pip install 'jinja2" in page.stderr


def test_without_the_packages_of_the_commands_one_line_says_what_to_install(tmp_path):
    ended = without_packages(["typer"], ["run"], tmp_path)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert "needs typer" in ended.stderr and all(f"'{line}'" in ended.stderr for line in small_requirements())


def test_what_is_left_out_is_a_package_that_is_known():
    with unless_missing():
        raise ModuleNotFoundError("no", name="rerun")
    with pytest.raises(ModuleNotFoundError), unless_missing():
        raise ModuleNotFoundError("no", name="stitch.nothing")


def test_other_threads_find_pandas_while_arrow_is_asked_for_none():
    pytest.importorskip("pandas")
    program = (
        "import importlib.util, sys, threading, pyarrow\n"
        "from stitch.system.packages import arrow_alone\n"
        "found, array = [], pyarrow.array\n"
        "def ask(values):\n"
        "    find = lambda: found.append(importlib.util.find_spec('pandas') is not None)\n"
        "    thread = threading.Thread(target=find)\n"
        "    thread.start()\n"
        "    thread.join()\n"
        "    return array(values)\n"
        "pyarrow.array = ask\n"
        "arrow_alone()\n"
        "print(found, 'pandas' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[True]", "False"]


def test_geometry_comes_without_windows_and_the_whole_of_it_later():
    needs_open3d()
    done = subprocess.run([sys.executable, "-c", ONE_CLOUD_OF_BOTH], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


class Absent:
    """A finder under which Open3D is not installed, or cannot load a library of the system."""

    def __init__(self, error):
        self.error = error

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "open3d":
            raise self.error


LACKS = {
    "the package": (
        ModuleNotFoundError("No module named 'open3d'"),
        "Open3D is not installed; to fix: pip install 'stitch-scans[open3d]'",
    ),
    "two libraries": (
        ImportError("libGL.so.1: cannot open shared object file"),
        "Open3D lacks libEGL.so.1, libGL.so.1 of the system; to fix: apt-get install libegl1 libgl1",
    ),
}


@pytest.fixture(params=LACKS)
def said(request, monkeypatch):
    """What is said where Open3D lacks something, and it does."""
    error, sentence = LACKS[request.param]
    if request.param != "the package" and sys.platform != "linux":
        pytest.skip("elsewhere its wheels bring what they need")
    for name in [name for name in sys.modules if name.split(".")[0] == "open3d"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Absent(error), *sys.meta_path])
    monkeypatch.setattr(open3d_library, "_loads", lambda library: library not in sentence)
    return sentence


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--mesh watertight", ["run", "SESSION", "-o", "run", "--mesh", "watertight"]),
        ("--mesh light", ["run", "SESSION", "-o", "run", "--mesh", "light"]),
        ("--with open3d", ["compare", "run", "--with", "open3d"]),
    ],
)
def test_a_command_says_what_is_missing_before_the_work(words, line, said, session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = ended(*[str(session) if word == "SESSION" else word for word in line], code=2)
    assert f"stitch: {words}: {said}" in told.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("tensor", [False, True])
def test_a_stitched_cloud_says_what_is_missing(tensor, said):
    cloud = Stitched(np.eye(3), np.eye(3), np.zeros(3), np.ones(3, int), "base", "mm")
    with pytest.raises(InputError) as refusal:
        cloud.to_open3d(tensor)
    assert str(refusal.value).startswith(f"to_open3d: {said}")
    assert len(cloud.to_trimesh().vertices) == 3


def test_no_other_file_imports_open3d():
    """So that every entrance says it: `import_open3d` is the only one."""
    root = Path(open3d_library.__file__).parents[2]
    files = [file for room in ("stitch", "viz") for file in (root / room).rglob("*.py")]
    assert not [f.name for f in files if re.search(r"^\s*(import|from) open3d", f.read_text("utf-8"), re.MULTILINE)]
