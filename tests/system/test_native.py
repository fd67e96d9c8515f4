"""Open3D with and without the system's libusb, each in a process of its own."""

import subprocess
import sys
import textwrap

import pytest


def run_python(code: str) -> str:
    """Standard output of a fresh interpreter; loading a library cannot be undone in this one."""
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_open3d_loads_and_computes():
    extent = run_python("""
        import numpy as np
        from stitch.system.native import load_open3d
        o3d = load_open3d()
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array([[0.0, 0, 0], [1, 2, 3]])))
        print(*cloud.get_axis_aligned_bounding_box().get_extent())
    """)
    assert extent == "1.0 2.0 3.0"


def test_importing_stitch_does_not_import_open3d():
    assert run_python("import sys, stitch.system.native, stitch.pipeline; print('open3d' in sys.modules)") == "False"


def test_second_call_gives_the_same_module():
    assert run_python("from stitch.system.native import load_open3d; print(load_open3d() is load_open3d())") == "True"


@pytest.mark.skipif(sys.platform != "linux", reason="reads which libraries are mapped from /proc")
def test_packaged_libusb_serves_where_the_system_has_none():
    mapped = run_python("""
        import ctypes
        real = ctypes.CDLL
        def bare(name, *args, **kwargs):
            if name == "libusb-1.0.so.0":
                raise OSError("as on a machine without libusb")
            return real(name, *args, **kwargs)
        ctypes.CDLL = bare
        from stitch.system.native import load_open3d
        load_open3d()
        print(*{line.split()[-1] for line in open("/proc/self/maps") if "libusb-1.0" in line}, sep="\\n")
    """)
    # One copy only: Open3D takes the library already loaded under that name.
    assert "libusb_package" in mapped
    assert len(mapped.splitlines()) == 1
