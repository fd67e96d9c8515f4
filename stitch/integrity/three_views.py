"""Three views, which show no more than two motions: whether their poses agree as poses of arms do.

A scan that is off gives another hand-eye there, and a scatter that effects of an arm may cause too: three views do not
tell whose fault it is, but that something is wrong.
"""

import numpy as np

from stitch.frames import Array
from stitch.integrity.snooping import Snooping
from stitch.measurement.session import Session
from stitch.observations.flange_errors import usual_twist
from stitch.statistics.tails import chi2_tail
from stitch.units import angle_text, length_text

_VIEWS = 3
# That poses which repeat as those of arms do are said to disagree.
_THREE_VIEWS_CHANCE = 1e-4


def check_three_views(session: Session, found: Snooping) -> str | None:
    """What to say of three views whose poses disagree by more than arms repeat; None where they do not."""
    rotation, translation = usual_twist(session.length_unit)[[0, 3]]
    if len(session.views) != _VIEWS or _global_model_test(found, np.array([rotation**2, translation**2, 1.0])):
        return None
    unit = session.length_unit
    by = f"{length_text(found.translation, unit, 2)} and {angle_text(found.rotation, 2)}"
    usual = f"{length_text(translation, unit, 2)} and {angle_text(rotation, 2)}"
    return (
        f"Three poses contradict their scans by {by}, where arms repeat to about {usual}: a scan or a row is off, or "
        "the arm errs, and three views do not tell which. Add views before you believe hand-eye or stitched cloud."
    )


def _global_model_test(found: Snooping, variances: Array) -> bool:
    """The test of the model as a whole (Baarda 1968): the scatter is known and not taken from the same data."""
    mixed = found.model.mixed()
    C, A, z = mixed.covariance(variances)[0], mixed.A[0], mixed.z[0]
    CA, Cz = np.linalg.solve(C, A), np.linalg.solve(C, z)
    statistic = z @ Cz - Cz @ A @ np.linalg.solve(A.T @ CA, A.T @ Cz)
    return chi2_tail(float(statistic), len(z) - A.shape[1]) > _THREE_VIEWS_CHANCE
