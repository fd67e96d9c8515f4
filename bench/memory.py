"""Peak memory of a run from arrays, beside that of the same run from files plus 1.3 times the arrays.

`python -m bench.memory [--seed 0]`: five sessions of a blade, scanned from six places, each point many times over with
noise. A process of its own loads and runs each; its peak is that of its resident pages.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import stitch
from data_synth.fixtures.blade_cells import measured_blade

VIEWS = 6
# Points a view, type and shape of the arrays.
PAIRS = ((100_000, "f8", "points"), (300_000, "f8", "points"), (300_000, "f4", "points"), (300_000, "f8", "image"))
PAIRS += ((600_000, "f8", "points"),)
# VmHWM begins anew with the program; ru_maxrss would begin with what this process holds.
_RUN = """
import re, sys
from pathlib import Path
import numpy as np
import stitch
folder, arrays = sys.argv[1:]
if arrays:
    clouds = [np.load(file) for file in sorted(Path(arrays).glob("view*.npy"))]
    session = stitch.Session.from_arrays(clouds, np.load(f"{arrays}/poses.npy"), mount="eye_in_hand")
else:
    session = stitch.load_session(folder)
stitch.run(session)
print(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
"""


def peak(folder: Path, arrays: Path | str) -> float:
    """Return the peak memory of one process, MB."""
    done = subprocess.run([sys.executable, "-c", _RUN, folder, arrays], stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout) * 1024 / 1e6


def pair(folder: Path, seed: int, count: int, kind: str, shape: str) -> str:
    """Return the row of one session: both peaks, and how much of the arrays the difference is."""
    measured = measured_blade(seed, views=VIEWS, mount="eye_in_hand", pixels=60)
    rng, clouds = np.random.default_rng(seed), []
    for cloud in measured.clouds:
        points = np.resize(cloud.points, (count, 3))
        points = (points + rng.normal(scale=0.02, size=points.shape)).astype(kind)
        if shape == "image":
            points[::5] = np.nan
            points = points.reshape(-1, 1000, 3)
        clouds.append(points)
    poses, arrays = np.array(measured.T_base_flange), folder / "arrays"
    stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", check=False).save(folder / "session")
    arrays.mkdir()
    np.save(arrays / "poses.npy", poses)
    for i, points in enumerate(clouds):
        np.save(arrays / f"view{i}.npy", points)
    size = sum(points.nbytes for points in clouds) / 1e6
    from_files, from_arrays = peak(folder / "session", ""), peak(folder / "session", arrays)
    share = (from_arrays - from_files) / size
    return f"| {VIEWS} × {count:,} {kind} {shape} | {size:.0f} | {from_files:.0f} | {from_arrays:.0f} | {share:.2f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    seed = parser.parse_args().seed
    print("| session | arrays, MB | peak from files, MB | from arrays, MB | more, as a share of the arrays |")
    print("|---|---:|---:|---:|---:|")
    for number, (count, kind, shape) in enumerate(PAIRS):
        with tempfile.TemporaryDirectory() as folder:
            print(pair(Path(folder), seed + number, count, kind, shape), flush=True)


if __name__ == "__main__":
    main()
