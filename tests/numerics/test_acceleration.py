"""Steps that leave a share of the way undone, and what two of them tell."""

import numpy as np
import pytest

from stitch.numerics.least_squares import anderson_step


def left_after(steps, undone, accelerate):
    """How far from the answer, of 1, where each step asked for leaves shares (N,) of what is left undone."""
    off, last = np.ones(len(undone)), None
    for _ in range(steps):
        asked = -(1 - undone) * off
        taken = asked if last is None or not accelerate else anderson_step(asked, *last)
        last, off = (asked, taken), off + taken
    return float(np.abs(off).max())


def test_one_share_of_all_components_is_made_up_for_at_once():
    assert left_after(2, np.full(3, 0.4), accelerate=False) == pytest.approx(0.16)
    assert left_after(2, np.full(3, 0.4), accelerate=True) < 1e-12


def test_different_shares_are_left_behind_faster_than_without():
    undone = np.linspace(0.1, 0.45, 20)
    assert left_after(5, undone, accelerate=True) < 0.2 * left_after(5, undone, accelerate=False)


def test_steps_that_turn_back_are_shortened_and_never_run_away():
    assert left_after(8, np.full(3, -0.6), accelerate=True) < left_after(8, np.full(3, -0.6), accelerate=False)
    # Hardly anything is done by a step: going twice as far is all that is dared.
    assert left_after(1, np.full(3, 0.99), accelerate=False) > left_after(9, np.full(3, 0.99), accelerate=True) > 0.5


def test_no_step_at_all_stays_none():
    assert np.array_equal(anderson_step(np.zeros(3), np.zeros(3), np.zeros(3)), np.zeros(3))
