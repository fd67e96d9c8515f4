"""Where a scan closes among the others: at places that look alike, and together with its group."""

import numpy as np
import pytest
from pykdtree.kdtree import KDTree

from stitch.numerics import frames
from stitch.screening.linkage import Link, linkage_of_links
from stitch.screening.placement import ReferenceSurface, closed_placements, has_rival, place_groups, place_scan
from stitch.session.scan import prepare_scan

SIZE = 120.0
SLIP = np.array([0.004, -0.003, 0.005, 2.0, -2.0, 1.0])


def turned(degrees):
    return frames.exp(np.array([0, 0, np.radians(degrees), 0, 0, 0]))


def shown(height, low, high, count):
    """Points and normals of a wall of radius 50 + height(angle), between two angles in degrees."""
    rng, step = np.random.default_rng(0), 1e-6
    angle, z = np.radians(rng.uniform(low, high, count)), rng.uniform(-30, 30, count)
    around, out = np.array([np.cos(angle), np.sin(angle)]), 50 + height(angle)
    slope = (height(angle + step) - height(angle - step)) / (2 * step)
    normal = out * around - slope * np.array([-np.sin(angle), np.cos(angle)])
    points = np.column_stack([*(out * around), z])
    return points, np.column_stack([*(normal / np.linalg.norm(normal, axis=0)), 0 * z])


@pytest.mark.parametrize(
    ("height", "alike"),
    [
        (lambda t: 1.5 * np.cos(24 * t), True),
        (lambda t: 8 * np.exp(-(((t - 1.5) / 0.2) ** 2)) + 1.5 * np.cos(3 * t), False),
    ],
)
def test_places_that_are_alike_are_rivals(height, alike):
    points, normals = shown(height, 0, 180, 12_000)
    surface = ReferenceSurface(points, normals, KDTree(points), 1.0, 0.3)
    scan = prepare_scan("view", shown(height, 60, 110, 4_000)[0], eye=np.array([0, 300.0, 0]))
    found = place_scan(scan, surface, np.array([turned(a) for a in (-30, -15, 0, 15, 30)]), SIZE)
    closed = closed_placements(scan, found, turned(-95)[None], (0.8, SIZE))
    assert closed and has_rival(scan, closed[0], closed, SIZE) == alike


def test_a_group_moves_back_as_one(blade_capture):
    measured, capture = blade_capture
    poses = capture.poses(measured.T_mount)
    views, half = len(poses), len(poses) // 2
    apart = poses.copy()
    apart[half:] = frames.exp(SLIP) @ poses[half:]
    chains = [range(half), range(half, views)]
    linked = linkage_of_links(views, [Link(v, v + 1, 100, 1.0) for chain in chains for v in chain[:-1]])
    placed = place_groups(capture, apart, linked, (0.1, 0.7))
    moved, kept = (placed, set(range(views)) - set(placed))
    assert set(moved) in (set(chains[0]), set(chains[1]))
    # One common motion brings them back to the others, which stay where they are.
    stay = min(kept)
    G = apart[stay] @ frames.inverse(poses[stay])
    for v, placement in placed.items():
        middle = capture.scans[v].points.mean(axis=0)[None]
        off = frames.transform(placement.T, middle) - frames.transform(G @ poses[v], middle)
        assert np.linalg.norm(off) < 0.15
