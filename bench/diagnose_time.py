"""How long diagnosis takes and how much memory: a blade of 18 views × 200 000 points, then 10⁷ correspondences.

Run: python bench/diagnose_time.py [--points 200000] [--correspondences 10000000]

The first part times whole commands, reading the session and writing the page included. The second streams the
correspondences of that session through the sums of all effects of points; an N×K matrix would not fit.
"""

import argparse
import os
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from subprocess import DEVNULL, Popen

import numpy as np

from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.effects.contract import EFFECTS, missing_need
from stitch.model.forward import corrected_capture, moves_points
from stitch.model.model import term_of
from stitch.observations.surfaces.effect_columns import view_responses
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.output.stored_run import load_run
from stitch.system.threads import library_threads_off

# Points of a view of the blade scene with 280 × 280 rays.
_USUAL_RAYS, _USUAL_POINTS = 280, 15_840
_COMMAND = "from stitch.cli.main import main; main()"


def session(folder: Path, points: int) -> Path:
    """A blade with a hidden effect, about `points` a view."""
    scene = load_scene("blade")
    rays = round(_USUAL_RAYS * (points / _USUAL_POINTS) ** 0.5)
    scene = replace(scene, scanner=replace(scene.scanner, columns=rays, rows=rays))
    measured = simulate(scene, {"joint_compliance": 2.0}, seed=3)
    write_session(folder / "blade", measured, "blade")
    print(f"{len(measured.clouds)} views × {np.mean([len(c.points) for c in measured.clouds]):,.0f} points")
    return folder / "blade"


def command(*arguments: str) -> None:
    """One command as a process of its own: wall time and peak memory."""
    start = time.perf_counter()
    child = Popen([sys.executable, "-c", _COMMAND, *arguments], stderr=DEVNULL, stdout=DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - start
    print(
        f"stitch {arguments[0]:<10} {seconds:6.1f} s {usage.ru_maxrss / 1e6:6.2f} GB   exit {child.returncode}",
        flush=True,
    )
    if child.returncode:
        sys.exit(f"stitch {arguments[0]} failed")


def streamed(run: Path, correspondences: int) -> None:
    """The sums over many correspondences, in this process."""
    state = load_run(run)
    with library_threads_off():
        own = corrected_capture(state.measurement, state.model)
        poses = own.poses(state.model.T_mount)
        few = collect_overlaps(own, poses, state.gate, [sample_points(scan, 1000) for scan in own.scans])
        per_view = round(1000 * correspondences / few.gram.count.sum())
        many = collect_overlaps(own, poses, state.gate, [sample_points(scan, per_view) for scan in own.scans])
    before = _peak()
    library = [term_of(state.measurement, e) for e in EFFECTS.values() if not missing_need(state.measurement, e)]
    terms = [term for term in library if moves_points([term])]
    start = time.perf_counter()
    freed = UnconstrainedPoses(poses, np.zeros((len(poses), 6)), many)
    found = view_responses(state.measurement, state.model, terms, freed)
    count, columns = sum(len(m.residual) for m in many.matches), sum(r.columns.shape[1] for r in found)
    print(
        f"{count:,} correspondences × {columns} columns: {time.perf_counter() - start:.1f} s, peak {_peak():.2f} GB, "
        f"{before:.2f} GB before (a matrix of all would be {count * columns * 8e-9:.1f} GB more)"
    )


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--correspondences", type=int, default=10_000_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = session(Path(folder), given.points)
        run = Path(folder) / "run"
        command("run", str(place), "-o", str(run))
        command("diagnose", str(run))
        command("compare", str(run))
        streamed(run, given.correspondences)


if __name__ == "__main__":
    main()
