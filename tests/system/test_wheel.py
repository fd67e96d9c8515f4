"""A wheel that a stranger can install: built, installed into an environment of its own, run outside the checkout."""

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    # A build writes into its source, and packs what an earlier one left there.
    left_out = shutil.ignore_patterns(".*", "build", "*.egg-info", "__pycache__", "tests", "bench", "docs")
    source = shutil.copytree(ROOT, folder / "source", ignore=left_out)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, source]
    subprocess.run(pip, check=True, cwd=folder, capture_output=True)
    (built,) = folder.glob("stitch-*.whl")
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
