"""The wheel in fresh environments outside the checkout: python bench/install_matrix.py PYTHON …

Every PYTHON is a path. A row each: whether a cell is made, run and diagnosed, MB, seconds. Then, in the environment of
the first, each heavy package is taken away in turn, and the line that is printed without it.
"""

import argparse
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
    "scikit-fem",
    "manifold3d",
    "jsonschema",
)
_CELL = ("synth", "blade", "cell", "--views", "6", "--seed", "3")


def main() -> None:
    """Print the table, a row as it comes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pythons", nargs="+", type=Path)
    pythons = parser.parse_args().pythons
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        wheel = _wheel(folder)
        print(
            "| environment | installed, s | MB | made, run, diagnosed | run, s |\n|---|---:|---:|---|---:|", flush=True
        )
        for number, python in enumerate(pythons):
            place = folder / f"env{number}"
            print(_row(python, place, wheel), flush=True)
        print("\n| without | the line |\n|---|---|", flush=True)
        for package in _HEAVY:
            print(f"| {package} | {_without(folder / 'env0', package)} |", flush=True)


def _wheel(folder: Path) -> Path:
    source = folder / "source"
    subprocess.run(["git", "clone", "-q", ROOT, source], check=True)
    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, source], check=True)
    return next(folder.glob("stitch_scans-*.whl"))


def _row(python: Path, place: Path, wheel: Path) -> str:
    """Return one environment's row."""
    version = subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    began = time.perf_counter()
    subprocess.run([python, "-m", "venv", place], check=True)
    done = subprocess.run([place / "bin/pip", "install", "-q", wheel], capture_output=True, text=True, check=False)
    if done.returncode:
        return f"| {version}, bare | – | – | {_last(done.stderr)} | – |"
    installed = time.perf_counter() - began
    megabytes = int(subprocess.run(["du", "-sm", place], capture_output=True, text=True, check=True).stdout.split()[0])
    began = time.perf_counter()
    for command in (_CELL, ("run", "cell", "-o", "found"), ("diagnose", "found")):
        ended = subprocess.run([place / "bin/stitch", *command], cwd=place, capture_output=True, text=True, check=False)
        if ended.returncode:
            return f"| {version}, bare | {installed:.0f} | {megabytes} | {command[0]}: {_last(ended.stderr)} | – |"
    return f"| {version}, bare | {installed:.0f} | {megabytes} | yes | {time.perf_counter() - began:.0f} |"


def _without(place: Path, package: str) -> str:
    """Return the line that a run, its page and a diagnosis end with where one package is gone."""
    pip = [place / "bin/pip", "-q"]
    subprocess.run([*pip, "uninstall", "-y", package], check=True, capture_output=True)
    lines = []
    for command in (("run", "cell", "-o", "without", "--force"), ("diagnose", "without")):
        ended = subprocess.run([place / "bin/stitch", *command], cwd=place, capture_output=True, text=True, check=False)
        lines.append(_last(ended.stderr) if ended.returncode else "works")
    subprocess.run([*pip, "install", "--no-deps", package], check=True, capture_output=True)
    return f"run: {lines[0]}; diagnose: {lines[1]}"


def _last(text: str) -> str:
    return (text.strip().splitlines() or ["no word"])[-1].replace("|", "/")


if __name__ == "__main__":
    main()
