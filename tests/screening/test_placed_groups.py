"""Halves of a session that stand apart: each view alone may show too little of the others, all of them do not."""

import numpy as np

from stitch.numerics import frames
from stitch.screening.linkage import Link, linkage_of_links
from stitch.screening.placement import place_groups

SLIP = np.array([0.004, -0.003, 0.005, 2.0, -2.0, 1.0])


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
