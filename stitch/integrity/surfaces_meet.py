"""How well the surfaces of all views fall together under the best hand-eye of a hypothesis: the last, dear judge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.integrity.hypotheses import Hypothesis
from stitch.measurement.capture import Capture, part_size
from stitch.stages.coarse import SCORE_SHARE, icp_from_starts

# Another hypothesis is refuted by the surfaces if it leaves this much more between them. Under rows in any order, where
# none is right, the best of 58 readings led by 1.12 at most (four views) and by 1.04 (seven to twelve); right ones led
# by 1.4 to 2.0 where all views overlap, by less where they go all round a part: there the motions decide.
CLEARLY_BETTER = 1.25


@dataclass(frozen=True)
class SurfaceFit:
    """A hypothesis with the hand-eye under which its views fall together best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    misfit: float  # length_unit: rms distance between views, truncated; what it is truncated at where none overlap
    meets: bool  # some views overlap


def surface_misfit(capture: Capture, hypothesis: Hypothesis, starts: Sequence[Array]) -> SurfaceFit:
    """Close in from some hand-eyes (4, 4).

    Args:
        capture: the scans; its own poses do not count.
    """
    posed = replace(capture, T_reference_mount=hypothesis.T_reference_mount)
    if hypothesis.used is not None:
        left_out = np.setdiff1d(np.arange(len(capture.scans)), hypothesis.used)
        posed = posed.without(left_out)
    named = [(str(i), T) for i, T in enumerate(starts)]
    ends = icp_from_starts([posed], named, part_size([posed]))
    if not ends:
        return SurfaceFit(hypothesis, np.asarray(starts[0]), SCORE_SHARE * part_size([posed]), False)
    best = min(ends, key=lambda end: end.score)
    return SurfaceFit(hypothesis, best.T_mount, best.score, True)
