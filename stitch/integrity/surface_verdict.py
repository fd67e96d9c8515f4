"""Which mistake, undone, lets the surfaces of all views fall together: asked where motions between scans do not tell.

Parts that look alike from several sides, such as plates with holes, close pair by pair in wrong ways, so that too few
motions agree under any hypothesis. All views at once close under the right one alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch import frames
from stitch.integrity.centroids_meet import fit_centroids
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.motion_fit import MotionFit
from stitch.integrity.surfaces_meet import CLEARLY_BETTER, SurfaceFit, surface_misfit
from stitch.measurement.capture import Capture

# Hypotheses that the surfaces see: those that the motions like best.
_HYPOTHESES_TRIED = 5


def hypotheses_by_surface(capture: Capture, found: Sequence[MotionFit]) -> tuple[SurfaceFit, ...]:
    """The mistakes under which the views fall together clearly better than as stated, best first; () if none does.

    Those that cannot be told from the best stand behind it.

    Args:
        found: hypotheses about the poses, the likeliest first (see `explained`).
    """
    stated = next((e for e in found if e.hypothesis.kind == "stated"), None)
    if stated is None:
        return ()
    tried = [stated, *[e for e in found if e.hypothesis.kind != "stated"][:_HYPOTHESES_TRIED]]
    posed = [_scaled_hypothesis(e) for e in tried]
    near = fit_centroids(posed, np.array([scan.points.mean(axis=0) for scan in capture.scans]))
    starts = [[T, e.T_mount] for (_, T), e in zip(near, tried, strict=True)]
    fallen = [surface_misfit(capture, h, own) for h, own in zip(posed, starts, strict=True)]
    best, *others = sorted(fallen[1:], key=lambda f: f.misfit)
    if not best.meets or best.misfit * CLEARLY_BETTER > fallen[0].misfit:
        return ()
    return (best, *(f for f in others if f.misfit <= CLEARLY_BETTER * best.misfit))


def _scaled_hypothesis(found: MotionFit) -> Hypothesis:
    """The hypothesis with the robot's lengths in the scans' unit."""
    T = found.hypothesis.T_base_flange
    return replace(found.hypothesis, T_base_flange=frames.make(T[:, :3, :3], found.scale * T[:, :3, 3]))
