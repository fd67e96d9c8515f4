"""How near all views come together under the poses of a hypothesis, with the best hand-eye: by centroids, by surfaces.

The centroid of a view leans to the side that it sees, by about as much in every view: under right poses the centroids
meet within some hundredths of the part's size, under wrong ones within about all of it. That is where surfaces begin,
which judge.
Parts that look alike from several sides, such as plates with holes, close pair by pair in wrong ways, so that too few
motions agree under any hypothesis. All views at once close under the right one alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch.fit.coarse import SCORE_SHARE, icp_from_starts
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.motions import MotionFit
from stitch.session.capture import Capture, part_size

# Rotations that centroids begin with, and how often one is tried from there; what poses that turn less do not show.
_STARTS, _EVALUATIONS, _SEEN = 12, 200, 1e-6
# Another hypothesis is refuted by the surfaces if it leaves this much more between them. Under rows in any order, where
# none is right, the best of 58 readings led by 1.12 at most (four views) and by 1.04 (seven to twelve); right ones led
# by 1.4 to 2.0 where all views overlap, by less where they go all round a part: there the motions decide.
CLEARLY_BETTER = 1.25
# Hypotheses that the surfaces see: those that the motions like best.
_HYPOTHESES_TRIED = 5


@dataclass(frozen=True)
class SurfaceFit:
    """A hypothesis with the hand-eye under which its views fall together best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    misfit: float  # length_unit: rms distance between views, truncated; what it is truncated at where none overlap
    meets: bool  # some views overlap


def hypotheses_by_surface(capture: Capture, ranked: Sequence[MotionFit]) -> tuple[SurfaceFit, ...]:
    """Return the mistakes under which the views fall together clearly better than as stated, best first; () if none.

    Those that cannot be told from the best stand behind it.

    Args:
        ranked: hypotheses about the poses, the likeliest first (see `rank_hypotheses`).
    """
    stated = next((fit for fit in ranked if fit.hypothesis.kind == "stated"), None)
    mistakes = [fit for fit in ranked if fit.hypothesis.kind != "stated"][:_HYPOTHESES_TRIED]
    if stated is None or not mistakes:
        return ()
    tried = [stated, *mistakes]
    posed = []
    for fit in tried:
        # The robot's lengths in the scans' unit.
        T = fit.hypothesis.T_base_flange
        scaled = frames.make(T[:, :3, :3], fit.scale * T[:, :3, 3])
        posed.append(replace(fit.hypothesis, T_base_flange=scaled))
    centroids = np.array([scan.points.mean(axis=0) for scan in capture.scans])
    as_stated, *others = [
        surface_misfit(capture, h, [fit_centroids(h, centroids), fit.T_mount])
        for h, fit in zip(posed, tried, strict=True)
    ]
    best, *others = sorted(others, key=lambda fit: fit.misfit)
    if not best.meets or best.misfit * CLEARLY_BETTER > as_stated.misfit:
        return ()
    return (best, *(fit for fit in others if fit.misfit <= CLEARLY_BETTER * best.misfit))


def surface_misfit(capture: Capture, hypothesis: Hypothesis, starts: Sequence[Array]) -> SurfaceFit:
    """Close in from some hand-eyes (4, 4).

    Args:
        capture: the scans; its own poses do not count.
    """
    posed = replace(capture, T_reference_mount=hypothesis.T_reference_mount)
    if hypothesis.used is not None:
        posed = posed.without(np.setdiff1d(np.arange(len(capture.scans)), hypothesis.used))
    named = [(str(i), T) for i, T in enumerate(starts)]
    ends = icp_from_starts([posed], named, part_size([posed]))
    if not ends:
        return SurfaceFit(hypothesis, np.asarray(starts[0]), SCORE_SHARE * part_size([posed]), False)
    best = min(ends, key=lambda end: end.score)
    return SurfaceFit(hypothesis, best.T_mount, best.score, True)


def fit_centroids(hypothesis: Hypothesis, centroids: Array) -> Array:
    """Return the hand-eye (4, 4) under which the placed centroids come closest to their mean.

    Under each rotation the best translation is a linear answer (variable projection: Golub and Pereyra 1973).

    Args:
        centroids: (V, 3) of the scans, scanner frame.
    """
    used = slice(None) if hypothesis.used is None else list(hypothesis.used)
    R, position = hypothesis.T_reference_mount[used, :3, :3], hypothesis.T_reference_mount[used, :3, 3]
    shifted = (R - R.mean(axis=0)).reshape(-1, 3)
    inverse = np.linalg.pinv(shifted, _SEEN)

    def left(turn: Array) -> Array:
        placed = frames.rotate(R, Rotation.from_rotvec(turn).apply(centroids[used])[:, None])[:, 0] + position
        off = (placed - placed.mean(axis=0)).ravel()
        return np.concatenate([off - shifted @ (inverse @ off), -inverse @ off])

    # Random, yet the same in every run.
    starts = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_rotvec()
    ends = [least_squares(lambda turn: left(turn)[:-3], start, method="lm", max_nfev=_EVALUATIONS) for start in starts]
    turn = min(ends, key=lambda end: float(end.cost)).x
    return frames.make(Rotation.from_rotvec(turn).as_matrix(), left(turn)[-3:])
