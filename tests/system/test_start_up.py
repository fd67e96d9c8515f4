"""What a command loads before it does anything: libraries that others need keep nobody waiting."""

import json
import subprocess
import sys

import pytest

DEAR = {"scipy.stats", "matplotlib", "rerun", "trimesh", "open3d", "dask", "cv2"}


@pytest.mark.parametrize(
    ("module", "also_without"),
    [("stitch", {"numpy"}), ("stitch.cli.main", {"numpy", "scipy"}), ("stitch.cli.run", set())],
)
def test_dear_libraries_are_loaded_when_they_are_needed(module, also_without):
    code = f"import json, sys; import {module}; print(json.dumps(list(sys.modules)))"
    loaded = set(json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout))
    assert not loaded & (DEAR | also_without)
