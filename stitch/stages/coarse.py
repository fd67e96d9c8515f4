"""Find a coarse hand-eye from nothing, or take the given one.

Candidates come from two independent ideas: (1) the centroids of the clouds as crude labelled points
of one fixed target, minimised from many starting rotations (`centroids.py`); (2) relative scan motions
against the robot's (AX = XB, five solvers; `relative_motion.py`). Every candidate is then closed in on the scans
at low resolution, and the consistency of the whole set decides: the truncated mean square distance
between all views that ought to meet. Objects without features (sphere, cone, plane) pass the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.scan import subsample
from stitch.stages.correct import icp_hand_eye, next_gates
from stitch.stages.initial_guess.centroids import centroid_hand_eyes, scanner_centre
from stitch.stages.initial_guess.hand_eye_candidates import (
    SEARCH_SAMPLES,
    HandEyeCandidate,
    distinct_hand_eyes,
    same_hand_eye,
    view_consistency,
)
from stitch.stages.initial_guess.relative_motion import motion_candidates
from stitch.system.steps import steps

_SEARCH_POINTS = 2000
# The gate shrinks by 0.6 a step: from a third of the part to a hundredth.
_STEPS_TO_MEET, _STEPS_AFTER = 4, 3
# First gate of the search and truncation of the score, as shares of the part's size.
COARSE_GATE, SCORE_SHARE = 0.35, 0.05
# Where a hand-eye came from that was not searched.
STATED, REUSED = "given in session.toml", "of another run, used as it is"
# Restarts about the best centroid solution: its error on real parts was 2–17°.
_RESTART_DEG = 15.0


@dataclass(frozen=True)
class CoarseHandEye:
    """The coarse hand-eye; `candidates` best first, one per distinct answer."""

    T_mount: Array  # (4, 4)
    gate: float  # length_unit: first distance between partners for the correction
    source: str
    candidates: tuple[HandEyeCandidate, ...]

    @property
    def runner_up_ratio(self) -> float:
        """Score of the second distinct answer over the best; inf if there is none."""
        return self.candidates[1].score / self.candidates[0].score if len(self.candidates) > 1 else np.inf


def use_given_hand_eye(captures: Sequence[Capture], T_mount: Array, source: str) -> CoarseHandEye:
    """Take a hand-eye that is known from elsewhere: the gate is wide enough for 5° and 30 mm.

    Args:
        source: where from, in words.
    """
    return CoarseHandEye(T_mount, COARSE_GATE * part_size(captures), source, ())


def find_coarse_hand_eye(captures: Sequence[Capture]) -> CoarseHandEye:
    """Search the hand-eye.

    Raises:
        NoResultError: fewer than three views, or no candidate makes the views overlap.
    """
    if sum(len(c.scans) for c in captures) < 3:
        raise NoResultError("a hand-eye cannot be found from fewer than 3 views: give scanner.pose in session.toml")
    size = part_size(captures)
    starts = _starting_hand_eyes(captures, size)
    tried = icp_from_starts(captures, starts, size)
    if not tried:
        raise NoResultError(
            "no hand-eye makes the scans overlap: check mount (eye_to_hand or eye_in_hand), the pose "
            "convention and that scans and poses are paired rightly, or give scanner.pose"
        )
    answers = distinct_hand_eyes(captures, tried, size)
    return CoarseHandEye(answers[0].T_mount, 0.2 * size, answers[0].source, tuple(answers))


def _starting_hand_eyes(captures: Sequence[Capture], size: float) -> list[tuple[str, Array]]:
    """Distinct starting hand-eyes with the name of the idea behind each.

    Turns of a quarter and a half about the line of sight are there to be refuted: they say how far
    the runner-up is.
    """
    centroids = centroid_hand_eyes(captures)
    starts = [("centroids", T) for T in centroids[:3]]
    centre = scanner_centre(captures)
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        starts.append(("centroids, turned", centroids[0] @ _turn_about(axis * np.radians(_RESTART_DEG), centre)))
    for quarter in (1, 2, 3):
        turn = centre / np.linalg.norm(centre) * np.pi / 2 * quarter
        starts.append((f"turned by {90 * quarter}° about the line of sight", centroids[0] @ _turn_about(turn, centre)))
    motions = [(f"scan motions, {name}", T) for name, T in motion_candidates(captures)]
    kept: list[tuple[str, Array]] = []
    for name, T in motions:
        if not any(same_hand_eye(captures, size, T, other) for _, other in kept):
            kept.append((name, T))
    return starts + kept


def _turn_about(rotation: Array, centre: Array) -> Array:
    T = frames.make(Rotation.from_rotvec(rotation).as_matrix(), np.zeros(3))
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def icp_from_starts(
    captures: Sequence[Capture], starts: Sequence[tuple[str, Array]], size: float
) -> list[HandEyeCandidate]:
    """Close in from every start on few points; starts under which no views overlap are dropped.

    Half way, starts that have met go on as one: most end in the same place.
    """
    light = [replace(c, scans=tuple(subsample(scan, _SEARCH_POINTS) for scan in c.scans)) for c in captures]
    met: list[tuple[list[str], Array, list[float]]] = []
    for source, start in steps("trying hand-eyes", starts):
        half = _icp_steps(light, start, [COARSE_GATE * size] * len(captures), _STEPS_TO_MEET)
        if half is None:
            continue
        same = [sources for sources, T, _ in met if same_hand_eye(captures, size, half[0], T)]
        if same:
            same[0].append(source)
        else:
            met.append(([source], *half))
    ends = [(sources, _icp_steps(light, T, gates, _STEPS_AFTER)) for sources, T, gates in met]
    return [
        HandEyeCandidate(sources[0], end[0], view_consistency(captures, end[0], SCORE_SHARE * size), len(sources))
        for sources, end in ends
        if end is not None
    ]


def _icp_steps(
    captures: Sequence[Capture], T_mount: Array, gates: Sequence[float], steps: int
) -> tuple[Array, list[float]] | None:
    """Close in by some steps: hand-eye and the gates to go on with; None if no views overlap."""
    try:
        T_mount, overlaps, _ = icp_hand_eye(captures, T_mount, gates, samples=SEARCH_SAMPLES, maximum=steps)
    except NoResultError:
        return None
    return T_mount, next_gates(captures, overlaps)
