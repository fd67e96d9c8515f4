"""A robot cell by NumPy alone: an arm by products of exponentials, a scanner, a part by a formula, one hidden error.

It shares no code with stitch nor with data_synth. Two arms, a wrist of parallel offsets and a spherical one, each with
its scatter and a little geometry of its own; labelled balls or the scans of a bumpy egg, ray by ray. A session is what
a user has: joint angles and the columns that a cell records. Lengths in mm, angles in rad.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

Array = np.ndarray
# Rows: a, alpha (degrees), d, mass (kg), and the centre of mass in the link's own frame.
_OFFSET = """0 90 181 7.4 0 -20 3; -613 0 0 13 290 0 160; -572 0 0 4.1 250 0 50; 0 90 174 2.1 0 -18 6;
 0 -90 120 2 0 18 6; 0 0 117 0.6 0 0 -25"""
_SPHERICAL = """260 -90 675 60 -120 90 0; 680 0 0 40 -330 0 60; 35 -90 0 35 0 0 40; 0 90 670 12 0 -150 0;
 0 -90 0 5 0 0 10; 0 0 158 1.5 0 0 -30"""
ARMS = {
    name: np.array([row.split() for row in table.split(";")], float)
    for name, table in (("offset wrist", _OFFSET), ("spherical wrist", _SPHERICAL))
}
FIELD = np.tan(np.radians(18))
STANDOFF = (355, 445)
SEMI_AXES = np.array([85, 65, 50])
RAYS = 78  # a side of the scanner's grid
STEEPEST = np.cos(np.radians(65))
SCATTER = 0.02  # rms displacement at the part of an ordinary arm
SHARES = np.array([1, 1, 1, 2, 2, 2])  # of the joints in it
GEOMETRY = 0.02  # the same of its lengths and zeros, most of it without effect on the scans
# Gears and encoders of a wrist are smaller, and worse by this factor.
WRIST = 2.5
# Written once the laws were fixed: the library's effects that are one of them by another name.
NAMES = {
    "joint gives way to the load": ("joint_compliance",),
    "code disc off its centre": ("gear_eccentricity",),
    "play in a gear": ("backlash",),
    "poses read late in motion": ("latency",),
    "coupling creeps in behind a move": ("settling",),
    "one link grows warm": ("robot_thermal_growth", "link_thermal"),
    "adapter droops at the flange": ("mount_droop", "mount_bend", "fixture_droop", "fixture_bend"),
    "scanner is knocked": ("mount_step",),
    "field of the scanner is a bowl": ("field_curvature",),
    "steep surfaces look farther": ("incidence_bias",),
    "near and far look farther": ("range_nonlinearity",),
}


@dataclass
class Cell:
    """A cell and what it does in each of V views."""

    arm: str
    eye_in_hand: bool
    q: Array  # (V, 6) reported
    hand_eye: Array  # (4, 4) T_flange_scanner or T_base_scanner
    part_pose: Array  # (4, 4) T_base_part or T_flange_part
    time: Array
    moves: Array  # (V, 6) from where each joint came
    velocities: Array
    columns: dict[str, Any]
    ranges: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin with a perfect cell."""
        views = len(self.q)
        self.base, self.mount, self.stand, self.part, self.joints = (np.zeros((views, 6)) for _ in range(5))
        self.links = np.zeros((6, views, 6))
        self.link_vectors = np.diff(chain(self.arm)[:, :3, 3], axis=0)
        flange, links = forward(self.arm, self.q)
        self.down_in_flange = -flange[:, 2, :3]
        weights = ARMS[self.arm][:, 3] * 9.81e-3
        places = np.einsum("kvij,kj->kvi", links[1], np.c_[ARMS[self.arm][:, 4:], np.ones(6)])[..., :3]
        self.torques = np.zeros((views, 6))
        for joint, frame in enumerate(links[0]):
            moment = np.cross(places[joint:] - frame[:, :3, 3], weights[joint:, None, None] * [0, 0, -1]).sum(0)
            self.torques[:, joint] = (moment * frame[:, :3, 2]).sum(1) / (weights[joint:].sum() * 600)

    def scanner_seen(self) -> Array:
        """Return what the hand-eye would be in each view (V, 4, 4) to whoever takes the reported poses as true."""
        reported, true = forward(self.arm, self.q)[0], forward(self.arm, self.q + self.joints, self.links)[0]
        if self.eye_in_hand:
            return np.linalg.inv(reported) @ true @ motion(self.mount) @ self.hand_eye @ motion(self.stand)
        return reported @ np.linalg.inv(motion(self.base) @ true) @ self.hand_eye @ motion(self.stand)

    def scanner_part(self) -> Array:
        """Return T_scanner_part (V, 4, 4) as it is, with all errors."""
        flange = motion(self.base) @ forward(self.arm, self.q + self.joints, self.links)[0] @ motion(self.mount)
        if self.eye_in_hand:
            return np.linalg.inv(flange @ self.hand_eye @ motion(self.stand)) @ self.part_pose @ motion(self.part)
        return np.linalg.inv(self.hand_eye @ motion(self.stand)) @ flange @ self.part_pose @ motion(self.part)


