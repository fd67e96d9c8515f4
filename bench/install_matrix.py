"""The wheel in fresh environments outside the checkout: python bench/install_matrix.py PYTHON …

Every PYTHON is a path. A row each: whether a cell is run and diagnosed, MB, seconds; of the first also the small
install, it with NumPy 1.26, and one where an open3d is. Then each heavy package is taken out of the bare one in turn.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_HEAVY = (
    "rerun-sdk",
    "kiss-icp",
    "pyarrow",
    "matplotlib",
    "trimesh",
    "libigl",
    "jsonschema",
)
_CELL = ("synth", "blade", "--views", "6", "--seed", "3")
# What is there before, options of pip, and what comes with the small requirements.
_KINDS = {
    "bare": ((), (), ()),
    "small": ((), ("--no-deps",), ()),
    "small, NumPy 1.26 and OpenCV": ((), ("--no-deps",), ("numpy==1.26.*", "opencv-python-headless<4.12")),
    "open3d there": (("open3d",), (), ()),
}


def main() -> None:
    """Print the table, a row as it comes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pythons", nargs="+", type=Path)
    pythons = parser.parse_args().pythons
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        wheel = _wheel(folder)
        print("| environment | installed, s | MB | run, diagnosed | s |\n|---|---:|---:|---|---:|", flush=True)
        made = folder / "cell"
        subprocess.run([sys.executable, "-m", "stitch", *_CELL, made], cwd=ROOT, check=True, capture_output=True)
        kinds = [(python, "bare") for python in pythons]
        for number, (python, kind) in enumerate([*kinds, *((pythons[0], kind) for kind in list(_KINDS)[1:])]):
            print(_row(python, kind, folder / f"env{number}", wheel, made), flush=True)
            if number:
                shutil.rmtree(folder / f"env{number}")
        print("\n| without | the line |\n|---|---|", flush=True)
        for package in _HEAVY:
            print(f"| {package} | {_without(folder / 'env0', package, made)} |", flush=True)


def _wheel(folder: Path) -> Path:
    source = folder / "source"
    subprocess.run(["git", "clone", "-q", ROOT, source], check=True)
    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, source], check=True)
    return next(folder.glob("stitch_scans-*.whl"))


def _row(python: Path, kind: str, place: Path, wheel: Path, made: Path) -> str:
    """Return one environment's row."""
    version = subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    name = f"{version}, {kind}"
    subprocess.run([python, "-m", "venv", place], check=True)
    before, options, after = _KINDS[kind]
    pip = [place / "bin/pip", "install", "-q"]
    if before:
        subprocess.run([*pip, *before], check=True, capture_output=True)
    began = time.perf_counter()
    done = subprocess.run([*pip, *options, wheel], capture_output=True, text=True, check=False)
    if done.returncode:
        return f"| {name} | – | – | {_last(done.stderr)} | – |"
    if "--no-deps" in options:
        small = [place / "bin/stitch", "doctor", "--requirements", "small"]
        asked = subprocess.run(small, capture_output=True, text=True, check=False)
        lines = asked.stdout.split()
        subprocess.run([*pip, *after, *lines], check=True, capture_output=True)
    installed = time.perf_counter() - began
    megabytes = int(subprocess.run(["du", "-sm", place], capture_output=True, text=True, check=True).stdout.split()[0])
    began = time.perf_counter()
    for command in (("run", made, "-o", "found"), ("diagnose", "found")):
        ended = subprocess.run([place / "bin/stitch", *command], cwd=place, capture_output=True, text=True, check=False)
        if ended.returncode:
            return f"| {name} | {installed:.0f} | {megabytes} | {command[0]}: {_last(ended.stderr)} | – |"
    seconds = time.perf_counter() - began
    works = "yes"
    if "open3d" in before:
        works = f"yes; open3d {_open3d_after(place)}"
    return f"| {name} | {installed:.0f} | {megabytes} | {works} | {seconds:.0f} |"


def _open3d_after(place: Path) -> str:
    """Return whether an open3d that was there before is alive once this distribution has gone."""
    subprocess.run([place / "bin/pip", "-q", "uninstall", "-y", "stitch-scans"], check=True, capture_output=True)
    asked = "import open3d; print(open3d.__version__)"
    alive = subprocess.run([place / "bin/python", "-c", asked], capture_output=True, text=True, check=False)
    return f"{alive.stdout.strip()} works after `pip uninstall`" if not alive.returncode else _last(alive.stderr)


def _without(place: Path, package: str, made: Path) -> str:
    """Return the line that a run, its page and a diagnosis end with where one package is gone."""
    pip = [place / "bin/pip", "-q"]
    subprocess.run([*pip, "uninstall", "-y", package], check=True, capture_output=True)
    lines = []
    for command in (("run", made, "-o", "without", "--force"), ("diagnose", "without")):
        ended = subprocess.run([place / "bin/stitch", *command], cwd=place, capture_output=True, text=True, check=False)
        lines.append(_last(ended.stderr) if ended.returncode else "works")
    subprocess.run([*pip, "install", "--no-deps", package], check=True, capture_output=True)
    return f"run: {lines[0]}; diagnose: {lines[1]}"


def _last(text: str) -> str:
    return (text.strip().splitlines() or ["no word"])[-1].replace("|", "/")


if __name__ == "__main__":
    main()
