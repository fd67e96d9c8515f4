"""Scan onto CAD and seam on a car door and its pane: writes the tables and pictures of docs/window.md.

Run: python bench/window.py [--draws N]
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from data_synth.cells import window_scans, window_views
from data_synth.cells.window_scans import Weld, warp
from data_synth.shapes import car_door
from data_synth.shapes.car_door import CarDoor, Pane
from stitch.numerics import frames
from stitch.plugins.cells.cad import Box, Regions, cad_surface
from stitch.plugins.cells.placed_scans import join_scans
from stitch.plugins.cells.scan_to_cad import find_cad_start, fit_cad, measure_deviations
from stitch.plugins.cells.seam import Limits, Station, measure_seam
from stitch.session.scan import prepare_scan
from viz.cells.window_fit import deviation_map

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURES = ROOT / "docs" / "window.md", ROOT / "docs" / "pictures"
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
NOISE = 0.05


def truth(seed: int) -> np.ndarray:
    """Any turn, about where the source's body stands."""
    return frames.make(Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), [3567.7, -2954.3, 1932.9])


def joined(clouds, poses):
    return join_scans([prepare_scan("", points) for points in clouds], poses)


def scanned(mesh, kind: str, T: np.ndarray, seed: int, part: slice = slice(None), edges: slice = slice(None)):
    """Overview scans and close scans along the edges."""
    overview, poses = window_scans.scan_outside(mesh, T, NOISE, seed, (3, 1) if kind == "pane" else (3, 3))
    close, near = window_scans.scan_edges(mesh, T, Pane() if kind == "pane" else CarDoor(), kind, NOISE, seed + 50)
    return joined(overview[part] + close[edges], np.concatenate([poses[part], near[edges]]))


def furthest(T: np.ndarray, true: np.ndarray, mesh) -> float:
    """Largest distance that the pose's error moves a point of the part, mm."""
    off = frames.transform(T, mesh.vertices) - frames.transform(true, mesh.vertices)
    return float(np.linalg.norm(off, axis=1).max())


def fit_table(door, pane, draws: int) -> list[str]:
    big = Weld(size=6.0, reach=200.0)
    upper = Regions(expected=(Box("window frame", np.array([-9.0, -200, 600]), np.array([1300.0, 100, 1100])),))
    bulged, badly_bulged, everything = warp(door, Weld()), warp(door, big), (slice(None), slice(None))
    cases = [
        ("pane", "pane", pane, everything, None),
        ("door", "door", door, everything, None),
        ("door, front third of it scanned", "door", door, (slice(0, 4), slice(0, 5)), None),
        ("door, welding bulge 3 mm, σ 130 mm", "door", bulged, everything, None),
        ("door, welding bulge 6 mm, σ 200 mm", "door", badly_bulged, everything, None),
        ("the same, window frame expected", "door", badly_bulged, everything, upper),
    ]
    cad_meshes = {"pane": pane, "door": door}
    surfaces = {kind: cad_surface(mesh) for kind, mesh in cad_meshes.items()}
    lines = [
        f"Furthest that the pose's error moves any point of the part, {draws} turns of it; noise {NOISE} mm.",
        "",
        "| part | start / mm | after the fit, largest / mm | rms of distances / mm | share that counts |",
        "|---|---|---|---|---|",
    ]
    for name, kind, mesh, (part, edges), regions in cases:
        rows = []
        for seed in range(draws):
            T = truth(seed)
            scan = scanned(mesh, kind, T, seed, part, edges)
            start = find_cad_start(scan, surfaces[kind]).T_base_part
            found = fit_cad(scan, surfaces[kind], start, regions)
            off = (furthest(pose, T, cad_meshes[kind]) for pose in (start, found.T_base_part))
            rows.append([*off, found.rms, found.inliers])
            if name.startswith("door, welding bulge 3") and seed == 0:
                write_map(scan, surfaces["door"], found.T_base_part)
        r = np.array(rows)
        off, left = f"{r[:, 0].max():.2f} | {r[:, 1].max():.4f}", f"{r[:, 2].mean():.3f} | {r[:, 3].mean():.0%}"
        lines.append(f"| {name} | {off} | {left} |")
    lines.append("| published: body / window | | | 1.052 / 0.573 | |")
    return lines


def write_map(scan, cad, T) -> None:
    figure = deviation_map(measure_deviations(scan, cad, T, 0.5, cad.size / 60), "mm")
    path = PICTURES / "window-map.png"
    figure.savefig(path, dpi=100)
    Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def seam_table(door, draws: int) -> list[str]:
    """Errors of flush and gap against the meshes cut at the stations."""
    middle, across, out = window_views.stations(Pane())
    places = [Station(str(i + 1), *v) for i, v in enumerate(zip(middle, across, out, strict=True))]
    errors, sigmas, shown = [], [], []
    for seed in range(draws):
        pane = car_door.build_pane()
        rng = np.random.default_rng(seed)
        centre = frames.make(np.eye(3), pane.centroid)
        push = np.concatenate([rng.normal(size=3) * 1e-3, rng.normal(size=3) * 0.5])
        pane.apply_transform(centre @ frames.exp(push) @ frames.inverse(centre))
        T = truth(seed)
        scan = joined(*window_scans.scan_seam([door, pane], T, (middle, across, out), NOISE, seed))
        measured = measure_seam(scan, T, places, Limits())
        true = np.array([window_scans.true_seam(pane, door, s.T_part_station) for s in places])
        errors.append([[m.flush - t[0], m.gap - t[1]] for m, t in zip(measured, true, strict=True)])
        sigmas.append([[m.sigma_flush, m.sigma_gap] for m in measured])
        shown = list(zip(measured, true, strict=True))
    e, s = np.array(errors).reshape(-1, 2), np.array(sigmas).reshape(-1, 2)
    rows = {
        "error, rms": np.sqrt((e**2).mean(0)),
        "error, largest": np.abs(e).max(0),
        "stated sigma, mean": s.mean(0),
        "error over stated sigma, rms": np.sqrt(((e / s) ** 2).mean(0)),
    }
    lines = [f"Seam, {draws} panes set a little wrong, eight stations each.", ""]
    lines += ["| | flush / mm | gap / mm |", "|---|---|---|"]
    for name, values in rows.items():
        lines.append(f"| {name} | {values[0]:.4f} | {values[1]:.4f} |")
    lines += ["", "The last pane (limits: flush 0 ± 1.5, gap 16 ± 2 mm):", ""]
    lines += ["| station | flush / mm | true | gap / mm | true | verdict |", "|---|---|---|---|---|---|"]
    for m, t in shown:
        lines.append(f"| {m.station} | {m.flush:+.3f} | {t[0]:+.3f} | {m.gap:.3f} | {t[1]:.3f} | {m.verdict} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=3)
    given = parser.parse_args()
    door, pane = car_door.build(), car_door.build_pane()
    text = "\n\n".join("\n".join(part) for part in (fit_table(door, pane, given.draws), seam_table(door, given.draws)))
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + text + "\n" + END + page.split(END)[1], encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
