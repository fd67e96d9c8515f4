"""What a panel job found, in sentences."""

import numpy as np

from stitch.cells.panel.legs import LegOffset
from stitch.cells.panel.panel_job import PanelJob
from stitch.cells.panel.panel_solution import PanelResult

# A likelihood ratio of 100 is a chi-square of 9.2.
_CLEAR = 9.2


def leg_sentence(o: LegOffset) -> str:
    """A leg whose length its controller does not know."""
    doubt = "" if o.chi_square_drop - o.runner_up_drop > _CLEAR else f"; leg {o.runner_up} explains it nearly as well"
    return (
        f"Leg {o.leg} of robot {o.robot} is {o.offset:+.3f} ± {o.sigma:.3f} mm (1 σ) longer than its controller "
        f"believes{doubt}. It is taken out of the model and put into the commands."
    )


def shape_sentence(job: PanelJob, result: PanelResult) -> str | None:
    """The clamp where the shape is off most; None without control points."""
    if result.shape_largest is None:
        return None
    worst = int(np.argmax(result.shape_largest))
    verdict = "within" if result.shape_largest[worst] <= job.tolerance else "beyond"
    return (
        f"Its shape is {result.shape_largest[worst]:.2f} mm off at clamp {job.robots[worst]}, {verdict} the "
        f"{job.tolerance:g} mm allowed."
    )
