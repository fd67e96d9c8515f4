"""Anderson acceleration with a memory of one step (Anderson 1965; for ICP: Pavlov et al. 2018).

Partners follow a view that moves, so that every step of point-to-plane matching leaves the same share of the way
undone. Two steps tell that share, and the next one makes up for it.
"""

import numpy as np

from stitch.frames import Array

# Against steps that hardly shrink: at most twice as far, or half as far where they turn back.
_FARTHEST, _NEAREST = 1.0, -0.5


def anderson_step(step: Array, last_step: Array, last_taken: Array) -> Array:
    """(N,) the step to take, from what two iterations in turn ask for.

    Args:
        step: (N,) what the present iteration asks for, all components in one unit.
        last_step: (N,) what the iteration before asked for.
        last_taken: (N,) the step that was taken then.
    """
    change = step - last_step
    square = float(change @ change)
    share = 0.0 if square == 0 else float(np.clip(-(change @ step) / square, _NEAREST, _FARTHEST))
    return np.asarray(step + share * (last_taken + change))
