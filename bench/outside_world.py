"""A robot cell by NumPy alone: an arm by products of exponentials, a scanner, a part by a formula, one hidden error.

It shares no code with stitch nor with data_synth. Two arms, a wrist of parallel offsets and a spherical one, each with
its scatter and a little geometry of its own; labelled balls or the scans of a bumpy egg, ray by ray. A session is what
a user has: joint angles and the columns that a cell records. Lengths in mm, angles in rad.
"""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from bench.outside_laws import Law

Array = np.ndarray
# Rows: a, alpha (degrees), d, mass in kg, centre of mass in the link's own frame.
ARMS = {
    "offset wrist": [
        (0, 90, 181, 7.4, (0, -20, 3)),
        (-613, 0, 0, 13.0, (290, 0, 160)),
        (-572, 0, 0, 4.1, (250, 0, 50)),
        (0, 90, 174, 2.1, (0, -18, 6)),
        (0, -90, 120, 2.0, (0, 18, 6)),
        (0, 0, 117, 0.6, (0, 0, -25)),
    ],
    "spherical wrist": [
        (260, -90, 675, 60, (-120, 90, 0)),
        (680, 0, 0, 40, (-330, 0, 60)),
        (35, -90, 0, 35, (0, 0, 40)),
        (0, 90, 670, 12, (0, -150, 0)),
        (0, -90, 0, 5, (0, 0, 10)),
        (0, 0, 158, 1.5, (0, 0, -30)),
    ],
}
GRAVITY = np.array([0, 0, -9.81])
FIELD = np.tan(np.radians(18))
STANDOFF = (355, 445)
SEMI_AXES = np.array([85, 65, 50])
RAYS = 78  # a side of the scanner's grid
STEEPEST = np.cos(np.radians(65))
SCATTER = 0.02  # rms displacement at the part of an ordinary arm
GEOMETRY = 0.02  # the same of its lengths and zeros, most of it without effect on the scans


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
    columns: dict[str, Array]
    edge: float = FIELD
    ranges: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin with a perfect cell."""
        views = len(self.q)
        self.base, self.mount, self.stand, self.part, self.joints = (np.zeros((views, 6)) for _ in range(5))
        self.links = np.zeros((6, views, 6))
        _, points, _, _ = chain(self.arm)
        self.link_vectors = np.vstack([np.diff(points, axis=0), np.zeros(3)])
        flange, links = forward(self.arm, self.q)
        self.down_in_flange = -flange[:, 2, :3]
        centres = np.array([[*row[4], 1.0] for row in ARMS[self.arm]])
        masses = np.array([row[3] for row in ARMS[self.arm]])
        places = np.einsum("kvij,kj->kvi", links[1], centres)[..., :3]
        self.torques = np.zeros((views, 6))
        for joint in range(6):
            lever = places[joint:] - links[0][joint][:, :3, 3]
            moment = np.cross(lever, masses[joint:, None, None] * GRAVITY * 1e-3).sum(0)
            self.torques[:, joint] = (moment * links[0][joint][:, :3, 2]).sum(1)
        self.largest_torque = np.array([(masses[k:] * 9.81e-3).sum() * 600 for k in range(6)])

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


def chain(arm: str) -> tuple[Array, Array, Array, Array]:
    """Return axes (6, 3), points on them (6, 3), frames of the links (6, 4, 4) and the flange (4, 4), all at zero."""
    frames = [np.eye(4)]
    for a, alpha, d, _, _ in ARMS[arm]:
        cosine, sine = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        frames.append(frames[-1] @ [[1, 0, 0, a], [0, cosine, -sine, 0], [0, sine, cosine, d], [0, 0, 0, 1]])
    at = np.array(frames)
    return at[:-1, :3, 2], at[:-1, :3, 3], at[1:], at[-1]


def forward(arm: str, q: Array, links: Array | None = None) -> tuple[Array, tuple[Array, Array]]:
    """Return T_base_flange (V, 4, 4), and the frames before and behind each joint (6, V, 4, 4)."""
    axes, points, frames, flange = chain(arm)
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    start = [np.eye(4), *frames[:-1]]
    before, behind = [], []
    for joint, (axis, point) in enumerate(zip(axes, points, strict=True)):
        before.append(pose @ start[joint])
        pose = pose @ motion(q[:, joint, None] * np.r_[axis, np.cross(point, axis)])
        behind.append(pose @ frames[joint])
        if links is not None:
            pose = pose @ motion(links[joint])
    return pose @ flange, (np.array(before), np.array(behind))


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
    roll = rng.uniform(-1.8, 1.8, count)
    axis = np.c_[np.cos(turn) * tilt, np.sin(turn) * tilt, 0 * turn]
    about_z = np.c_[0 * roll, 0 * roll, roll]
    still = np.zeros((count, 3))
    pose = motion(np.c_[axis, still]) @ motion(np.c_[about_z, still])
    # The scanner's z axis looks at the part, whose z axis looks back.
    facing = np.diag([1.0, -1, -1, 1]) @ pose.swapaxes(1, 2)
    facing[:, :3, 3] = np.c_[rng.uniform(-15, 15, (count, 2)), rng.uniform(*STANDOFF, count)]
    facing[:, 3, :3] = 0
    return facing


def rotation(*rotation_vector: float) -> Array:
    """Return a pose (4, 4) that turns."""
    return motion(np.r_[rotation_vector, 0, 0, 0])


def build(kind: str, on_the_fly: bool, rng: np.random.Generator) -> Cell:
    """Return a cell whose views a user would take, without any error."""
    eye_in_hand = bool(rng.random() < 0.55)
    tilt = rotation(*rng.uniform(-0.3, 0.3, 3))
    shift = np.eye(4)
    for _ in range(50):
        arm = str(rng.choice(list(ARMS)))
        if eye_in_hand:
            shift[:3, 3] = rng.uniform([-60, 40, 60], [60, 120, 140])
            hand_eye = shift @ tilt
            part_pose = rotation(*rng.uniform(-0.2, 0.2, 3))
            part_pose[:3, 3] = rng.uniform([650, -250, 0], [850, 250, 200])
        else:
            hand_eye = rotation(0, -np.pi / 2, 0) @ tilt
            hand_eye[:3, 3] = rng.uniform([1250, -200, 600], [1400, 200, 900])
            shift[:3, 3] = rng.uniform([-30, -30, 120], [30, 30, 180])
            part_pose = shift @ rotation(*rng.uniform(-0.3, 0.3, 3))
        views = int(rng.integers(12, 17) if kind == "clouds" else rng.choice([10, 14, 18, 25, 40, 60]))
        seen = looks(rng, 6 * views)
        seen[0, :3, :3] = np.diag([1, -1, -1])
        inverse = np.linalg.inv(seen)
        flange = part_pose @ inverse @ np.linalg.inv(hand_eye)
        if not eye_in_hand:
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


def hide(cell: Cell, law: Law, times: float, rng: np.random.Generator) -> SimpleNamespace:
    """Put geometry, law and scatter into the cell; return what is true of it.

    The true hand-eye without a model is the one at the mean of all errors but the scatter: what the best linear
    estimate over these views, which knows the scatter's covariance, makes of them in hand-eye and place of the part.
    `visible` is what that leaves of the law, rms of a place in mm. Beside a model of the law it is moved by what the law
    does between the reported flange and the scanner, in the mean or in the last view; part and optics do not move it.
    """
    directions = rng.standard_normal((12, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    body = directions / (1 + surface(directions))[:, None]
    perfect = _as_seen(cell, body)
    _give_geometry(cell, body, rng)
    without, still = _as_seen(cell, body), cell.scanner_seen()
    where = law.act(cell, law.size * times, rng)
    seen = _as_seen(cell, body)
    by_joint = []
    for joint in range(6):
        cell.joints[:, joint] += 1e-4
        by_joint.append((_as_seen(cell, body) - seen) / 1e-4 * (1 if joint < 3 else 2))
        cell.joints[:, joint] -= 1e-4
    scatter = SCATTER * rng.uniform(0.7, 1.3)
    size = scatter / np.sqrt(sum(_rms(shift) ** 2 for shift in by_joint))
    views = len(cell.q)
    columns = size * np.stack([shift.reshape(views, -1) for shift in by_joint], -1)
    whiten = np.linalg.inv(np.linalg.cholesky(columns @ columns.swapaxes(1, 2) + SCATTER**2 * np.eye(3 * len(body))))
    pose, steps = cell.scanner_part(), motion(-1e-4 * np.eye(6))
    moved = [_as_seen(cell, body, step @ pose) for step in steps] + [
        _as_seen(cell, body, pose @ step) for step in steps
    ]
    jacobian = np.stack([(places - seen).reshape(views, -1) / 1e-4 for places in moved], -1)
    shifts = np.stack([(seen - start).reshape(views, -1) for start in (perfect, without)], -1)
    best = np.linalg.lstsq((whiten @ jacobian).reshape(-1, 12), (whiten @ shifts).reshape(-1, 2), rcond=None)[0]
    visible = _rms((shifts - jacobian @ best)[..., 1].reshape(views, -1, 3))
    moving = np.linalg.inv(cell.hand_eye) @ (cell.scanner_seen() - still)
    turning = (moving - moving.swapaxes(1, 2))[:, (2, 0, 1), (1, 2, 0)] / 2
    shifting = np.c_[turning, moving[:, :3, 3]]
    cell.joints += rng.standard_normal(cell.q.shape) * size * [1, 1, 1, 2, 2, 2]
    geometry = best[:6, 0] - best[:6, 1]
    twists = {"plain": best[:6, 0], "mean": geometry + shifting.mean(0), "last": geometry + shifting[-1]}
    poses = {name: cell.hand_eye @ motion(twist) for name, twist in twists.items()} | {"nominal": cell.hand_eye}
    return SimpleNamespace(where=where, poses=poses, visible=visible, scatter=scatter)


def _give_geometry(cell: Cell, body: Array, rng: np.random.Generator) -> None:
    """Give the arm a little geometry of its own: lengths, twists and zeros of its joints."""
    perfect = _as_seen(cell, body)
    _, points, _, _ = chain(cell.arm)
    twists = rng.standard_normal((6, 6)) * [1e-5, 1e-5, 1e-5, 1e-2, 1e-2, 1e-2]
    twists[:, 3:] -= np.cross(twists[:, :3], np.vstack([points[1:], points[-1:]]))
    cell.links += twists[:, None]
    cell.links += twists[:, None] * (GEOMETRY / _rms(_as_seen(cell, body) - perfect) - 1)


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
    lines = [
        'format = "stitch-session/1"',
        f'name = "{folder.name}"',
        'length_unit = "mm"',
        f'mount = "{"eye_in_hand" if cell.eye_in_hand else "eye_to_hand"}"',
        "[scanner]",
    ]
    if rng.random() < 0.7:
        rough = cell.hand_eye @ motion(np.r_[rng.normal(0, 0.005, 3), rng.normal(0, 2, 3)])
        lines.append(f"pose = {rough.tolist()}")
    if kind == "clouds" and rng.random() < 0.5:
        lines += [f"noise = {noise:.3f}", "standoff = 400.0"]
    lines += ["[robot]", f'name = "{cell.arm}"', 'dh = "standard"', "joints = ["]
    for a, alpha, d, mass, com in ARMS[cell.arm]:
        lines.append(f"{{ a = {a}, alpha_deg = {alpha}, d = {d}, theta_deg = 0, mass = {mass}, com = {list(com)} }},")
    lines.append("]")
    if rng.random() < 0.5:
        lines.append("repeatability = { position = 0.05 }")
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    columns = {"view": names, "time_s": cell.time, **cell.columns}
    columns |= {f"j{k + 1}_deg": np.degrees(cell.q[:, k]) for k in range(6)}
    if cell.velocities.any():
        columns |= {f"j{k + 1}_velocity_deg_s": np.degrees(cell.velocities[:, k]) for k in range(6)}
    if kind == "clouds":
        columns["cloud"] = [f"clouds/{name}.ply" for name in names]
        (folder / "clouds").mkdir()
        for name, pose in zip(names, poses, strict=True):
            _write_ply(folder / "clouds" / f"{name}.ply", np.hstack(scan(cell, pose, noise, rng)))
    else:
        _write_balls(cell, poses, names, noise, folder, rng)
    _write_csv(folder / "views.csv", list(columns), zip(*columns.values(), strict=True))


def _write_balls(
    cell: Cell, poses: Array, names: list[str], noise: float, folder: Path, rng: np.random.Generator
) -> None:
    count = int(rng.integers(5, 11))
    balls = np.c_[rng.uniform(-90, 90, (count, 2)), rng.uniform(-40, 40, count)]
    exact = balls @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    rays = exact / np.linalg.norm(exact, axis=-1, keepdims=True)
    error = sum((law(exact, np.ones(exact.shape[:2])) for law in cell.ranges), np.zeros(exact.shape[:2]))
    seen = exact + error[..., None] * rays + rng.normal(0, noise, exact.shape)
    inside = np.hypot(exact[..., 0], exact[..., 1]) < FIELD * exact[..., 2]
    rows = [(names[v], f"ball{b}", *seen[v, b], noise) for v, b in np.argwhere(inside)]
    _write_csv(folder / "points.csv", ["view", "target", "x", "y", "z", "sigma"], rows)


def _write_csv(file: Path, head: list[str], rows: Any) -> None:
    lines = [",".join(cell if isinstance(cell, str) else f"{cell:.7f}" for cell in row) for row in rows]
    file.write_text("\n".join([",".join(head), *lines]) + "\n", encoding="utf-8")


def _write_ply(file: Path, numbers: Array) -> None:
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(numbers)}"]
    head += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    file.write_bytes("\n".join([*head, "end_header", ""]).encode() + numbers.astype("<f4").tobytes())
