"""Does the sigma of `stitch fit` hold where hand-eye, robot and scanner err? The table of docs/window.md.

Run: python bench/fit_sigma.py [--doors 50] [--first 4700] [--keep FILE]

Half-size doors, each in another place; the hand-eye errs by its stated covariance, every view by the robot's scatter,
all views by one smooth error of the scanner that no family of the fit holds (cosines). z is error over sigma, about the
CAD's centre; an interval holds 95 % of what rms z would be with sigmas that are right.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from data_synth.cells.window_scans import area_scanner
from data_synth.cells.window_views import along_edges, over
from data_synth.scanner import field_map
from data_synth.scanning import scan
from data_synth.shapes import car_door
from data_synth.shapes.car_door import CarDoor, Pane
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.plugins.cells.cad import cad_surface
from stitch.plugins.cells.placed_scans import PlacingErrors, join_scans
from stitch.plugins.cells.scan_to_cad import fit_cad
from stitch.session.scan import prepare_scan

PAGE = Path(__file__).resolve().parents[1] / "docs" / "window.md"
BEGIN, END = "<!-- sigma: begin -->", "<!-- sigma: end -->"
SIZES = {"length": 600.0, "height": 520.0, "belt": 300.0, "window_frame": 34.0}
ALL = ("hand_eye", "robot", "scanner")
TURN, SHIFT, FIELD, NOISE = 20e-6, 0.03, 0.01, 0.05
STANDOFF = 500.0


def hand_eye_covariance() -> np.ndarray:
    """A hand-eye known to 0.15 mrad and, at the standoff, to 0.03 mm."""
    turn, shift = 1.5e-4, 0.03
    to_target = np.eye(6)
    to_target[3:, :3] = frames.skew(np.array([0.0, 0.0, STANDOFF]))  # v at the scanner of a turn about the target
    return to_target @ np.diag(np.repeat([turn, shift], 3) ** 2) @ to_target.T


def fitted(part: str, mesh, cad, seed: int, sources: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, float]:
    """Error (6,) and sigma (6,) of the pose of a "door" or a "pane", and χ² of the error."""
    rng = np.random.default_rng(seed)
    T_base_part = frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 800, 3))
    views = np.concatenate(
        [
            over(mesh.bounds, (2, 2), 600.0, rng),
            along_edges((CarDoor if part == "door" else Pane)(**SIZES), part, 7 if part == "door" else 10, 400.0),
        ]
    )
    X = frames.make(np.eye(3), [0.0, 130.0, 90.0])
    T_base_flange = T_base_part @ views @ frames.inverse(X)
    C = hand_eye_covariance() if "hand_eye" in sources else np.zeros((6, 6))
    robot = np.repeat([TURN, SHIFT], 3) if "robot" in sources else np.zeros(6)
    field = FIELD if "scanner" in sources else 0.0
    true_X = X @ frames.exp(rng.multivariate_normal(np.zeros(6), C, method="eigh"))
    true = T_base_flange @ frames.exp(rng.standard_normal((len(views), 6)) * robot) @ true_X
    scanner = area_scanner(110, 30.0, STANDOFF, depth=640.0, noise=NOISE)
    scanner = type(scanner)(**{**vars(scanner), "field_error": field})
    weights = field_map(scanner, rng)
    clouds = [scan(mesh, frames.inverse(T_base_part) @ T, scanner, weights, rng).points for T in true]
    joined = join_scans([prepare_scan("", points) for points in clouds], T_base_flange @ X)
    errors = PlacingErrors(T_base_flange, X, C, robot[0], robot[3], field)
    start = T_base_part @ frames.exp(rng.normal(0, 1, 6) * np.repeat([2e-3, 1.0], 3))
    found = fit_cad(joined, cad, start, errors=errors)
    middle = frames.make(np.eye(3), cad.centre)
    off = frames.log(frames.inverse(middle) @ frames.inverse(found.T_base_part) @ T_base_part @ middle)
    return off, found.sigma, float(off @ np.linalg.solve(found.covariance, off))


def row(name: str, part: str, sources: tuple[str, ...], seeds: range, mesh, cad) -> str:
    found, refused = [], 0
    for seed in seeds:
        try:
            found.append(fitted(part, mesh, cad, seed, sources))
        except NoResultError:
            refused += 1
    count = len(found)
    name += f" ({refused} refused)" if refused else ""
    off, sigma, squares = (np.array(column) for column in zip(*found, strict=True))
    z = off / sigma
    low, high = np.sqrt(chi2.ppf([0.025, 0.975], count) / count)
    per_axis = np.sqrt((z**2).mean(axis=0))
    shift = np.linalg.norm(off[:, 3:], axis=1)
    return (
        f"| {name} | {count} | {np.sqrt((shift**2).mean()):.4f} | {np.sqrt((sigma[:, 3:] ** 2).sum(1).mean()):.4f} | "
        f"{np.sqrt((z**2).mean()):.2f} | {per_axis.min():.2f} to {per_axis.max():.2f} | {low:.2f} to {high:.2f} | "
        f"{np.sqrt(squares.mean() / 6):.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--doors", type=int, default=50)
    parser.add_argument("--first", type=int, default=4700, help="the first seed")
    parser.add_argument("--keep", type=Path, help="rows that are done; goes on from there")
    given = parser.parse_args()
    kept = given.keep.read_text(encoding="utf-8").splitlines() if given.keep and given.keep.is_file() else []
    doors, first = given.doors, given.first
    door, pane = car_door.build(CarDoor(**SIZES)), car_door.build_pane(Pane(**SIZES))
    meshes = {"door": (door, cad_surface(door)), "pane": (pane, cad_surface(pane))}
    lines = [
        "Half-size doors (18 scans) and panes (14 scans); mm. Six numbers of a pose about the CAD's centre.",
        "",
        "| part and what errs | parts | shift, rms | its σ, rms | z, rms | by axis | 95 % for one axis | √(χ²/6) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    few = max(4, doors // 5)
    for name, part, sources, count in (
        ("door, the scan's noise alone", "door", (), few),
        ("door, the hand-eye too", "door", ("hand_eye",), few),
        ("door, the robot too", "door", ("robot",), few),
        ("door, the scanner too", "door", ("scanner",), few),
        ("door, all of them", "door", ALL, doors),
        ("pane, all of them", "pane", ALL, 2 * few),
    ):
        done = next((line for line in kept if line.startswith(f"| {name} ")), None)
        lines.append(done or row(name, part, sources, range(first, first + count), *meshes[part]))
        print(lines[-1], flush=True)
        if given.keep and done is None:
            with given.keep.open("a", encoding="utf-8") as file:
                file.write(f"{lines[-1]}\n")
    page = PAGE.read_text(encoding="utf-8")
    text = "\n".join(lines)
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + text + "\n" + END + page.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
