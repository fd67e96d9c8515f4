"""Cells of the benchmark of the register: five kinds of trouble on a blade, the truth known."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np

from data_synth.fixtures.blade_cells import captured, disturbed
from data_synth.fixtures.quiet_scenes import mesh_for, plan_for, simulated
from data_synth.scanner import Cloud as Seen
from data_synth.scanner import Scanner, half_field
from data_synth.scene import Scene, load_scene
from data_synth.shapes.casting import with_stock
from data_synth.simulate import Measured, simulate
from stitch.fit.correct import correct
from stitch.numerics.frames import Array
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.session.capture import Capture

PIXELS, VIEWS = 150, 14
# Of 24 views around the part: eight neighbours, 15° apart, and six that are 45° apart or a little less.
_UNEVEN = np.array([0, 1, 2, 3, 4, 5, 6, 7, 10, 13, 15, 18, 20, 22])
# Flying points: share of the pixels on a silhouette, and how far behind them the wall stands, mm.
_FLYING, _WALL = 0.7, 60.0
# What stands on the casting all over while one of its views is taken, mm.
STOCK = 0.3


@dataclass(frozen=True)
class Cell:
    """One session where `register` begins, and where its views truly were."""

    capture: Capture
    T_reference_scanner: Array  # (V, 4, 4) true
    model_poses: Array  # (V, 4, 4) of robot and hand-eye
    start: Array  # (V, 4, 4) freed by the overlaps
    scatter: Repeatability
    gate: float


def uneven_overlap(seed: int) -> Measured:
    """Half of the views crowd on a third of the circle."""
    scene = _scene()
    crowded = replace(scene, plan=replace(scene.plan, turn=15.0, views=24))
    plan, rail = plan_for(crowded, seed)
    of_views = {key: getattr(plan, key)[_UNEVEN] for key in ("joints", "torque", "velocity")}
    return simulate(scene, {}, seed, planned=(replace(plan, **of_views), rail[_UNEVEN]))


def mixed_pixels(seed: int) -> Measured:
    """Edge pixels lie between front and back, and silhouettes fly towards a wall behind the part."""
    measured = simulated(_scene(mixed_pixels=0.9), {}, seed, VIEWS)
    rng = np.random.default_rng([seed, 77])
    return replace(measured, clouds=[_fly(cloud, measured.scene.scanner, rng) for cloud in measured.clouds])


def thin_edges(seed: int) -> Measured:
    """A blade half as thick, its trailing edge 0.2 mm: both sides of it lie within the gate."""
    scene = _scene()
    thin = {"trailing_radius": 0.1, "thickness": 0.05, "thickness_tip": 0.03}
    return simulated(replace(scene, part=replace(scene.part, parameters=thin)), {}, seed, VIEWS)


def biased_scanner(seed: int) -> Measured:
    """Surfaces seen aslant stand too far, and the field bends by half of the noise."""
    return simulated(_scene(field_error=0.01), {"incidence_bias": 0.6}, seed, VIEWS)


def stock_on_a_casting(seed: int) -> Measured:
    """One view was taken before the stock was ground off, all others after."""
    scene = _scene()
    plan = plan_for(scene, seed, VIEWS)
    ground = simulated(scene, {}, seed, VIEWS)
    raw = with_stock(mesh_for(scene), lambda places: np.full(len(places), STOCK))
    with patch("data_synth.simulate.part_mesh", lambda _: raw):
        before = simulate(scene, {}, seed, planned=plan)
    clouds = list(ground.clouds)
    clouds[view_with_stock(seed)] = before.clouds[view_with_stock(seed)]
    return replace(ground, clouds=clouds)


def view_with_stock(seed: int) -> int:
    """The view of `stock_on_a_casting` that shows it."""
    return seed % VIEWS


KINDS: dict[str, Callable[[int], Measured]] = {
    "uneven overlap": uneven_overlap,
    "mixed pixels": mixed_pixels,
    "thin trailing edges": thin_edges,
    "biased scanner": biased_scanner,
    "stock left on a casting": stock_on_a_casting,
}


def cell_of(kind: str, seed: int) -> Cell:
    """Simulate a cell and correct its hand-eye, from half a degree and 3 mm."""
    measured = KINDS[kind](seed)
    own = captured(measured)
    found = correct([own], disturbed(measured.T_mount, seed, 0.5, 3.0), 10.0)
    T_mount = found.hand_eye.T_mount
    return Cell(
        capture=own,
        T_reference_scanner=measured.T_reference_scanner,
        model_poses=own.poses(T_mount),
        start=found.unconstrained[0].poses,
        scatter=found.hand_eye.repeatability[0],
        gate=found.overlaps[0].gate,
    )


def _scene(**scanner: float) -> Scene:
    scene = load_scene("blade")
    tool = replace(scene.scanner, columns=PIXELS, rows=PIXELS, **scanner)
    return replace(scene, scanner=tool)


def _fly(cloud: Seen, scanner: Scanner, rng: np.random.Generator) -> Seen:
    """The cloud with many of its silhouette's pixels behind their surface; a range mixes by the share of the spot."""
    x, y, z = cloud.points.T
    half = half_field(scanner)
    column, row = (
        np.round((t / h + 1) / 2 * (n - 1)).astype(int) + 1
        for t, h, n in ((x / z, half[0], scanner.columns), (y / z, half[1], scanner.rows))
    )
    seen = np.zeros((scanner.rows + 2, scanner.columns + 2), bool)
    seen[row, column] = True
    around = [seen[row + a, column + b] for a, b in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    flies = ~np.all(around, axis=0) & (rng.random(len(x)) < _FLYING)
    # Most spots see a sliver of the wall, few see it alone.
    behind = np.where(flies, _WALL * rng.random(len(x)) ** 3, 0.0)
    reach = np.linalg.norm(cloud.points, axis=1)
    return replace(cloud, points=cloud.points * (1 + behind / reach)[:, None])
