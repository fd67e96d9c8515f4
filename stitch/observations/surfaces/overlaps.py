"""Everything two views of one capture have in common, under one set of poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.gram import Gram, gram, robust_scale
from stitch.observations.surfaces.match import Match, match_pairs, sample_points
from stitch.observations.surfaces.overlapping_pairs import overlapping_pairs
from stitch.observations.surfaces.target_pairs import TargetPairs, append_targets, target_pairs

# Queries per view for the final normal equations and statistics.
FINE_SAMPLES = 3000
# Queries of all views together where they answer one question, a hand-eye or a scale.
_TOTAL_SAMPLES = 20_000
# Partners lie within the neighbour spacing plus 4 sigma of the surface distance.
_GATE_SPACINGS = 1.5
_GATE_SIGMAS = 4.0
# Which pairs overlap is not asked again before a view has moved, or the gate opened, by so much of the gate. The pairs
# of a gate hold those of a smaller one: asked again where they may be too many.
_SAME_PAIRS = 0.3
_SMALLER_GATE = 0.1


@dataclass(frozen=True)
class Overlaps:
    """Correspondences of all overlapping pairs, and common targets, with the normal equations of both."""

    pairs: list[tuple[int, int]]
    matches: list[Match]
    gram: Gram
    gate: float
    targets: TargetPairs | None = None
    probed: tuple[Array, float] | None = None  # poses (V, 4, 4) and gate under which the pairs were found


def collect_overlaps(
    capture: Capture,
    poses: Array,
    gate: float,
    samples: Sequence[Indices],
    before: Overlaps | None = None,
) -> Overlaps:
    """Match all overlapping pairs within `gate` and accumulate their normal equations.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        before: of an iteration before; its pairs serve again where little has moved since they were found.

    Raises:
        NoResultError: no two views overlap.
    """
    if before is not None and before.probed is not None and _pairs_still_valid(before, poses, gate):
        pairs, probed = before.pairs, before.probed
    else:
        pairs = overlapping_pairs(capture.scans, poses, gate, at_most=max(map(len, samples)))
        probed = np.array(poses), gate
    matches = list(match_pairs(capture.scans, poses, pairs, gate, samples))
    if not matches:
        raise NoResultError(
            f"{capture.name}: no two views overlap under this hand-eye; check mount, pose convention "
            "and scanner.pose, or leave scanner.pose out to have it searched"
        )
    centre = np.mean([m.middle.mean(axis=0) for m in matches], axis=0)
    surfaces = gram(matches, len(capture.scans), centre, robust_scale(matches))
    targets = None if capture.sightings is None else target_pairs(capture.sightings, poses)
    return Overlaps(pairs, matches, append_targets(surfaces, targets, capture.noise_factor), gate, targets, probed)


def _pairs_still_valid(before: Overlaps, poses: Array, gate: float) -> bool:
    """Whether no view has moved, and the gate has not opened, by enough to make other pairs overlap."""
    assert before.probed is not None
    T, probed_gate = before.probed
    if gate < _SMALLER_GATE * probed_gate:
        return False
    to_centre = frames.make(np.eye(3), -before.gram.centre)
    twists = frames.log(to_centre @ poses @ frames.inverse(to_centre @ T))
    moved = np.linalg.norm(twists[:, 3:], axis=1) + before.gram.lever * np.linalg.norm(twists[:, :3], axis=1)
    return bool(max(moved.max(), gate - probed_gate) < _SAME_PAIRS * min(gate, probed_gate))


def common_samples(scans: Sequence[Scan], most: int) -> list[Indices]:
    """Per view the points that ask where all views say one thing: of many views each needs fewer.

    Args:
        most: of one view.
    """
    return [sample_points(scan, min(most, _TOTAL_SAMPLES // len(scans))) for scan in scans]


def next_gate(overlaps: Overlaps, capture: Capture) -> float:
    """The distance that partners may have, from the spacing and the residuals' robust sigma."""
    return _GATE_SPACINGS * capture.spacing + _GATE_SIGMAS * overlaps.gram.scale


def pooled_rms(overlaps: Sequence[Overlaps]) -> float:
    """Root mean square over the correspondences of all captures, inside the robust gate."""
    square = sum(o.gram.raw_square.sum() for o in overlaps)
    return float(np.sqrt(square / max(sum(o.gram.count.sum() for o in overlaps), 1)))
