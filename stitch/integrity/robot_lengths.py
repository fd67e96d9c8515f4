"""Do scanner and robot count lengths alike? The part would come out whole but of the wrong size, and fit itself."""

import numpy as np

from stitch.frames import Array
from stitch.integrity.problems import SessionProblem
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import hstack_columns, test_alternative

# No scanner in use is off by this share of its lengths, and no arm.
_SCALE = 0.01
_LENGTH_CHANCE = 1e-4


def length_problem(model: ViewModel, T_reference_mount: Array, further: Array | None = None) -> SessionProblem | None:
    """The robot's lengths, tested as one factor on all its translations; None if they agree with the scans'.

    Args:
        further: (n, K) columns of what was found beside: a factor must not explain what single views do.
        T_reference_mount: (V, 4, 4), length_unit: a factor 1 + κ on them is a left twist (0, κ t) of every view.
    """
    column = np.einsum("vni,vi->n", model.views[:, :, 3:], T_reference_mount[:, :3, 3])[:, None]
    found = test_alternative(projector(model, model.fit(hstack_columns(further, column)), further), column)
    share = float(found.estimate[0])
    if abs(share) < _SCALE or found.p_value > _LENGTH_CHANCE:
        return None
    fix = f"the clouds are {1 + share:.4f} times as large as the robot's motions say: check their scale"
    return SessionProblem("scale", (), fix)
