"""What register moves along a surface that slides on itself is known to mean nothing."""

import numpy as np

from stitch.fusion.register import Registration, unseen_moves
from stitch.numerics import frames
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.session.capture import build_capture
from stitch.session.scan import prepare_scan

RADIUS, CENTRE = 30.0, np.array([0.0, 0.0, 400.0])
# A radian about the middle of the scanned cap, which lies beside the ball's own, also shifts it.
TURN = np.array([0.02, -0.01, 0.0, 0.005])


def seen_from_one_place(surface):
    """Four scans of a surface, drawn anew for each (N, 3), their poses and overlaps."""
    rng = np.random.default_rng(2)
    scans = [prepare_scan(f"v{v}", p + 0.01 * rng.standard_normal(p.shape)) for v, p in enumerate(surface(rng))]
    poses = np.tile(np.eye(4), (4, 1, 1))
    capture = build_capture("s", scans, poses, "eye_in_hand")
    return poses, collect_overlaps(capture, poses, 2.0, [sample_points(scan, 2000) for scan in scans])


def ball(rng):
    for away in rng.standard_normal((4, 4000, 3)):
        away /= np.linalg.norm(away, axis=1)[:, None]
        yield CENTRE + RADIUS * away[away[:, 2] < -0.3]


def wave(rng):
    for x, y in rng.uniform(-30, 30, (4, 2, 4000)):
        yield CENTRE + np.column_stack([x, y, 6 * np.sin(x / 6) * np.cos(y / 8)])


def moved(surface, twists):
    poses, overlaps = seen_from_one_place(surface)
    middle = frames.make(np.eye(3), CENTRE)
    return unseen_moves(Registration(middle @ frames.exp(twists) @ frames.inverse(middle) @ poses, overlaps, ()), poses)


def test_turns_of_a_ball_about_its_middle_are_not_seen():
    turned = moved(ball, np.column_stack([TURN, np.zeros((4, 5))]))
    expected = np.abs(TURN - TURN.mean())
    np.testing.assert_allclose(turned / turned.max(), expected / expected.max(), rtol=0.02)
    assert turned.max() > 0.1


def test_moves_of_a_wave_are_seen():
    assert moved(wave, np.tile(TURN[:, None], (1, 6))).max() == 0
