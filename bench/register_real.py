"""Register under other weights on measured objects and on the demo's blade: the second table of docs/register.md.

Usage: python bench/register_real.py PATH_OF_REGHEC_SESSIONS [--write]

What is compared is what the weights did not see: points of every view that were no samples of the fit, their distances
inside four robust sigmas. Beside them stands how far the poses lie from those of the first weights, and the sigma that
the normal equations and the robot's prior give those.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from register_weights import PAGE
from weighings import METHODS

from data_synth.fixtures.in_memory import session_of
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.fit.coarse import find_coarse_hand_eye
from stitch.fit.correct import correct
from stitch.fusion.register import Method, Registration, normal_equations, register
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import FINE_SAMPLES, collect_overlaps
from stitch.session.capture import Capture, part_size, prepare_capture
from stitch.session.reading.session_folder import load_session
from stitch.session.scan import Scan
from stitch.session.session import SessionData

OBJECTS = ("cone", "gripperopen", "rubik", "sphere", "david")
SHOWN = ("DPWVM-style", "GICP inside Tukey", "Tukey", "sign classes")
BEGIN, END = "<!-- real: begin -->", "<!-- real: end -->"


def left_out(scan: Scan) -> Indices:
    """As many points as the fit samples, none of them among its own."""
    others = np.setdiff1d(np.flatnonzero(scan.usable), sample_points(scan, FINE_SAMPLES))
    return others[np.linspace(0, len(others) - 1, min(len(others), FINE_SAMPLES)).astype(int)]


def spread(own: Capture, found: Registration, poses: Array, scatter: Repeatability, method: Method) -> Array:
    """(6V, 6V) covariance of the views' twists about the centre of the overlaps."""
    equations = normal_equations(found.overlaps, own, found.poses, poses, scatter=scatter, method=method)
    return np.linalg.inv(equations.H)


def sigma_of(covariance: Array) -> float:
    """Rms per axis of the displacements at the centre, from (6V, 6V), less what all views share."""
    views = len(covariance) // 6
    moved = covariance.reshape(views, 6, views, 6)[:, 3:, :, 3:]
    own, shared = np.einsum("vivi->", moved), np.einsum("viwi->", moved) / views
    return float(np.sqrt((own - shared) / (3 * views)))


def apart(found: Registration, other: Registration) -> Array:
    """(V, 3) displacement at the centre of the part, less what all views share."""
    to_centre = frames.make(np.eye(3), -found.overlaps.gram.centre)
    xi = frames.log(to_centre @ found.poses @ frames.inverse(to_centre @ other.poses))[:, 3:]
    return np.asarray(xi - xi.mean(axis=0))


def rows_of(name: str, session: SessionData, T_start: Array | None) -> list[str]:
    """One line for each way to weigh."""
    own = prepare_capture(session)
    if T_start is None:
        begun = find_coarse_hand_eye([own])
        T_start, gate = begun.T_mount, begun.gate
    else:
        gate = 0.35 * part_size([own])
    found = correct([own], T_start, gate)
    scatter, overlaps = found.hand_eye.repeatability[0], found.overlaps[0]
    poses, spare = own.poses(found.hand_eye.T_mount), [left_out(scan) for scan in own.scans]
    lines, first, sigma = [], None, 0.0
    for weights in SHOWN:
        begun_at = time.perf_counter()
        registered = register(
            own, poses, scatter, overlaps.gate, start=found.unconstrained[0].poses, method=METHODS[weights]
        )
        seconds = time.perf_counter() - begun_at
        if first is None:
            first = registered
            sigma = sigma_of(spread(own, registered, poses, scatter, METHODS[weights]))
        fresh = collect_overlaps(own, registered.poses, registered.overlaps.gate, spare).gram.rms
        off = np.sqrt(np.mean(apart(registered, first) ** 2))
        numbers = (registered.overlaps.gram.rms, fresh, off, sigma)
        lines.append(f"| {name} | {weights} | {' | '.join(f'{1e3 * x:.1f}' for x in numbers)} | {seconds:.1f} |")
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    lines = [
        "µm; of the last two lengths rms per axis, at the part.",
        "",
        "| object | weights | rms, fit's points | rms, left out | from the first's poses | σ of those | seconds |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    measured = simulate(load_scene("blade"), {"joint_compliance": 2.0}, 0)
    lines += rows_of("demo's blade", session_of(measured), measured.T_coarse)
    if options.write:
        write(lines)
    for name in OBJECTS:
        lines += rows_of(name, load_session(options.folder / name), None)
        if options.write:
            write(lines)


def write(lines: list[str]) -> None:
    """Put the table into the page."""
    text = PAGE.read_text(encoding="utf-8")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    PAGE.write_text(f"{before}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
