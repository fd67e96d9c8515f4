"""Scans of one sphere in a cell of known truth, by geometry alone."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames

RADIUS = 30.0


@dataclass(frozen=True)
class SphereCell:
    T_mount: np.ndarray  # true T_mount_scanner
    centre: np.ndarray  # in the reference frame
    G: np.ndarray  # (V, 4, 4) reported T_reference_mount
    clouds: list[np.ndarray]  # scanner frame


def line(centre, rng, noise):
    """Profile (N, 3) in the plane y = 0 of a sphere at `centre`, seen from −z."""
    rho = np.sqrt(RADIUS**2 - centre[1] ** 2)
    angle = np.linspace(-1.2, 1.2, 300)
    points = centre * [1, 0, 1] + rho * np.column_stack([np.sin(angle), 0 * angle, -np.cos(angle)])
    return points + rng.normal(0, noise, (len(points), 1)) * [0, 0, 1]


def area(centre, rng, noise):
    """Cap (N, 3) of a sphere at `centre`, seen from −z."""
    u = rng.normal(size=(2000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u = u[u[:, 2] < -0.5]
    return centre + u * (RADIUS + rng.normal(0, noise, (len(u), 1)))


def build(seed, kind="line", turns=0.5, poses=12, pose_noise=0.05, noise=0.01, pause=2, lever=200.0):
    """A cell: `pause` more positions of the first orientation, then `poses` orientations.

    Args:
        turns: sigma of the orientations' turns about each axis, rad.
        pose_noise: sigma per axis of the shift of the sphere in each view.
        lever: sigma of the hand-eye's translation.
    """
    rng = np.random.default_rng(seed)
    X = frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, lever, 3))
    centre = np.array([900.0, 100, 300]) + rng.normal(0, 50, 3)
    base = Rotation.random(rng=rng)
    spins = np.concatenate([np.zeros((pause, 3)), rng.normal(0, turns, (poses, 3)) * (np.arange(poses) > 0)[:, None]])
    count, scan = len(spins), line if kind == "line" else area
    R = (base * Rotation.from_rotvec(spins)).as_matrix()
    # Where the scanner is to see the centre; a line lies off the centre by a fifth to three fifths of the radius.
    seen = np.column_stack(
        [rng.uniform(-15, 15, count), rng.uniform(0.2, 0.6, count) * RADIUS, rng.uniform(60, 90, count)]
    )
    if kind == "area":
        seen = rng.uniform(-15, 15, (count, 3)) + np.array([0, 0, 100])
    in_mount = seen @ X[:3, :3].T + X[:3, 3]
    G = frames.make(R, centre - (R @ in_mount[..., None])[..., 0])
    shifts = rng.normal(0, pose_noise, (count, 3))
    clouds = [scan(q + X[:3, :3].T @ r.T @ d, rng, noise) for q, r, d in zip(seen, R, shifts, strict=True)]
    return SphereCell(X, centre, G, clouds)


def write(cell, folder, mount="eye_in_hand", radius=RADIUS, extra=None, unit="mm"):
    """A session folder of the cell; `extra` is a column name and its values."""
    (folder / "clouds").mkdir(parents=True)
    per = 1000.0 if unit == "m" else 1.0
    (folder / "session.toml").write_text(
        f'format = "stitch-session/1"\nname = "sphere"\nlength_unit = "{unit}"\nmount = "{mount}"\n[sphere]\nradius = {radius / per}\n'
    )
    T = cell.G if mount == "eye_in_hand" else frames.inverse(cell.G)
    rows = ["view,cloud,x,y,z,qx,qy,qz,qw" + (f",{extra[0]}" if extra else "")]
    for k, (pose, q, cloud) in enumerate(zip(T, frames.to_quaternion(T), cell.clouds, strict=True)):
        np.savetxt(folder / "clouds" / f"v{k}.xyz", cloud / per, fmt="%.9g")
        numbers = [f"{x:.12g}" for x in (*pose[:3, 3] / per, *q)] + ([str(extra[1][k])] if extra else [])
        rows.append(",".join([f"v{k}", f"clouds/v{k}.xyz", *numbers]))
    (folder / "views.csv").write_text("\n".join(rows) + "\n")
    return folder