def motion(twist: Array) -> Array:
    """Return exp of twists (..., 6), rotation first, as (..., 4, 4)."""
    angle = np.linalg.norm(twist[..., :3], axis=-1)[..., None, None]
    x, y, z = np.moveaxis(twist[..., :3], -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    square = cross @ cross
    first = np.sinc(angle / np.pi)
    second = np.sinc(angle / 2 / np.pi) ** 2 / 2
    third = np.where(angle > 1e-4, (1 - first) / np.maximum(angle, 1e-4) ** 2, 1 / 6)
    result = np.zeros((*x.shape, 4, 4))
    result[..., :3, :3] = np.eye(3) + first * cross + second * square
    result[..., :3, 3] = ((np.eye(3) + second * cross + third * square) @ twist[..., 3:, None])[..., 0]
    result[..., 3, 3] = 1
    return result


def chain(arm: str) -> Array:
    """Return the frames (7, 4, 4) of base and links with all joints at zero; joint k turns about z of frame k."""
    frames = [np.eye(4)]
    for a, alpha, d in ARMS[arm][:, :3]:
        cosine, sine = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        frames.append(frames[-1] @ [[1, 0, 0, a], [0, cosine, -sine, 0], [0, sine, cosine, d], [0, 0, 0, 1]])
    return np.array(frames)


def forward(arm: str, q: Array, links: Array | None = None) -> tuple[Array, Array]:
    """Return T_base_flange (V, 4, 4), and the frames before and behind each joint (2, 6, V, 4, 4)."""
    frames = chain(arm)
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    passed = []
    for joint, (start, end) in enumerate(itertools.pairwise(frames)):
        axis = np.r_[start[:3, 2], np.cross(start[:3, 3], start[:3, 2])]
        before, pose = pose @ start, pose @ motion(q[:, joint, None] * axis)
        passed.append((before, pose @ end))
        pose = pose if links is None else pose @ motion(links[joint])
    return pose @ frames[-1], np.array(passed).swapaxes(0, 1)


def reach(arm: str, wanted: Array, start: Array) -> tuple[Array, Array]:
    """Return joint angles (V, 6) for T_base_flange, and which of them a sensible user would drive to."""
    q = np.array(np.broadcast_to(start, (len(wanted), 6)))
    for _ in range(40):
        pose, (before, _) = forward(arm, q)
        turn = wanted[:, :3, :3] @ pose[:, :3, :3].swapaxes(1, 2)
        skew = (turn - turn.swapaxes(1, 2)) / 2
        error = np.c_[wanted[:, :3, 3] - pose[:, :3, 3], skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]]
        axes = np.moveaxis(before[..., :3, 2], 0, 1)
        lever = pose[:, None, :3, 3] - np.moveaxis(before[..., :3, 3], 0, 1)
        jacobian = np.concatenate([np.cross(axes, lever) / 300, axes], -1).swapaxes(1, 2)
        error[:, :3] /= 300
        damped = jacobian @ jacobian.swapaxes(1, 2) + 1e-6 * np.eye(6)
        step = (jacobian.swapaxes(1, 2) @ np.linalg.solve(damped, error[..., None]))[..., 0]
        q = q + np.clip(step, -0.4, 0.4)
    good = (np.abs(error).max(1) < 1e-10) & (np.abs(q).max(1) < 2.9) & (turn.trace(axis1=1, axis2=2) > 2.9)
    return q, good & (np.linalg.svd(jacobian, compute_uv=False)[:, -1] > 0.1)


