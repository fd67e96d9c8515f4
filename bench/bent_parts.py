"""What a scanner without smooth errors is charged with where its part bends. A table of docs/method.md.

Run: python bench/bent_parts.py [--cells 5] [--first-seed 60]

Cells hold nothing but the scanner's noise and the robot's scatter; views lie where they truly are, and are freed by
their overlaps. Normals are those of planes alone, as of any surface until it is seen to bend, and then as they are.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from batch import into_page
from blind_trials import pin

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.scene import Scene
from data_synth.simulate import Measured
from stitch.observations.surfaces.effect_columns import apparent_twists
from stitch.observations.surfaces.hand_eye_fit import solve_hand_eye
from stitch.observations.surfaces.scanner_errors import SHARE_BOUNDS, shared_error_likelihood, sum_smooth_errors
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.session import scan
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "method.md"
PARTS, VIEWS, GATE = ("spheres", "blade", "drill-plate"), 8, 5.0


def scene_of(part: str) -> Scene:
    """Return a scene with coarse scans, 20 µm of noise and an arm that scatters."""
    scene = clean(part, rays=90, noise=0.02)
    if part == "spheres":
        shape = replace(scene.part, labelled=False, parameters={"radius": 28.0})
        scene = replace(scene, part=shape)
    return replace(scene, repeatability=(15e-6, 0.01))


def charged(measured: Measured) -> tuple[float, float, float, float]:
    """Incidence as counted and as likeliest, over the noise; nats over none; mm by which it moves the hand-eye."""
    session = session_of(measured)
    measurement = measurement_of(session, prepare_capture(session))
    capture = measurement.capture
    freed = unconstrained_poses(capture, capture.poses(measured.T_mount), GATE)
    sums, noise = sum_smooth_errors(measurement, freed)
    twists = apparent_twists(sums, freed)
    likelihood = shared_error_likelihood(sums, twists, freed, noise)
    counted, (low, high) = likelihood.map_shares[1], SHARE_BOUNDS
    shares, deviance = likelihood.ml_shares([high, high])
    nats = (likelihood.ml_shares([high, 1.001 * low])[1] - deviance) / 2
    found = solve_hand_eye([capture], [freed], measured.T_mount)
    moved = found.gls.gain @ found.parts[0].reduced_poses.reduction @ twists[:, -1] * noise * counted
    return counted, shares[1], nats, float(np.linalg.norm(moved[3:6]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=60)
    arguments = parser.parse_args()
    pin(0)
    as_it_is = scan._BENT
    lines = [
        f"{arguments.cells} cells each, means; shares of the noise:",
        "",
        "| part | normals | incidence counted | likeliest | nats over none | hand-eye moved by it, µm |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for part in PARTS:
        for normals, limit in (("planes", np.inf), ("quadrics where it bends", as_it_is)):
            scan._BENT = limit
            rows = [
                charged(simulated(scene_of(part), {}, arguments.first_seed + k, VIEWS)) for k in range(arguments.cells)
            ]
            counted, likeliest, nats, moved = np.mean(rows, axis=0)
            lines.append(f"| {part} | {normals} | {counted:.2f} | {likeliest:.2f} | {nats:.1f} | {1e3 * moved:.1f} |")
            print(lines[-1], flush=True)
    into_page("bent", lines, PAGE)


if __name__ == "__main__":
    main()
