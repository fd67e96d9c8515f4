"""A session as it happens: nature bends, warms and shifts, the scanner measures, the controller reports."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from data_synth import kinematics, nature
from data_synth.labelled import targets_of
from data_synth.moment import Moment, Plan
from data_synth.planning import plan_views
from data_synth.scanner import Cloud, field_map, half_field, profile_times, scan
from data_synth.scene import Scene
from data_synth.shapes import build_shape, load_mesh
from stitch import frames
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
    scene: Scene, hidden: dict[str, float], seed: int, views: int | None = None,
    planned: tuple[Plan, Array] | None = None,
) -> Measured:  # fmt: skip
    """Run one session. Independent streams of chance for plan, cell, nature and every view.

    Args:
        planned: joint angles and the rail's positions (V,), instead of those planned for scene and seed.

    Raises ValueError for an unknown law, NoResultError for a plan that cannot be driven.
    """
    mesh = part_mesh(scene)
    plan, rail = planned or plan_views(scene, mesh, views or scene.plan.views, np.random.default_rng([seed, 1]))
    count = len(plan.joints)
    laws, told = nature.draw(hidden, scene.small, plan, np.random.default_rng([seed, 2]))
    cell = np.random.default_rng([seed, 3])
    times, covariates = _climate(scene, count, cell)
    field_weights = field_map(scene.scanner, cell)
    T_mount = scene.T_mount @ frames.exp(cell.standard_normal(6) * np.repeat(scene.mount_spread, 3))
    moments = _moments(scene, plan, times, covariates)
    targets = targets_of(scene)

    def take(moment: Moment) -> tuple[Cloud, Array, Array]:
        return _take(scene, mesh, laws, moment, rail[moment.index], T_mount, field_weights, targets,
                     np.random.default_rng([seed, 4, moment.index]))  # fmt: skip

    taken = list(parallel(take, moments))
    reported = _on_rail(kinematics.flange(scene.arm, plan.joints), rail)
    return Measured(
        scene, mesh, plan, rail, times, covariates, np.array([m.approach for m in moments]), reported,
        _coarse(scene, T_mount, cell), [t[0] for t in taken],
        {name: np.array([t[2][i] for t in taken]) for i, name in enumerate(targets)}, told, T_mount,
        np.array([t[1] for t in taken]),
        {name: frames.transform(scene.T_reference_part, p[None])[0] for name, p in targets.items()},
    )  # fmt: skip


def _take(
    scene: Scene, mesh: trimesh.Trimesh, laws: nature.Nature, moment: Moment, rail: float, T_mount: Array,
    field_weights: Array, targets: dict[str, Array], rng: np.random.Generator,
) -> tuple[Cloud, Array, Array]:  # fmt: skip
    """One view: cloud, true T_reference_scanner, labelled points (L, 3) in the sensor frame."""
    sigma = np.array([scene.repeatability[0]] * 3 + [scene.repeatability[1]] * 3)
    scatter = frames.exp(rng.standard_normal(6) * sigma)
    arm = laws.act("arm", moment, moment.arm)
    mount = laws.act("mount", moment, T_mount)
    T_reference_part = laws.act("part", moment, scene.T_reference_part)
    surface = mesh
    if laws.touches("surface"):
        surface = trimesh.Trimesh(laws.act("surface", moment, mesh.vertices), mesh.faces, process=False)

    def scanner_at(q: Array) -> Array:
        T = _on_rail(kinematics.flange(arm, q), np.full(q.shape[:-1], rail)) @ scatter
        return np.asarray((frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ mount)

    q_true = laws.act("joints", moment, moment.joints)
    T_reference_scanner = scanner_at(q_true)
    to_part = frames.inverse(T_reference_part)
    if scene.scanner.kind == "line":
        along = _sweep(scene, moment)
        poses = scanner_at(q_true + along)
        cloud = scan(surface, to_part @ poses, scene.scanner, field_weights, rng)
        cloud = laws.act("points", moment, cloud)
        cloud = _assemble(scene, moment, along, rail, T_mount, cloud)
    else:
        cloud = laws.act("points", moment, scan(surface, to_part @ T_reference_scanner, scene.scanner,
                                                field_weights, rng))  # fmt: skip
    return cloud, T_reference_scanner, _labelled(scene, laws, moment, targets, T_reference_part, T_reference_scanner,
                                                 rng)  # fmt: skip


def _labelled(
    scene: Scene, laws: nature.Nature, moment: Moment, targets: dict[str, Array], T_reference_part: Array,
    T_reference_scanner: Array, rng: np.random.Generator,
) -> Array:  # fmt: skip
    """(L, 3) targets as the scanner reports them, NaN outside its field."""
    if not targets:
        return np.empty((0, 3))
    places = laws.act("surface", moment, np.array(list(targets.values())))
    T = frames.inverse(T_reference_scanner) @ T_reference_part
    seen = frames.transform(T, places)
    ideal = Cloud(seen, np.full(len(seen), 0.5), np.ones(len(seen)))
    points = laws.act("points", moment, ideal).points + scene.part.sigma * rng.standard_normal(seen.shape)
    inside = (np.abs(seen[:, :2]) < half_field(scene.scanner) * seen[:, 2:]).all(axis=1)
    inside &= np.abs(seen[:, 2] - scene.scanner.standoff) < scene.scanner.depth_of_field / 2
    return np.where(inside[:, None], points, np.nan)


def _sweep(scene: Scene, moment: Moment) -> Array:
    """(K, n) joint angles of the profiles less those of the view."""
    return np.asarray(profile_times(scene.scanner)[:, None] * moment.velocity)


def _assemble(scene: Scene, moment: Moment, along: Array, rail: float, T_mount: Array, cloud: Cloud) -> Cloud:
    """Profiles carried into the view's scanner frame by the reported motion, as controllers of line scanners do."""
    assert cloud.time is not None

    def place(q: Array) -> Array:
        T = kinematics.flange(scene.arm, q)
        return np.asarray((frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ T_mount)

    T_view_profile = frames.inverse(place(moment.joints)) @ place(moment.joints + along)
    profiles = len(along)
    step = scene.scanner.sweep / profiles / scene.scanner.speed
    index = np.round(cloud.time / step + (profiles - 1) / 2).astype(int)
    points = np.einsum("nij,nj->ni", T_view_profile[index, :3, :3], cloud.points) + T_view_profile[index, :3, 3]
    return Cloud(points, cloud.intensity, cloud.incidence, cloud.time)


def _moments(scene: Scene, plan: Plan, times: Array, covariates: dict[str, Array]) -> list[Moment]:
    previous = np.vstack([plan.joints[:1], plan.joints[:-1]])
    # What a controller counts as a move: more than the last digit it writes.
    move = plan.joints - previous
    approach = np.where(np.abs(move) > 1e-9, np.sign(move), 0.0)
    start = {name: float(values[0]) for name, values in covariates.items()}
    out = []
    for v, q in enumerate(plan.joints):
        gravity = kinematics.GRAVITY / np.linalg.norm(kinematics.GRAVITY)
        if scene.mount == "eye_to_hand":
            gravity = kinematics.flange(scene.arm, q)[:3, :3].T @ gravity
        out.append(Moment(
            v, float(times[v]), scene.arm, q, previous[v], approach[v], plan.velocity[v], plan.torque[v],
            {name: float(values[v]) for name, values in covariates.items()}, start,
            scene.T_reference_part[:3, :3].T @ gravity, scene.scanner.standoff,
        ))  # fmt: skip
    return out


def _climate(scene: Scene, views: int, rng: np.random.Generator) -> tuple[Array, dict[str, Array]]:
    """Times (s) and what the cell's thermometers say: a rise with a time constant, a slow wander."""
    times = np.sort(np.cumsum(rng.uniform(0.6, 1.4, views)))
    times = (times - times[0]) * scene.climate.minutes * 60 / max(times[-1] - times[0], 1e-9)
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


def _on_rail(T: Array, rail: Array) -> Array:
    T = np.array(T)
    T[..., 0, 3] += rail
    return T
