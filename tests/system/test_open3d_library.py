"""Open3D is imported light, leaves the whole of it to whoever asks for that, and says what it lacks."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stitch.api.run import Stitched
from stitch.cli.main import main
from stitch.errors import InputError
from stitch.system import open3d_library
from tests.needs import needs_open3d

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
def test_a_command_says_what_is_missing_before_the_work(words, line, said, session, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([str(session) if word == "SESSION" else word for word in line])
    assert ended.value.code == 2 and f"stitch: {words}: {said}" in capsys.readouterr().err
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