def looks(rng: np.random.Generator, count: int) -> Array:
    """Return T_scanner_part (count, 4, 4): the part seen from within 50 degrees of its z axis, at any roll."""
    turn, tilt = rng.uniform(0, 2 * np.pi, count), np.arccos(rng.uniform(np.cos(np.radians(50)), 1, count))
    still = np.zeros((count, 3))
    roll = motion(np.c_[still[:, :2], rng.uniform(-1.8, 1.8, count), still])
    leaning = motion(np.c_[np.cos(turn) * tilt, np.sin(turn) * tilt, still, still[:, 0]])
    # The scanner's z axis looks at the part, whose z axis looks back.
    facing = np.diag([1.0, -1, -1, 1]) @ (leaning @ roll).swapaxes(1, 2)
    facing[:, :3, 3] = np.c_[rng.uniform(-15, 15, (count, 2)), rng.uniform(355, 445, count)]
    return facing


def placed(turn: Any, low: list[float], high: list[float], rng: np.random.Generator) -> Array:
    """Return a pose (4, 4) of a rotation vector, somewhere between two corners."""
    pose = motion(np.r_[turn, 0, 0, 0])
    pose[:3, 3] = rng.uniform(low, high)
    return pose


def build(kind: str, on_the_fly: bool, rng: np.random.Generator) -> Cell:
    """Return a cell whose views a user would take, without any error."""
    eye_in_hand = bool(rng.random() < 0.55)
    tilt = rng.uniform(-0.3, 0.3, 3)
    for _ in range(50):
        arm = str(rng.choice(list(ARMS)))
        if eye_in_hand:
            hand_eye = placed(tilt, [-60, 40, 60], [60, 120, 140], rng)
            part_pose = placed(rng.uniform(-0.2, 0.2, 3), [650, -250, 0], [850, 250, 200], rng)
        else:
            facing = placed([0, -np.pi / 2, 0], [1250, -200, 600], [1400, 200, 900], rng)
            hand_eye = facing @ motion(np.r_[tilt, 0, 0, 0])
            gripper = placed([0, 0, 0], [-30, -30, 120], [30, 30, 180], rng)
            part_pose = gripper @ motion(np.r_[rng.uniform(-0.3, 0.3, 3), 0, 0, 0])
        views = int(rng.integers(12, 17) if kind == "clouds" else rng.choice([10, 14, 18, 25, 40, 60]))
        seen = looks(rng, 6 * views)
        seen[0, :3, :3] = np.diag([1, -1, -1])
        if eye_in_hand:
            flange = part_pose @ np.linalg.inv(hand_eye @ seen)
        else:
            flange = hand_eye @ seen @ np.linalg.inv(part_pose)
        homes, can = reach(arm, np.repeat(flange[:1], 60, 0), rng.uniform(-2, 2, (60, 6)))
        if not can.any():
            continue
        q, good = reach(arm, flange, homes[can][np.abs(homes[can]).max(1).argmin()])
        if good.sum() >= views:
            break
    else:
        raise RuntimeError("no cell within reach")
    return _recorded(arm, eye_in_hand, q[good][:views], hand_eye, part_pose, on_the_fly, rng)


