"""Live sessions: simulated knocks of the scanner, and five measured objects. Tables of docs/python.md.

`python -m bench.live [objects] [knocks] [--cells 20] [--seed 0] [--write]`. A cell is a blade of 14 views on an
ordinary arm. Before one view the scanner is knocked by 0.4 mm and 1 mrad in a direction drawn anew; the scans from
there on show it. Is the knock named at the first view after it? Also: false alarms before it, and processor seconds a
view.

RegHEC's objects, nine views each, whose hand-eye is searched: are arrays what the folder is, to the last bit; how far
does the end of view by view lie from the folder's run; what was said of the views, and in how many seconds.
"""

import argparse
import os
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from tests.api.same import taken

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "python.md"
SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
OBJECTS = ("david", "cone", "sphere", "rubik", "gripperopen")
VIEWS, KNOCK_MM, KNOCK_RAD = 14, 0.4, 1e-3
MOUNTS = ("eye_to_hand", "eye_in_hand")


def one_by_one(live: stitch.LiveSession, clouds, poses) -> list[float]:
    """Take the views in; return the processor time, s, of each that came after the first hand-eye."""
    seconds = []
    for cloud, T in zip(clouds, poses, strict=True):
        fitted, began = live.hand_eye is not None, time.process_time()
        live.add_view(cloud, T)
        seconds += [time.process_time() - began] if fitted else []
    return seconds


def knocked_cell(seed: int) -> dict[str, float]:
    """Return what one cell showed: views between knock and name, false alarms, seconds a view."""
    rng = np.random.default_rng(seed)
    mount = MOUNTS[seed % 2]
    measured = measured_blade(seed, views=VIEWS, mount=mount, pixels=120)
    knocked = int(rng.integers(6, 11))
    shift, turn = (
        size * v / np.linalg.norm(v) for size, v in ((KNOCK_MM, rng.normal(size=3)), (KNOCK_RAD, rng.normal(size=3)))
    )
    clouds = [cloud.points for cloud in measured.clouds]
    centre = np.mean([points.mean(axis=0) for points in clouds], axis=0)
    R = Rotation.from_rotvec(turn)
    clouds[knocked:] = [R.apply(points - centre) + centre + shift for points in clouds[knocked:]]
    live = stitch.live(mount=mount)
    seconds = one_by_one(live, clouds, measured.T_base_flange)
    wrong = [v for v, said in enumerate(live.said) if said.verdict == "does_not_belong"]
    named = next((v for v in wrong if v >= knocked), VIEWS)
    return {
        "late": named - knocked,
        "false": sum(v < knocked for v in wrong),
        "seconds": float(np.median(seconds)),
        "slowest": max(seconds),
    }


def knocks(seeds: range) -> str:
    """Return the table of the simulated cells."""
    found = []
    for seed in seeds:
        found.append(knocked_cell(seed))
        print(seed, found[-1], flush=True)
    late = np.array([own["late"] for own in found])
    median, slowest = np.median([own["seconds"] for own in found]), max(own["slowest"] for own in found)
    return "\n".join(
        [
            f"| {len(found)} cells of {VIEWS} views, seeds {seeds[0]} to {seeds[-1]} | |",
            "|---|---:|",
            f"| knock named at its first view | {np.sum(late == 0)} of {len(late)} |",
            f"| named there or at the next | {np.sum(late <= 1)} of {len(late)} |",
            f"| false alarms before it | {sum(own['false'] for own in found)} |",
            f"| processor seconds a view, median (slowest) | {median:.2f} ({slowest:.2f}) |",
        ]
    )


def difference(a: stitch.Run, b: stitch.Run) -> float:
    """Return the largest difference of two runs in hand-eye, covariance, poses and cloud; inf where sizes differ."""
    pairs = [(getattr(a, name), getattr(b, name)) for name in ("T_mount", "mount_covariance", "poses")]
    pairs.append((a.fused.points, b.fused.points))
    return max(float(np.abs(x - y).max()) if x.shape == y.shape else np.inf for x, y in pairs)


def objects(folder: Path) -> str:
    """Return the table of the measured objects."""
    lines = [
        "| object | arrays and folder | view by view and folder | said of the views | processor s a view (slowest) |"
    ]
    lines.append("|---|---|---|---|---:|")
    for name in OBJECTS:
        loaded = stitch.load_session(folder / name)
        given, from_folder = taken(loaded), stitch.run(loaded)
        from_arrays = stitch.run(stitch.Session.from_arrays(**given))
        live = stitch.live(mount=loaded.mount, scanner=loaded.scanner, robot=loaded.robot, name=loaded.name)
        seconds = one_by_one(live, given["clouds"].values(), given["poses"])
        said = Counter(own.verdict.replace("_", " ") for own in live.said)
        ends = [difference(run, from_folder) for run in (from_arrays, live.finish())]
        shown = ["same to the last bit" if end == 0 else f"{end:.1g}" for end in ends]
        lines.append(
            f"| {name} | {shown[0]} | {shown[1]} | {', '.join(f'{n} {verdict}' for verdict, n in said.items())} "
            f"| {np.median(seconds):.2f} ({max(seconds):.2f}) |"
        )
        print(lines[-1], *(f"  {own}" for own in live.said), sep="\n", flush=True)
    return "\n".join(lines)


def main() -> None:
    """Print the tables, and write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", default=["objects", "knocks"], help="both, unless named")
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/python.md")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.cells)
    for name in options.tables:
        table = objects(SHARED / "reghec") if name == "objects" else knocks(seeds)
        print(f"\n{table}")
        if options.write:
            before, rest = PAGE.read_text(encoding="utf-8").split(f"<!-- {name}: begin -->\n")
            _, after = rest.split(f"<!-- {name}: end -->")
            PAGE.write_text(f"{before}<!-- {name}: begin -->\n{table}\n<!-- {name}: end -->{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
