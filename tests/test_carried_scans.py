"""Real scans that every clone carries: nine views of a cube, no hand-eye given; and the hand-eye by another object."""

from pathlib import Path

import numpy as np
import pytest

from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.session.reading.session_folder import load_session

CARRIED = Path(__file__).parent / "data" / "reghec-rubik"
# Of the same rig, from all points of another object, a bust: T_flange_scanner, mm, and sigmas, rad and mm.
BUST = np.array(
    [
        [0.694465, -0.711434, -0.107613, 72.2710],
        [0.707789, 0.702357, -0.075691, -34.7726],
        [0.129432, -0.023603, 0.991307, 60.0144],
        [0, 0, 0, 1],
    ]
)
SIGMAS = np.array([0.0026, 0.0031, 0.0015, 0.90, 0.89, 0.60])


def test_real_scans_give_the_hand_eye_that_another_object_gives():
    """The one test of `make test` that stitches real scans from nothing: five seconds."""
    result = run(load_session(CARRIED))
    assert not result.left_out
    # An independent study reached 0.10 to 0.16 mm after registration.
    assert result.stages[2].rms < 0.16
    off = frames.log(frames.inverse(result.T_mount) @ BUST)
    # χ² of 6, chance 1e-3.
    assert off @ np.linalg.solve(result.mount_covariance + np.diag(SIGMAS**2), off) < 22.5


def test_the_carried_scans_are_every_fifth_point_of_the_published_ones(reghec):
    full, thin = load_session(reghec("rubik")), load_session(CARRIED)
    for published, carried in zip(full.views, thin.views, strict=True):
        assert carried.cloud.points == pytest.approx(published.cloud.points[::5], abs=1e-9)
