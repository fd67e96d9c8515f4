"""Open3D is imported light, leaves the whole of it to whoever asks for that, and says what it lacks."""

import subprocess
import sys

import pytest

from stitch.errors import InputError
from stitch.system import open3d_library
from stitch.system.open3d_library import import_open3d
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


def test_what_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"^--mesh light: Open3D is not installed; to fix: pip install open3d"):
        import_open3d("--mesh light")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere its wheels bring what they need")
def test_what_the_system_lacks_is_named_with_its_package(monkeypatch):
    absent = {"libof_nothing.so.1": "libof-nothing1", "libc.so.6": "libc6", "libnowhere.so.0": "libnowhere0"}
    monkeypatch.setattr(open3d_library, "_LIBRARIES", absent)
    monkeypatch.setattr(open3d_library, "_compiled_part", lambda: (_ for _ in ()).throw(ImportError("libof_nothing")))
    with pytest.raises(InputError) as refusal:
        import_open3d("compare")
    assert str(refusal.value) == (
        "compare: Open3D lacks libof_nothing.so.1, libnowhere.so.0 of the system; to fix: apt-get install "
        "libof-nothing1 libnowhere0"
    )
