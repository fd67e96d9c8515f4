"""Junk in scans: what of it reaches the stitched cloud and what surface it costs, beside Open3D's outlier removal.

Run: python bench/outliers.py [--seeds 11 12] [--scenes blade spheres …]; writes the table of docs/junk.md. The scenes
have data_synth's scanners, mixed pixels at edges included; views stand where they truly stood.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
from batch import into_page
from numpy.typing import NDArray
from scipy.spatial import KDTree

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated
from data_synth.scene import load_scene
from data_synth.simulate import Measured
from stitch.fusion.fuse import fuse_points, place_scans
from stitch.fusion.support import PlacedPoints, find_support
from stitch.numerics import frames
from stitch.session.capture import prepare_capture

Array = NDArray[np.float64]
PAGE = Path(__file__).resolve().parents[1] / "docs" / "junk.md"
SCENES = ("blade", "body-side", "car-door", "spheres")
# Open3D's own example: 20 neighbours, 2 standard deviations.
_NEIGHBOURS, _DEVIATIONS = 20, 2.0


def with_points(measured: Measured, extra: Sequence[Array]) -> Measured:
    """The session with further points (N, 3) in its scans, in any order."""
    clouds = []
    for v, (cloud, more) in enumerate(zip(measured.clouds, extra, strict=True)):
        order = np.random.default_rng(v).permutation(len(cloud.points) + len(more))
        ones = np.ones(len(more))
        changed = {"points": np.vstack([cloud.points, more])[order]}
        changed |= {k: np.concatenate([getattr(cloud, k), ones])[order] for k in ("intensity", "incidence")}
        clouds.append(replace(cloud, **changed))
    return replace(measured, clouds=clouds)


def uniform(share: float) -> Callable[[Measured, np.random.Generator], Measured]:
    """Junk anywhere in the box of each scan, such a share of its points."""

    def world(measured: Measured, rng: np.random.Generator) -> Measured:
        boxes = [(c.points.min(axis=0), c.points.max(axis=0), len(c.points)) for c in measured.clouds]
        return with_points(
            measured, [rng.uniform(low, high, (round(n * share / (1 - share)), 3)) for low, high, n in boxes]
        )

    return world


def hose(measured: Measured, rng: np.random.Generator) -> Measured:
    """A hose before the part in every other view, 5 % of its points; what lies behind it is not seen."""
    clouds, extra = list(measured.clouds), []
    for v, cloud in enumerate(measured.clouds):
        if v % 2:
            extra.append(np.zeros((0, 3)))
            continue
        count = round(len(cloud.points) * 0.05 / 0.95)
        depth = np.median(cloud.points[:, 2]) * rng.uniform(0.84, 0.94)
        half = depth * np.quantile(np.abs(cloud.points[:, 0] / cloud.points[:, 2]), 0.9)
        along, across = rng.uniform(-0.6, 0.6, count) * half, rng.uniform(-0.12, 0.12, count) * half
        turn, (x, y) = rng.uniform(0, np.pi), rng.uniform(-0.3, 0.3, 2) * half
        front = depth - np.sqrt((0.12 * half) ** 2 - across**2) + rng.normal(0, measured.scene.scanner.noise, count)
        c, s = np.cos(turn), np.sin(turn)
        body = np.column_stack([x + along * c - across * s, y + along * s + across * c, front])
        rays, own = (p[:, :2] / p[:, 2:] for p in (cloud.points, body))
        gap = 4 * np.median(KDTree(own).query(own, k=2)[0][:, 1])
        free = KDTree(own).query(rays)[0] > gap
        clouds[v] = replace(cloud, **{k: getattr(cloud, k)[free] for k in ("points", "intensity", "incidence")})
        extra.append(body)
    return with_points(replace(measured, clouds=clouds), extra)


WORLDS: dict[str, Callable[[Measured, np.random.Generator], Measured] | None] = {
    "clean": None,
    "flying pixels": uniform(0.0),
    **{f"and {share:.0%} anywhere": uniform(share) for share in (0.01, 0.05, 0.1, 0.3)},
    "and a hose": hose,
}


class Surface:
    """The true part, and how well a cloud shows it."""

    def __init__(self, measured: Measured) -> None:
        self.T = frames.inverse(measured.scene.T_reference_part)
        self.mesh = np.array(measured.mesh.vertices), np.array(measured.mesh.faces)
        self.tree, self.limit = igl.AABB(), 5 * measured.scene.scanner.noise
        self.tree.init(*self.mesh)

    def off(self, points: Array) -> NDArray[np.bool_]:
        """(N,) points beyond five sigmas of the scanner's noise from the part."""
        squares = self.tree.squared_distance(*self.mesh, np.ascontiguousarray(frames.transform(self.T, points)))[0]
        return np.asarray(np.sqrt(squares) > self.limit)


def cells_of(points: Array, size: float) -> set[tuple[int, ...]]:
    """The cells of the grid in which points lie."""
    return set(map(tuple, np.floor(points / size).astype(np.int64).tolist()))


def kept_by_open3d(placed: PlacedPoints) -> NDArray[np.bool_]:
    """Open3D's statistical outlier removal, view by view."""
    import open3d

    kept = np.zeros(len(placed.points), bool)
    for v in np.unique(placed.view):
        own = np.flatnonzero(placed.view == v)
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(placed.points[own]))
        kept[own[np.asarray(cloud.remove_statistical_outlier(_NEIGHBOURS, _DEVIATIONS)[1])]] = True
    return kept


def row(scene: str, kind: str, seed: int) -> str:
    """One world: share off the part and share of the surface's cells lost, for fuse alone, with support, and Open3D."""
    made, change = load_scene(scene), WORLDS[kind]
    if change is None:
        made = replace(made, scanner=replace(made.scanner, mixed_pixels=0.0))
    measured = simulated(made, {}, seed)
    if change is not None:
        measured = change(measured, np.random.default_rng([seed, 7]))
    capture, surface = prepare_capture(session_of(measured)), Surface(measured)
    placed = place_scans(capture.scans, measured.T_reference_scanner)
    cell = capture.spacing
    fused = fuse_points(placed, cell).points
    off = surface.off(fused)
    true = cells_of(fused[~off], cell)
    found = [f"{off.mean():.2%}"]
    for keep in (
        lambda: find_support(capture.scans, measured.T_reference_scanner, placed, cell).kept,
        lambda: kept_by_open3d(placed),
    ):
        begun = time.process_time()
        kept = keep()
        seconds = time.process_time() - begun
        points = fuse_points(placed.take(kept), cell).points
        lost = len(true - cells_of(points, cell)) / len(true)
        found += [f"{surface.off(points).mean():.2%}", f"{lost:.2%}", f"{seconds:.1f}"]
    return f"| {scene} | {seed} | {kind} | {' | '.join(found)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    given = parser.parse_args()
    lines = [
        "| scene | seed | scans | all points: off | supported: off | lost | CPU s | Open3D: off | lost | CPU s |",
        "|---|---:|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for scene in given.scenes:
        for seed in given.seeds:
            for kind in WORLDS:
                lines.append(row(scene, kind, seed))
                print(lines[-1], file=sys.stderr, flush=True)
    into_page("junk", lines, PAGE)


if __name__ == "__main__":
    main()
