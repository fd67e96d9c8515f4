"""Labelled points on flanges that only turn, and on arms that err honestly; kinematics, errors and sightings are written
down here.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.session.session import Scanner, SessionData, Sighting, View

NOISE = 0.05  # mm, of a coordinate that the sensor shows
# Axes of the joints ("x" slides), and where each stands from the one before, mm; what nobody knows of the arm: offsets
# of joints (rad, of slides mm), turns (rad) and shifts (mm) of links, scatter of its poses (rad, mm).
WORLDS = {
    "cable arm": ("zyyzyz", [(0, 0, 300), (0, 0, 50), (0, 0, 350), (90, 0, 0), (230, 0, 0), (0, 0, 60)],
                  (2e-3, 1e-3, 0.5, 4e-3, 1.7)),
    "humanoid": ("yxzyzyx", [(0, 180, 0), (0, 30, 0), *[(0, 0, -120)] * 3, (0, 0, -100), (0, 0, -30)],
                 (8e-3, 3e-3, 1.0, 3e-3, 0.5)),
    "seven axes": ("zyzyzyz", [(0, 0, 340), (0, 0, 0), (0, 0, 400), (0, 0, 0), (0, 0, 400), (0, 0, 0), (0, 0, 126)],
                   (1e-3, 5e-4, 0.3, 1e-4, 0.08)),
    "uncalibrated": ("zyyxyx", [(0, 0, 400), (150, 0, 0), (0, 0, 600), (300, 0, 100), (300, 0, 0), (100, 0, 0)],
                     (3e-3, 2e-3, 2.0, 3e-5, 0.03)),
    "SCARA": ("zzZz", [(0, 0, 400), (325, 0, 0), (275, 0, 0), (0, 0, -100)], (3e-3, 1e-3, 0.5, 5e-5, 0.02)),
    "gantry": ("XYZzy", [(0, 0, 0), (0, 0, 0), (0, 0, 900), (0, 0, -50), (0, 0, -80)], (1e-3, 2e-3, 0.5, 5e-5, 0.3)),
}  # fmt: skip
BALLS = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0], [10.0, 5.0, 95.0]])


def pose(rotation_vector, shift):
    """(4, 4)."""
    return frames.make(Rotation.from_rotvec(rotation_vector).as_matrix(), shift)


def labelled_session(poses, seen, mount):
    """The session of flanges (4, 4) and of what each view shows (K, 3)."""
    names = tuple(f"t{k}" for k in range(len(seen[0])))
    of_views = (Sighting(names, points, np.full(len(points), NOISE)) for points in seen)
    views = [
        View(f"v{i}", None, T, None, None, None, {}, s) for i, (T, s) in enumerate(zip(poses, of_views, strict=True))
    ]
    scanner = Scanner(None, NOISE, None, np.array([0, 0, 1.0]))
    return SessionData(Path("arm"), "arm", "mm", mount, scanner, None, None, None, None, tuple(views))


def seen_by(true, X, places, mount, rng, noise=NOISE):
    """The targets (K, 3) in the sensor's frame, a view each."""
    to_sensor = [np.linalg.inv((T if mount == "eye_in_hand" else np.linalg.inv(T)) @ X) for T in true]
    return [places @ T[:3, :3].T + T[:3, 3] + noise * rng.normal(size=places.shape) for T in to_sensor]


def turning_session(targets, within, mount, seed=1):
    """A flange that turns at one place, or within some mm of it, and the true hand-eye (4, 4)."""
    rng = np.random.default_rng([66, seed, targets, int(within)])
    X = pose(Rotation.random(rng=rng).as_rotvec(), rng.normal(size=3) * (40 if mount == "eye_in_hand" else 800))
    board = np.stack(np.meshgrid(np.arange(11), np.arange(8), [0.0]), -1).reshape(-1, 3) * 20 - [100, 70, 0]
    if targets < 40:
        board = rng.uniform(-150, 150, (targets, 3))
    board = board[:targets]
    places = board + np.array([700, 50, 100]) if mount == "eye_in_hand" else board + np.array([20, -30, 90])
    flange, true = [], []
    for _ in range(19):
        tilt = rng.normal(size=3)
        shift = rng.normal(size=3)
        shift *= within * rng.uniform() / np.linalg.norm(shift)
        T = pose(tilt * rng.uniform(0.2, 0.7) / np.linalg.norm(tilt), np.array([700, 50, 500]) + shift) @ pose(
            [0, np.pi, 0], 0
        )
        flange.append(T)
        true.append(T @ pose(5e-5 * rng.normal(size=3), 0.03 * rng.normal(size=3)))
    return labelled_session(flange, seen_by(true, X, places, mount, rng), mount), X


def bad_arm(world, times, seed):
    """One of the worlds, its base moved from one view on by some times the arm's error: session and that view."""
    rng = np.random.default_rng([67, seed, list(WORLDS).index(world), int(10 * times)])
    axes, links, (offset, turn, shift, angle, length) = WORLDS[world]
    views, mount = int(rng.integers(10, 61)), ("eye_to_hand", "eye_in_hand")[int(rng.integers(2))]
    slides = np.array([axis.isupper() for axis in axes])
    off = np.concatenate([turn * rng.normal(size=(len(axes), 3)), shift * rng.normal(size=(len(axes), 3))], axis=1)
    wrong = rng.normal(size=len(axes)) * np.where(slides, 0.5, offset)
    X = pose(Rotation.random(rng=rng).as_rotvec(), rng.normal(size=3) * (60 if mount == "eye_in_hand" else 1500))
    joints = rng.uniform(-1.1, 1.1, (views, len(axes))) * np.where(slides, 250, 1)
    nominal = [_chain(axes, q, np.array(links, float), 0 * off) for q in joints]
    true = [
        _chain(axes, q + wrong, np.array(links, float), off)
        @ pose(angle * rng.normal(size=3), length * rng.normal(size=3))
        for q in joints
    ]
    places = BALLS if mount == "eye_to_hand" else BALLS + np.mean([T[:3, 3] for T in nominal], axis=0) + [0, 0, 300]
    start = int(rng.integers(views // 3, 2 * views // 3 + 1)) if times else views
    way = rng.normal(size=3)
    moved = times * _error(nominal, true)
    knock = pose(rng.normal(size=3) * moved / 2000, moved * way / np.linalg.norm(way))
    true = [*true[:start], *(knock @ T for T in true[start:])]
    return labelled_session(nominal, seen_by(true, X, places, mount, rng), mount), start


def _chain(axes, q, links, off):
    T = np.eye(4)
    for axis, angle, link, wrong in zip(axes, q, links, off, strict=True):
        along = np.eye(3)["xyz".index(axis.lower())]
        T = T @ pose(np.zeros(3), link) @ pose(wrong[:3], wrong[3:])
        T = T @ (pose(np.zeros(3), angle * along) if axis.isupper() else pose(angle * along, np.zeros(3)))
    return T


def _error(nominal, true):
    """How far the flange is off, rms (mm), under the rigid motion of the base that suits best."""
    there, stated = (np.array([T[:3, 3] for T in poses]) for poses in (true, nominal))
    _, rest = Rotation.align_vectors(there - there.mean(axis=0), stated - stated.mean(axis=0))
    return rest / np.sqrt(len(there))