def _recorded(
    arm: str, eye_in_hand: bool, q: Array, hand_eye: Array, part_pose: Array, on_the_fly: bool, rng: np.random.Generator
) -> Cell:
    """The cell with its order of views, times and what is recorded beside them."""
    views = len(q)
    if rng.random() < 0.5:
        order = [0]
        while len(order) < views:
            left = [view for view in range(views) if view not in order]
            order.append(min(left, key=lambda view: np.abs(q[view] - q[order[-1]]).max()))
        q = q[order]
    moves = np.diff(q, axis=0, prepend=q[:1] - rng.uniform(-0.5, 0.5, 6))
    wait = np.clip(rng.lognormal(2.2, 0.7, views), 2, 60)
    pause = np.where((np.arange(views) == views // 2) & (rng.random() < 0.5), 1500, 0)
    time = np.cumsum(15 + 20 * np.abs(moves).max(1) + wait + pause)
    time -= time[0]
    room = 20 + rng.uniform(-1, 2) + rng.uniform(-3, 6) * time / 3600
    room = room + rng.uniform(0.5, 2) * np.sin(2 * np.pi * time / rng.uniform(1500, 4000) + rng.uniform(0, 6))
    warming = rng.uniform(0.2, 1)
    columns = {
        "ambient_temperature_c": room,
        "robot_temperature_c": room + 14 - 12 * warming * np.exp(-time / 1500),
        "scanner_temperature_c": room + 12 - 8 * warming * np.exp(-time / 900) + rng.normal(0, 0.2, views),
        "supply_pressure_bar": 6 + rng.normal(0, 0.15, views),
        "wait_s": wait,
    }
    velocities = rng.normal(0, 0.07, (views, 6)) if on_the_fly else np.zeros((views, 6))
    return Cell(arm, eye_in_hand, q, hand_eye, part_pose, time, moves, velocities, columns)


def surface(places: Array) -> Array:
    """Return the egg's function at points (N, 3) of the part frame: zero on its surface, above it outside."""
    radius = np.linalg.norm(places, axis=-1)
    x, y, z = np.moveaxis(places / radius[..., None], -1, 0)
    bumps = 1 + 0.06 * np.sin(4 * x + 1) * np.cos(3 * y - 0.5) + 0.05 * x * y + 0.03 * np.sin(3 * x - 2 * y + z)
    return radius * np.sqrt(((np.stack([x, y, z], -1) / SEMI_AXES) ** 2).sum(-1)) / bumps - 1


def normals_at(places: Array) -> Array:
    """Return unit normals of the egg."""
    step = 1e-3 * np.eye(3)
    slope = np.stack([surface(places + s) - surface(places - s) for s in step], -1)
    return slope / np.linalg.norm(slope, axis=-1, keepdims=True)


def scan(cell: Cell, pose: Array, noise: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return points and normals of the egg in the scanner frame, ray by ray; `pose` is T_scanner_part."""
    grid = np.linspace(-FIELD, FIELD, RAYS) + rng.uniform(-0.5, 0.5) * 2 * FIELD / RAYS
    across, down = (axis.ravel() for axis in np.meshgrid(grid, grid))
    rays = np.c_[across, down, np.ones(RAYS**2)]
    rays = rays[across**2 + down**2 < FIELD**2]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    inverse = np.linalg.inv(pose)
    origin, ways = inverse[:3, 3], rays @ inverse[:3, :3].T
    distance = np.full(len(rays), np.linalg.norm(origin) - 95)
    for _ in range(12):
        here = surface(origin + distance[:, None] * ways)
        slope = (surface(origin + (distance + 0.01)[:, None] * ways) - here) / 0.01
        distance -= np.clip(here / np.where(np.abs(slope) > 1e-4, slope, -1e-4), -15, 15)
    places = origin + distance[:, None] * ways
    normals = normals_at(places)
    cosine = -(normals * ways).sum(1)
    hit = (np.abs(surface(places)) < 1e-9) & (cosine > STEEPEST)
    distance, rays, cosine, normals = distance[hit], rays[hit], cosine[hit], normals[hit]
    exact = distance[:, None] * rays
    error = sum((law(exact, cosine) for law in cell.ranges), rng.normal(0, noise, len(rays)))
    seen_normals = normals @ pose[:3, :3].T + rng.normal(0, 5e-3, normals.shape)
    return exact + error[:, None] * rays, seen_normals / np.linalg.norm(seen_normals, axis=1, keepdims=True)


def hide(cell: Cell, law: Any, times: float, rng: np.random.Generator) -> SimpleNamespace:
    """Put geometry, law and scatter into the cell; return what is true of it.

    The true hand-eye without a model is the one at the mean of all errors but the scatter: what the best linear
    estimate over these views, which knows the scatter's covariance, makes of them in hand-eye and place of the part.
    `visible` is what that leaves of the law, rms of a place in mm. Beside a model of the law it is moved by what the
    law does between the reported flange and the scanner, in the mean or last view; part and optics do not move it.
    """
    directions = rng.standard_normal((12, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    body = directions / (1 + surface(directions))[:, None]
    perfect = _as_seen(cell, body)
    twists = rng.standard_normal((6, 1, 6)) * [1e-5, 1e-5, 1e-5, 1e-2, 1e-2, 1e-2]
    points = chain(cell.arm)[1:, None, :3, 3]
    points[-1] = points[-2]
    twists[..., 3:] -= np.cross(twists[..., :3], points)
    cell.links += twists
    cell.links += twists * (GEOMETRY / _rms(_as_seen(cell, body) - perfect) - 1)
    without, still = _as_seen(cell, body), cell.scanner_seen()
    where = law.act(cell, law.size * times, rng) or 0
    seen = _as_seen(cell, body)
    by_joint = []
    for joint, share in enumerate(SHARES):
        cell.joints[:, joint] += 1e-4
        by_joint.append((_as_seen(cell, body) - seen) / 1e-4 * share)
        cell.joints[:, joint] -= 1e-4
    scatter = SCATTER * rng.uniform(0.7, 1.3)
    size = scatter / np.sqrt(sum(_rms(shift) ** 2 for shift in by_joint))
    pose, steps, views = cell.scanner_part(), motion(-1e-4 * np.eye(6)), len(cell.q)
    moved = [_as_seen(cell, body, step @ pose) for step in steps]
    moved += [_as_seen(cell, body, pose @ step) for step in steps]
    jacobian = np.stack([(places - seen).reshape(views, -1) / 1e-4 for places in moved], -1)
    shifts = np.stack([(seen - start).reshape(views, -1) for start in (perfect, without)], -1)
    columns = size * np.stack([shift.reshape(views, -1) for shift in by_joint], -1)
    whiten = np.linalg.inv(np.linalg.cholesky(columns @ columns.swapaxes(1, 2) + SCATTER**2 * np.eye(3 * len(body))))
    best = np.linalg.lstsq((whiten @ jacobian).reshape(-1, 12), (whiten @ shifts).reshape(-1, 2), rcond=None)[0]
    visible = _rms((shifts - jacobian @ best)[..., 1].reshape(views, -1, 3))
    moving = np.linalg.inv(cell.hand_eye) @ (cell.scanner_seen() - still)
    turning = (moving - moving.swapaxes(1, 2))[:, (2, 0, 1), (1, 2, 0)] / 2
    modelled = np.c_[turning, moving[:, :3, 3]] + best[:6, 0] - best[:6, 1]
    cell.joints += rng.standard_normal(cell.q.shape) * size * SHARES
    known = {"plain": best[:6, 0], "mean": modelled.mean(0), "last": modelled[-1], "nominal": np.zeros(6)}
    poses = {name: cell.hand_eye @ motion(twist) for name, twist in known.items()}
    return SimpleNamespace(where=where, poses=poses, visible=visible, scatter=scatter)


def _rms(shifts: Array) -> float:
    return float(np.sqrt((shifts**2).sum(-1).mean()))


def _as_seen(cell: Cell, body: Array, poses: Array | None = None) -> Array:
    """Places of the body (V, N, 3) in the scanner frame, with the errors of its ranges."""
    pose = cell.scanner_part() if poses is None else poses
    places = body @ pose[:, :3, :3].swapaxes(1, 2) + pose[:, None, :3, 3]
    rays = places / np.linalg.norm(places, axis=-1, keepdims=True)
    cosine = np.maximum(-(rays * (normals_at(body) @ pose[:, :3, :3].swapaxes(1, 2))).sum(-1), STEEPEST)
    return places + sum((law(places, cosine)[..., None] * rays for law in cell.ranges), np.zeros(1))


def write(cell: Cell, kind: str, folder: Path, rng: np.random.Generator) -> None:
    """Write the session that a user of the cell has."""
    noise = float(rng.uniform(0.01, 0.03) if kind == "clouds" else rng.uniform(0.008, 0.015))
    poses = cell.scanner_part()
    names = [f"v{view:03d}" for view in range(len(poses))]
    folder.mkdir(parents=True)
    mount = "eye_in_hand" if cell.eye_in_hand else "eye_to_hand"
    text = f'format = "stitch-session/1"\nname = "{folder.name}"\nlength_unit = "mm"\nmount = "{mount}"\n[scanner]\n'
    if rng.random() < 0.7:
        rough = cell.hand_eye @ motion(np.r_[rng.normal(0, 0.005, 3), rng.normal(0, 2, 3)])
        text += f"pose = {rough.tolist()}\n"
    if kind == "clouds" and rng.random() < 0.5:
        text += f"noise = {noise:.3f}\nstandoff = 400.0\n"
    text += f'[robot]\nname = "{cell.arm}"\ndh = "standard"\njoints = [\n'
    for a, alpha, d, mass, *com in ARMS[cell.arm].tolist():
        text += f"{{ a = {a}, alpha_deg = {alpha}, d = {d}, theta_deg = 0, mass = {mass}, com = {com} }},\n"
    text += "]\n" + ("repeatability = { position = 0.05 }\n" if rng.random() < 0.5 else "")
    (folder / "session.toml").write_text(text, encoding="utf-8")
    columns: dict[str, Any] = {"view": names, "time_s": cell.time, **cell.columns}
    columns |= {f"j{k + 1}_deg": np.degrees(cell.q[:, k]) for k in range(6)}
    if cell.velocities.any():
        columns |= {f"j{k + 1}_velocity_deg_s": np.degrees(cell.velocities[:, k]) for k in range(6)}
    if kind == "clouds":
        columns["cloud"] = [f"clouds/{name}.ply" for name in names]
        (folder / "clouds").mkdir()
        for file, pose in zip(columns["cloud"], poses, strict=True):
            points = np.hstack(scan(cell, pose, noise, rng))
            head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
            head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
            (folder / file).write_bytes((head + "end_header\n").encode() + points.astype("<f4").tobytes())
    else:
        rows = ((names[view], f"ball{ball}", *place, noise) for view, ball, place in balls(cell, poses, noise, rng))
        _write_csv(folder / "points.csv", ["view", "target", "x", "y", "z", "sigma"], rows)
    _write_csv(folder / "views.csv", list(columns), zip(*columns.values(), strict=True))


def balls(cell: Cell, poses: Array, noise: float, rng: np.random.Generator) -> list[tuple[int, int, Array]]:
    """Return view, ball and place in the scanner frame of the balls in its field."""
    count = int(rng.integers(5, 11))
    centres = np.c_[rng.uniform(-90, 90, (count, 2)), rng.uniform(-40, 40, count)]
    exact = centres @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    distance = np.linalg.norm(exact, axis=-1)
    error = sum((law(exact, np.ones(exact.shape[:2])) for law in cell.ranges), np.zeros(exact.shape[:2]))
    seen = exact * (1 + error / distance)[..., None] + rng.normal(0, noise, exact.shape)
    inside = np.hypot(exact[..., 0], exact[..., 1]) < FIELD * exact[..., 2]
    return [(view, ball, seen[view, ball]) for view, ball in np.argwhere(inside)]


def _write_csv(file: Path, head: list[str], rows: Any) -> None:
    lines = [",".join(cell if isinstance(cell, str) else f"{cell:.7f}" for cell in row) for row in rows]
    file.write_text("\n".join([",".join(head), *lines]) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class Law:
    """One physical error."""

    place: str  # base, joint, link, mount, part or scanner
    follows: str  # a column of views.csv, or in words
    size: float  # usual
    unit: str  # of the size, with what it is the size of
    textbook: bool
    act: Callable[[Cell, float, np.random.Generator], int | None]  # the law in the cell; which joint, link or view
    clouds_only: bool = False


def _pedestal(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.base[:, 5] += size * (cell.columns["ambient_temperature_c"] - 20)


def _press(cell: Cell, size: float, rng: np.random.Generator) -> None:
    direction, period = rng.uniform(0, 2 * np.pi), rng.uniform(400, 900)
    wave = size * np.sin(2 * np.pi * cell.time / period + rng.uniform(0, 2 * np.pi))
    cell.base[:, :2] += wave[:, None] * [np.cos(direction), np.sin(direction)]


def _spring(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint = int(rng.integers(2, 4))
    cell.joints[:, joint - 1] += size * cell.torques[:, joint - 1]
    return joint


def _any_joint(cell: Cell, rng: np.random.Generator, first: int = 1, last: int = 6) -> tuple[int, float]:
    joint = int(rng.integers(first, last + 1))
    return joint, WRIST if joint > 3 else 1.0


def _code_disc(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, factor = _any_joint(cell, rng)
    cell.joints[:, joint - 1] += size * factor * np.sin(cell.q[:, joint - 1] + rng.uniform(0, 2 * np.pi))
    return joint


def _backlash(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, factor = _any_joint(cell, rng)
    cell.joints[:, joint - 1] -= size * factor / 2 * np.sign(cell.moves[:, joint - 1])
    return joint


def _late_clock(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.joints += size * cell.velocities


def _wrist_coupling(cell: Cell, size: float, rng: np.random.Generator) -> int:
    cell.joints[:, 5] += size * cell.q[:, 4]
    return 6


def _brake(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, _ = _any_joint(cell, rng, 1, 3)
    cell.joints[:, joint - 1] -= size * (cell.columns["wait_s"] > 15)
    return joint


def _creeps_in(cell: Cell, size: float, rng: np.random.Generator) -> int:
    joint, factor = _any_joint(cell, rng)
    left = np.exp(-cell.columns["wait_s"] / 8)
    cell.joints[:, joint - 1] -= size * factor * cell.moves[:, joint - 1] * left
    return joint


def _warm_link(cell: Cell, size: float, rng: np.random.Generator) -> int:
    link = int(rng.integers(2, 4))
    along = cell.link_vectors[link - 1]
    cell.links[link - 1, :, 3:] += size * (cell.columns["robot_temperature_c"][:, None] - 22) * along
    return link


def _droop(cell: Cell, size: float, rng: np.random.Generator) -> None:
    down = cell.down_in_flange
    cell.mount[:, :3] += size * np.cross([0, 0, 1], down)
    cell.mount[:, 3:5] += size * 40 * down[:, :2]


def _hose(cell: Cell, size: float, rng: np.random.Generator) -> int:
    angle = cell.q[:, 5] * rng.choice([-1, 1])
    slack = np.median(angle)
    cell.mount[:, 0] += size * np.maximum(angle - slack, 0) / np.ptp(angle)
    return 6


def _loose_bolt(cell: Cell, size: float, rng: np.random.Generator) -> None:
    seat = np.sign(cell.down_in_flange[0, 1])
    for view, side in enumerate(cell.down_in_flange[:, 1]):
        seat = np.sign(side) if abs(side) > 0.15 else seat
        cell.mount[view] += seat * size * np.array([0, 0, 1.5e-3, 0, 1, 0])


def _direction(rng: np.random.Generator) -> np.ndarray:
    direction = rng.standard_normal(3)
    return direction / np.linalg.norm(direction)


def _knock(cell: Cell, size: float, rng: np.random.Generator) -> int:
    views = len(cell.q)
    first = int(rng.integers(views // 4, views * 3 // 4 + 1))
    cell.stand[first:] += np.r_[1.5e-3 * size * _direction(rng), size * _direction(rng)]
    return first


def _glue(cell: Cell, size: float, rng: np.random.Generator) -> None:
    way = np.log1p(cell.time / 60) / np.log1p(cell.time[-1] / 60)
    cell.part[:, 3:] += size * way[:, None] * _direction(rng)


def _clamp(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.part[:, 3:] += size * (cell.columns["supply_pressure_bar"][:, None] - 6) * _direction(rng)


def _bowl(cell: Cell, size: float, rng: np.random.Generator) -> None:
    edge = FIELD**2
    cell.ranges.append(lambda p, cosine: size * (p[..., 0] ** 2 + p[..., 1] ** 2) / p[..., 2] ** 2 / edge)


def _steep(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.ranges.append(lambda p, cosine: size * (1 / cosine - 1))


def _warm_scanner(cell: Cell, size: float, rng: np.random.Generator) -> None:
    warm = cell.columns["scanner_temperature_c"] - 30
    cell.stand += size * warm[:, None] * [0, 1, 0, 200, 0, 0]


def _far_and_near(cell: Cell, size: float, rng: np.random.Generator) -> None:
    cell.ranges.append(lambda p, cosine: size * ((p[..., 2] - 400) / 50) ** 2)


LAWS = {
    "pedestal grows with the room": Law(
        "base", "ambient_temperature_c", 9.2e-3, "mm/K, 0.8 m of steel", True, _pedestal
    ),
    "press next door rocks the base": Law("base", "time_s", 4e-5, "rad, in waves of 400 to 900 s", False, _press),
    "joint gives way to the load": Law("joint", "gravity", 1e-4, "rad at the largest static torque", True, _spring),
    "code disc off its centre": Law("joint", "own angle", 5e-5, "rad, once a turn", True, _code_disc),
    "play in a gear": Law("joint", "approach", 1e-4, "rad, lost motion", True, _backlash),
    "poses read late in motion": Law("joint", "velocity", 5e-4, "s", True, _late_clock),
    "joint 5 turns joint 6": Law("joint", "j5_deg", 3e-4, "rad/rad", False, _wrist_coupling),
    "brake falls in after a wait": Law("joint", "wait_s", 6e-5, "rad from 15 s on", False, _brake),
    "coupling creeps in behind a move": Law("joint", "move, wait_s", 2e-4, "rad/rad, fading in 8 s", False, _creeps_in),
    "one link grows warm": Law("link", "robot_temperature_c", 1.15e-5, "1/K of its length", True, _warm_link),
    "adapter droops at the flange": Law("mount", "gravity", 2e-4, "rad where horizontal", True, _droop),
    "hose pulls once it is taut": Law("mount", "j6_deg", 3e-4, "rad at the end of the range", False, _hose),
    "loose bolt with two seats": Law("mount", "gravity", 0.04, "mm from the middle to a seat", False, _loose_bolt),
    "scanner is knocked": Law("scanner", "view", 0.08, "mm, and 1.5 mrad for a mm", True, _knock),
    "glue creeps under the part": Law("part", "time_s", 0.08, "mm over the session, a logarithm", False, _glue),
    "clamp follows the air supply": Law("part", "supply_pressure_bar", 0.25, "mm/bar", False, _clamp),
    "field of the scanner is a bowl": Law("scanner", "field", 0.05, "mm at the field's edge", True, _bowl),
    "steep surfaces look farther": Law("scanner", "incidence", 0.025, "mm at 60 degrees", False, _steep, True),
    "scanner's axis drifts as it warms": Law("scanner", "scanner_temperature_c", 4e-5, "rad/K", True, _warm_scanner),
    "near and far look farther": Law("scanner", "distance", 0.025, "mm at 50 mm from the middle", False, _far_and_near),
    "nothing": Law("", "", 0.0, "", True, lambda cell, size, rng: None),
}
