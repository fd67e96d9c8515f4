"""Live sessions: is a knock of the scanner named at the view after which it happened? Table for docs/python.md.

`python -m bench.live [--cells 20]`: each cell is a blade of 14 views on an ordinary arm. Before one view the scanner is
knocked by 0.4 mm and 1 mrad in a direction drawn anew; the scans from there on show it. Also: false alarms before it,
seconds a view, and whether the end is that of a batch run to the last bit.
"""

import argparse
import json

import numpy as np
from scipy.spatial.transform import Rotation

import stitch
from data_synth.fixtures.blade_cells import measured_blade

VIEWS, KNOCK_MM, KNOCK_RAD = 14, 0.4, 1e-3
MOUNTS = ("eye_to_hand", "eye_in_hand")


def cell(seed: int) -> dict[str, float]:
    """Return what one cell showed: views between knock and name, false alarms, seconds a view, difference to batch."""
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
    for points, T in zip(clouds, measured.T_base_flange, strict=True):
        live.add_view(points, T)
    wrong = [v for v, said in enumerate(live.said) if said.verdict == "does_not_belong"]
    named = next((v for v in wrong if v >= knocked), VIEWS)
    timed = [said.seconds for said in live.said if said.hand_eye is not None][1:]
    out = {"late": named - knocked, "false": sum(v < knocked for v in wrong)}
    out |= {"seconds": float(np.median(timed)), "slowest": max(timed)}
    if seed % 5 == 0:
        batch = stitch.Session.from_arrays(clouds, measured.T_base_flange, mount=mount)
        try:
            out["difference"] = float(np.abs(live.finish().T_mount - stitch.run(batch).T_mount).max())
        except stitch.StitchError as error:
            out["refused"] = str(error)[:100]
    return out


def main() -> None:
    """Run the cells and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found = []
    for seed in range(options.seed, options.seed + options.cells):
        found.append(cell(seed))
        print(seed, json.dumps(found[-1]), flush=True)
    late = np.array([own["late"] for own in found])
    print("\n| | |\n|---|---:|")
    print(f"| knock named at its first view | {np.sum(late == 0)} of {len(late)} |")
    print(f"| within one view | {np.sum(late <= 1)} of {len(late)} |")
    print(f"| false alarms before it | {sum(own['false'] for own in found)} |")
    print(f"| seconds a view, median | {np.median([own['seconds'] for own in found]):.2f} |")
    print(f"| slowest view | {max(own['slowest'] for own in found):.2f} |")


if __name__ == "__main__":
    main()
