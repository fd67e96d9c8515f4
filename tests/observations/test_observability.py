"""What the motions do not show, against the null space of all that a sensor sees, by finite differences."""

import numpy as np
import pytest

from bench.real_arms import labelled_session, pose, seen_by
from stitch.observations.observability import unobservable
from stitch.session.capture import prepare_capture

BALLS = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0], [10.0, 5.0, 95.0]])
ALL_ONE = "the axis about which all views were turned"


def cell(axis, tilt, moving, mount):
    """Flanges (V, 4, 4) that turn about one axis, and by `tilt` about any other, the hand-eye and the targets."""
    rng = np.random.default_rng(3)
    X = pose(rng.normal(size=3), 100 * rng.normal(size=3))
    turns = [np.eye(3)[axis] * rng.uniform(-1, 1) + tilt * rng.normal(size=3) for _ in range(12)]
    flange = [pose(turn, np.array([700, 50, 500.0]) + moving * rng.normal(size=3)) for turn in turns]
    return flange, X, BALLS if mount == "eye_to_hand" else BALLS + np.array([700, 50, 200])


def weakest(flange, X, places, mount):
    """The twist of the hand-eye (mount's axes, about the part) that changes what is seen least, targets free."""
    still = np.random.default_rng(0)
    shown = seen_by(flange, X, places, mount, still, noise=0.0)
    centre = np.mean(shown, axis=(0, 1))
    size = np.linalg.norm(places - places.mean(axis=0), axis=1).mean()
    about = pose(np.zeros(3), centre)

    def seen(x):
        Y = X @ about @ pose(x[:3] / size, x[3:6]) @ np.linalg.inv(about)
        return np.ravel(seen_by(flange, Y, places + x[6:].reshape(-1, 3), mount, still, noise=0.0))

    steps = 0.01 * np.eye(6 + places.size)
    J = np.array([seen(step) - seen(-step) for step in steps]).T / 0.02
    # Targets are free: what of the hand-eye they cannot make up for is what counts.
    Q = np.linalg.qr(J[:, 6:])[0]
    twist = np.linalg.svd(J[:, :6] - Q @ (Q.T @ J[:, :6]))[2][-1]
    return X[:3, :3] @ twist[:3], X[:3, :3] @ twist[3:]


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("tilt", [0.0, 1e-4, 2e-3])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_translation_that_the_turns_hardly_show_is_called_a_translation(axis, tilt, mount):
    flange, X, places = cell(axis, tilt, 100.0, mount)
    turned, shifted = weakest(flange, X, places, mount)
    assert np.linalg.norm(turned) < 0.1 and abs(shifted[axis]) > 0.99
    capture = prepare_capture(
        labelled_session(flange, seen_by(flange, X, places, mount, np.random.default_rng(1)), mount)
    )
    assert unobservable([capture], X) == (f"translation along {ALL_ONE}",)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_at_one_place_the_turn_about_the_axis_is_open_too(axis, mount):
    flange, X, places = cell(axis, 0.0, 0.0, mount)
    capture = prepare_capture(
        labelled_session(flange, seen_by(flange, X, places, mount, np.random.default_rng(1)), mount)
    )
    assert unobservable([capture], X) == (f"translation along {ALL_ONE}", f"rotation about {ALL_ONE}")
