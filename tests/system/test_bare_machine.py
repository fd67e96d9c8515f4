"""What runs needs nothing of the system but Python: everything else comes with the packages."""

import subprocess
import sys
import textwrap

import pytest

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
        from stitch.fusion.fuse import fuse
        from stitch.fit.coarse import motion_candidates
        from stitch.output.mesh import mesh_of
        measured, capture = captured_blade(0, views=4, pixels=60)
        assert motion_candidates([capture])
        fused = fuse(capture, measured.T_reference_scanner)
        assert len(mesh_of(fused.points, fused.normals).triangles)
        found = cad.nearest_partners(cad.cad_surface(measured.mesh), fused.points, fused.normals)
        print(float(np.median(np.abs(found.distance))) < 0.1)
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
