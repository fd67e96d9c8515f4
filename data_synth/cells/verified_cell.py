"""A cell with a verification: a part that a CMM has measured, and a sphere plate with a calibration.

The calibrated values are the true ones, off by chance as their own uncertainties allow.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import tomli_w

from data_synth.scene import Scene, load_scene
from data_synth.shapes.spheres import SpherePlate, centres
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session, write_truth

PLATE = SpherePlate(radius=20.0)
# Expanded uncertainties (k = 2), mm: of a laboratory's sphere plate, and of a CMM on the part.
U_PLATE, U_CMM = 0.002, 0.004
# Of the part, mm: where a CMM touched it, in the frame of the plate's top.
_TOUCHED = ((-60.0, 0.0), (60.0, 30.0), (0.0, -60.0), (50.0, -50.0), (-30.0, 65.0))


def plate_scene(rays: int | None = None) -> Scene:
    """The scene of the sphere plate without labelled points, with as many rays a row and column if stated."""
    scene = load_scene("spheres")
    part = replace(scene.part, labelled=False, parameters={"radius": PLATE.radius})
    scanner = scene.scanner if rays is None else replace(scene.scanner, columns=rays, rows=rays)
    return replace(scene, part=part, scanner=scanner)


def write_verified_cell(folder: Path, seed: int, views: int | None = None, rays: int | None = None) -> dict[str, Path]:
    """Write a session to fit on and, of another day, one of the artefact with artefact.toml; return their folders."""
    scene = plate_scene(rays)
    out = {}
    for day, name in enumerate(("part", "artefact")):
        measured = simulate(scene, {}, seed, views, day=day)
        out[name] = folder / name
        write_session(out[name], measured, name)
        write_truth(folder / f"{name}.truth.json", measured, seed)
    rng = np.random.default_rng([seed, 11])
    write_artefact(out["artefact"] / "artefact.toml", measured, rng)
    write_part(folder / "part.toml", measured, rng)
    return out


def write_artefact(file: Path, measured: Measured, rng: np.random.Generator) -> None:
    """Write the spheres and their distances as a laboratory calibrated them."""
    balls = centres(PLATE)
    rows = [
        {"name": f"ball {i + 1}", "kind": "sphere", "at": at.tolist(), "diameter": 2 * PLATE.radius, "within": 2.0}
        | _calibrated(2 * PLATE.radius, U_PLATE, rng)
        for i, at in enumerate(balls)
    ]
    for i in range(len(balls)):
        for j in range(i):
            true = float(np.linalg.norm(balls[i] - balls[j]))
            row = {
                "name": f"distance {i + 1}-{j + 1}",
                "kind": "distance",
                "between": [f"ball {i + 1}", f"ball {j + 1}"],
            }
            rows.append(row | {"nominal": round(true, 3)} | _calibrated(true, U_PLATE, rng))
    limits = {"form": 0.15, "size": 0.06, "distance": 0.06}
    _write(file, measured, {"limits": limits, "feature": rows})


def write_part(file: Path, measured: Measured, rng: np.random.Generator) -> None:
    """Write points on the plate's top as a CMM measured them, with a tolerance."""
    rows = [
        {"name": f"point {k + 1}", "kind": "point", "at": [x, y, 0.0], "normal": [0.0, 0.0, 1.0], "radius": 8.0}
        | {"within": 2.0, "tolerance": 0.1}
        | _calibrated(0.0, U_CMM, rng)
        for k, (x, y) in enumerate(_TOUCHED)
    ]
    plane = {"name": "top", "kind": "plane", "at": [-50.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "radius": 35.0}
    _write(file, measured, {"feature": [*rows, plane | {"within": 2.0, "tolerance": 0.1}]})


def _write(file: Path, measured: Measured, document: dict[str, object]) -> None:
    head: dict[str, object] = {"length_unit": "mm", "frame": {"pose": measured.scene.T_reference_part.tolist()}}
    file.write_text(tomli_w.dumps(head | document), encoding="utf-8")


def _calibrated(true: float, U: float, rng: np.random.Generator) -> dict[str, float]:
    return {"calibrated": true + U / 2 * float(rng.standard_normal()), "U": U}
