"""A session as it happens: nature bends, warms and shifts, the scanner measures, the controller reports."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from data_synth import kinematics, nature
from data_synth.labelled import targets_of
from data_synth.moment import Moment, Plan
from data_synth.planning import plan_views
from data_synth.scanner import Cloud, field_map
from data_synth.scene import Scene
from data_synth.shapes import build_shape, load_mesh
from data_synth.take_view import Cell, on_rail, take_view
from stitch.numerics import frames
from stitch.system.threads import parallel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """What the cell wrote down, and what was true. V views."""

    scene: Scene
    mesh: trimesh.Trimesh  # part frame, at the first view
    plan: Plan
    rail: Array  # (V,)
    times: Array  # (V,) s
    covariates: dict[str, Array]  # (V,) each
    approach: Array  # (V, n)
    T_base_flange: Array  # (V, 4, 4) reported
    T_coarse: Array  # (4, 4) hand-eye that the session states
    clouds: list[Cloud]
    labelled: dict[str, Array]  # target → (V, 3) in the sensor frame, NaN where not seen
    hidden: dict[str, dict[str, float]]
    T_mount: Array  # (4, 4) true at the first view
    T_reference_scanner: Array  # (V, 4, 4) true, without the part's own motion
    targets: dict[str, Array]  # true, reference frame, at the first view


def part_mesh(scene: Scene) -> trimesh.Trimesh:
    """The part in its own frame, mm."""
    if scene.part.mesh:
        return load_mesh(scene.folder / scene.part.mesh, scene.part.mesh_scale)
    return build_shape(scene.part.shape, **scene.part.parameters)


def simulate(
    scene: Scene,
    hidden: dict[str, float],
    seed: int,
    views: int | None = None,
    planned: tuple[Plan, Array] | None = None,
    day: int = 0,
    waits: Array | None = None,
) -> Measured:
    """Run one session. Independent streams of chance for plan, cell, nature and every view.

    Args:
        planned: joint angles and the rail's positions (V,), instead of those planned for scene and seed.
        waits: (V,) s that somebody waits before each view, longer than usual.
        day: another one has other views, climate and scatter in the same cell: arm, hand-eye and scanner.

    Raises ValueError for an unknown law, NoResultError for a plan that cannot be driven.
    """
    mesh = part_mesh(scene)
    plan, rail = planned or plan_views(scene, mesh, views or scene.plan.views, _stream(seed, 1, day))
    laws, hidden_parameters = nature.draw(hidden, scene.small, plan, np.random.default_rng([seed, 2]))
    cell = np.random.default_rng([seed, 3])
    times, covariates = _climate(scene, len(plan.joints), cell)
    if day:
        times, covariates = _climate(scene, len(plan.joints), _stream(seed, 3, day))
    times = times if waits is None else times + np.cumsum(waits)
    field_weights = field_map(scene.scanner, cell)
    T_mount = scene.T_mount @ frames.exp(cell.standard_normal(6) * np.repeat(scene.mount_spread, 3))
    moments = moments_of(scene, plan, times, covariates)
    targets = targets_of(scene)
    true_cell = Cell(scene, mesh, laws, T_mount=T_mount, field_weights=field_weights, targets=targets)
    stream = _stream_key(seed, 4, day)

    def take(moment: Moment) -> tuple[Cloud, Array, Array]:
        """Take a view from its own stream of chance."""
        return take_view(true_cell, moment, rail[moment.index], np.random.default_rng([*stream, moment.index]))

    clouds, T_reference_scanner, labelled = zip(*parallel(take, moments, "taking views"), strict=True)
    return Measured(
        scene=scene,
        mesh=mesh,
        plan=plan,
        rail=rail,
        times=times,
        covariates=covariates,
        approach=np.array([m.approach for m in moments]),
        T_base_flange=on_rail(kinematics.flange(scene.arm, plan.joints), rail),
        T_coarse=_coarse(scene, T_mount, cell),
        clouds=list(clouds),
        labelled={name: np.array([seen[i] for seen in labelled]) for i, name in enumerate(targets)},
        hidden=hidden_parameters,
        T_mount=T_mount,
        T_reference_scanner=np.array(T_reference_scanner),
        targets={name: frames.transform(scene.T_reference_part, p[None])[0] for name, p in targets.items()},
    )


def _stream_key(seed: int, of: int, day: int) -> list[int]:
    """Name of a stream of chance."""
    return [seed, of, *([] if day == 0 else [1000 + day])]


def _stream(seed: int, of: int, day: int) -> np.random.Generator:
    return np.random.default_rng(_stream_key(seed, of, day))


def moments_of(scene: Scene, plan: Plan, times: Array, covariates: dict[str, Array]) -> list[Moment]:
    previous = np.vstack([plan.joints[:1], plan.joints[:-1]])
    # What a controller counts as a move: more than the last digit it writes.
    move = plan.joints - previous
    approach = np.where(np.abs(move) > 1e-9, np.sign(move), 0.0)
    start = {name: float(values[0]) for name, values in covariates.items()}
    out = []
    for v, q in enumerate(plan.joints):
        gravity = kinematics.GRAVITY / np.linalg.norm(kinematics.GRAVITY)
        in_flange = kinematics.flange(scene.arm, q)[:3, :3].T @ gravity
        reference, mount = (in_flange, gravity) if scene.mount == "eye_to_hand" else (gravity, in_flange)
        out.append(
            Moment(
                index=v,
                time=float(times[v]),
                arm=scene.arm,
                joints=q,
                previous=previous[v],
                approach=approach[v],
                velocity=plan.velocity[v],
                torque=plan.torque[v],
                covariates={name: float(values[v]) for name, values in covariates.items()},
                start=start,
                gravity_part=scene.T_reference_part[:3, :3].T @ reference,
                gravity_reference=reference,
                gravity_mount=mount,
                standoff=scene.scanner.standoff,
            )
        )
    return out


def _climate(scene: Scene, views: int, rng: np.random.Generator) -> tuple[Array, dict[str, Array]]:
    """Times (s) and what the cell's thermometers say: a rise with a time constant, a slow wander."""
    times = np.sort(np.cumsum(rng.uniform(0.6, 1.4, views)))
    times = (times - times[0]) * scene.climate.minutes * 60 / max(times[-1] - times[0], 1e-9)
    if scene.plan.kind == "path":
        times = np.arange(views) / scene.plan.rate
    hours = times / 3600
    whole = max(hours[-1], 1e-9)

    def course(base: float, change: float, settles: float) -> Array:
        rise = (1 - np.exp(-hours / (settles * whole))) / (1 - np.exp(-1 / settles))
        phase, speed = rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 3.0)
        return np.asarray(base + change * (rise + 0.35 * np.sin(2 * np.pi * speed * hours / whole + phase)))

    climate = scene.climate
    return times, {
        "scanner_temperature_c": course(24.0, climate.scanner, 0.4),
        "part_temperature_c": course(34.0, climate.part, 0.6),
        "robot_temperature_c": course(26.0, climate.robot, 1.5),
        "humidity_percent": 45 + climate.humidity * np.sin(np.cumsum(rng.normal(0, 0.9, views))),
    }


def _coarse(scene: Scene, T_mount: Array, rng: np.random.Generator) -> Array:
    direction = rng.standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    degrees, shift = scene.coarse_error
    return np.asarray(T_mount @ frames.exp(np.append(direction[0] * np.radians(degrees), direction[1] * shift)))
