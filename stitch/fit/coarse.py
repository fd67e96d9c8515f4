"""Find a coarse hand-eye from nothing, or take the given one.

Candidates come from two independent ideas: (1) the centroids of the clouds as crude labelled points
of one fixed target, minimised from many starting rotations (`centroid_hand_eyes`); (2) relative scan motions
against the robot's (AX = XB, two solvers; `motion_candidates`): neighbouring views are registered by features (FPFH,
RANSAC; Rusu et al. 2009), a stream of scans in small steps by KISS-ICP's odometry (Vizzo et al. 2023). Every candidate
is then closed in on the scans at low resolution, and the consistency of the whole set decides: the truncated mean
square distance between all views that ought to meet. Objects without features (sphere, cone, plane) pass the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch.errors import NoResultError
from stitch.fit.correct import COARSE_SAMPLES, icp_hand_eye, next_gates
from stitch.numerics import feature_matching, frames
from stitch.numerics.feature_matching import FeaturedSurface
from stitch.numerics.frames import Array
from stitch.numerics.hand_eye import AXXB_SOLVERS
from stitch.numerics.odometry import (
    angle_differences,
    is_stream,
    motions_between,
    motions_of_stream,
    scan_odometry,
)
from stitch.observations.observability import hidden_translations
from stitch.observations.surfaces.matching import NeighbourQueries, neighbour_queries, sample_points
from stitch.observations.surfaces.normal_equations import Overlaps, collect_overlaps, common_samples
from stitch.session.capture import Capture, part_size
from stitch.session.scan import Scan, even_indices, subsample
from stitch.system.process import steps
from stitch.system.threads import parallel

# Where a hand-eye came from that was not searched.
STATED, REUSED, ALONE = "given in session.toml", "of another run, used as it is", "of each scanner's own views"
# First gate of the search, that of the correction from what it found, and truncation of the score: shares of the part's
# size.
COARSE_GATE, _FOUND_GATE, SCORE_SHARE = 0.35, 0.2, 0.05
# Points of a view whose nearest neighbours are searched while a hand-eye is found, and points of a scan there.
SEARCH_SAMPLES, _SEARCH_POINTS = 120, 2000
# The gate shrinks by 0.6 a step: from a third of the part to a hundredth.
_STEPS_TO_MEET, _STEPS_AFTER = 4, 3
# Two answers of the search whose scores differ by less than this ratio are equally good.
_CLOSE = 1.1
# Two candidates are the same answer if they place the part within this share of its size.
_SAME_SHARE = 0.03
# Rotations from which centroids are brought together.
_STARTS = 24
# Restarts about the best centroid solution: its error on real parts was 2–17°.
_RESTART_DEG = 15.0
# The angle of a conjugate motion is an invariant: |angle(A) − angle(B)| small (Chen 1991).
_ANGLE_TOLERANCE = np.radians(3.0)
# Fewer motions show no hand-eye.
_MINIMUM_MOTIONS = 3
# Registration by features: its unit of length in spacings of the points, points of a scan, and triples that RANSAC
# draws: one partner in twelve right leaves five good triples among so many.
_FEATURE_SPACINGS, _POINTS, _DRAWS = 6.0, 1500, 10_000


@dataclass(frozen=True)
class HandEyeCandidate:
    """One hand-eye that was tried: its origin and how well all views fall together."""

    source: str
    T_mount: Array  # (4, 4) after closing in
    score: float  # length_unit, lower is better
    reached: int = 1  # starts that ended here


@dataclass(frozen=True)
class CoarseHandEye:
    """The coarse hand-eye; `candidates` best first, one per distinct answer."""

    T_mount: Array  # (4, 4)
    gate: float  # length_unit: first distance between partners for the correction
    source: str
    candidates: tuple[HandEyeCandidate, ...]
    # Cache of `overlaps`, by the identity of the capture.
    _overlaps: dict[int, tuple[Capture, Overlaps]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def overlaps(self, capture: Capture) -> Overlaps:
        """Return the correspondences of a few points of each view under this hand-eye.

        Two callers want them, the report of the coarse stage and the correction: the first call caches them, the second
        takes them out of the cache.

        Raises:
            NoResultError: no two views overlap.
        """
        known, overlaps = self._overlaps.pop(id(capture), (None, None))
        if overlaps is None or known is not capture:
            samples = common_samples(capture.scans, COARSE_SAMPLES)
            overlaps = collect_overlaps(capture, capture.poses(self.T_mount), self.gate, samples)
            self._overlaps[id(capture)] = capture, overlaps
        return overlaps

    @property
    def is_ambiguous(self) -> bool:
        """True if another distinct answer of the search is as good."""
        return self.runner_up_ratio < _CLOSE

    @property
    def runner_up_ratio(self) -> float:
        """Score of the second distinct answer over the best; inf if there is none."""
        return self.candidates[1].score / self.candidates[0].score if len(self.candidates) > 1 else np.inf


def use_given_hand_eye(captures: Sequence[Capture], T_mount: Array, source: str) -> CoarseHandEye:
    """Return a known hand-eye as the start of the correction, with the widest gate: `COARSE_GATE` of the part's size.

    It was not searched: there are no candidates.

    Args:
        T_mount: (4, 4) maps scanner to mount.
        source: where it comes from, in words.
    """
    return CoarseHandEye(T_mount, gate=COARSE_GATE * part_size(captures), source=source, candidates=())


def find_coarse_hand_eye(captures: Sequence[Capture]) -> CoarseHandEye:
    """Return the hand-eye that a search from many starts finds, and the distinct answers, best first.

    Each start is improved by ICP on few points; the answers are ranked by how well all views then meet.

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
    # Some starts are rotated about the part, which also shifts the scanner. Along directions that no motion shows, such
    # a shift would stay.
    tried = [replace(c, T_mount=_without_hidden_shift(captures, c.T_mount)) for c in tried]
    answers = distinct_hand_eyes(captures, tried, size)
    return CoarseHandEye(answers[0].T_mount, _FOUND_GATE * size, answers[0].source, tuple(answers))


def _without_hidden_shift(captures: Sequence[Capture], T_mount: Array) -> Array:
    """Return the hand-eye (4, 4), its translation zero along directions that the motions do not show."""
    hidden = T_mount[:3, :3] @ hidden_translations(captures, T_mount)
    T = T_mount.copy()
    T[:3, 3] -= hidden @ (hidden.T @ T[:3, 3])
    return T


def _starting_hand_eyes(captures: Sequence[Capture], size: float) -> list[tuple[str, Array]]:
    """Return starting hand-eyes T_mount (4, 4), each with the name of how it was found.

    In this order: three that bring the centroids of the clouds together; the best of these rotated by `_RESTART_DEG`
    about each axis, and by 90°, 180° and 270° about the line of sight; distinct ones from motions of the scans. The
    quarter turns are usually wrong: how much worse they score says how clear the answer is.

    Args:
        size: of the part, length_unit.
    """
    centroids = centroid_hand_eyes(captures)
    starts = [("centroids", T) for T in centroids[:3]]
    centre = scanner_centre(captures)
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        starts.append(("centroids, turned", centroids[0] @ turn_about(axis * np.radians(_RESTART_DEG), centre)))
    for quarter in (1, 2, 3):
        turn = centre / np.linalg.norm(centre) * np.pi / 2 * quarter
        starts.append((f"turned by {90 * quarter}° about the line of sight", centroids[0] @ turn_about(turn, centre)))
    of_motions: list[tuple[str, Array]] = []
    for name, T in motion_candidates(captures):
        if not any(same_hand_eye(captures, size, T, other) for _, other in of_motions):
            of_motions.append((f"scan motions, {name}", T))
    return starts + of_motions


def icp_from_starts(
    captures: Sequence[Capture], starts: Sequence[tuple[str, Array]], size: float
) -> list[HandEyeCandidate]:
    """Return the hand-eyes where ICP ends from every start, with their scores, on few points of each scan.

    After `_STEPS_TO_MEET` steps, starts that have reached the same hand-eye are merged into one, since most end alike.
    A start under which no views overlap is dropped.

    Args:
        starts: (name, T_mount (4, 4)).
        size: of the part, length_unit.
    """
    light = [replace(c, scans=tuple(subsample(scan, _SEARCH_POINTS) for scan in c.scans)) for c in captures]
    # Per distinct hand-eye half way: the names of its starts, T_mount (4, 4) and the gates of the captures.
    distinct: list[tuple[list[str], Array, list[float]]] = []
    for source, start in steps("trying hand-eyes", starts):
        half_way = _icp_steps(light, start, [COARSE_GATE * size] * len(captures), _STEPS_TO_MEET)
        if half_way is None:
            continue
        same = [sources for sources, T, _ in distinct if same_hand_eye(captures, size, half_way[0], T)]
        if same:
            same[0].append(source)
        else:
            distinct.append(([source], *half_way))
    candidates = []
    for sources, T_mount, gates in distinct:
        end = _icp_steps(light, T_mount, gates, _STEPS_AFTER)
        if end is not None:
            score = view_consistency(captures, end[0], SCORE_SHARE * size)
            candidates.append(HandEyeCandidate(sources[0], end[0], score, reached=len(sources)))
    return candidates


def _icp_steps(
    captures: Sequence[Capture], T_mount: Array, gates: Sequence[float], steps: int
) -> tuple[Array, list[float]] | None:
    """Return the hand-eye (4, 4) and the next gate of each capture after some steps of ICP; None if no views overlap.

    Args:
        gates: per capture the largest distance between corresponding points at first, length_unit.
    """
    try:
        T_mount, overlaps, _ = icp_hand_eye(captures, T_mount, gates, samples=SEARCH_SAMPLES, maximum=steps)
    except NoResultError:
        return None
    return T_mount, next_gates(captures, overlaps)


def distinct_hand_eyes(
    captures: Sequence[Capture], tried: Sequence[HandEyeCandidate], size: float
) -> list[HandEyeCandidate]:
    """Return one candidate per distinct hand-eye, best score first.

    Candidates that place the part alike form a group: it keeps its best hand-eye, the name of its first start, and the
    number of starts.

    Args:
        size: of the part, length_unit.
    """
    groups: list[list[HandEyeCandidate]] = []
    for candidate in tried:
        for group in groups:
            if same_hand_eye(captures, size, candidate.T_mount, group[0].T_mount):
                group.append(candidate)
                break
        else:
            groups.append([candidate])
    best = [
        replace(min(group, key=lambda c: c.score), source=group[0].source, reached=sum(c.reached for c in group))
        for group in groups
    ]
    return sorted(best, key=lambda c: c.score)


def same_hand_eye(captures: Sequence[Capture], size: float, T_a: Array, T_b: Array) -> bool:
    """Return whether two hand-eyes (4, 4) place the part alike: its points differ by less than 3 % of its size.

    Args:
        size: of the part, length_unit; its points are six about the mean centroid of the scans.
    """
    centre = scanner_centre(captures)
    corners = centre + size / 2 * np.vstack([np.eye(3), -np.eye(3)])
    displacement = np.linalg.norm(frames.transform(T_a, corners) - frames.transform(T_b, corners), axis=1)
    return bool(displacement.max() < _SAME_SHARE * size)


def view_consistency(captures: Sequence[Capture], T_mount: Array, limit: float) -> float:
    """Return the rms over all ordered pairs of views of the distance from points of one to the other, length_unit.

    A distance above `limit`, or to a surface that faces another way, counts as `limit`. So a hand-eye that moves views
    away from each other gains nothing.
    """
    squares: list[float] = []
    for c in captures:
        samples = [sample_points(scan, SEARCH_SAMPLES) for scan in c.scans]
        queries = neighbour_queries(c.scans, c.poses(T_mount), samples)
        squares += chain.from_iterable(parallel(partial(_mean_squares, queries, limit), range(len(c.scans))))
    return float(np.sqrt(np.mean(squares)))


def _mean_squares(queries: NeighbourQueries, limit: float, w: int) -> list[float]:
    """Return for each other view that has samples the mean squared distance of these to view w, length_unit².

    A distance above `limit` (length_unit), or to a surface that faces another way, counts as `limit`.
    """
    parts = [(v, slice(None)) for v in range(len(queries.scans)) if v != w and len(queries.index[v])]
    if not parts:
        return []
    _, points, normals = queries.gather(parts)
    distance, has_partner = queries.search(w, points, normals, limit)
    squares_by_view = np.split(np.where(has_partner, distance, limit) ** 2, np.cumsum(queries.counts(parts))[:-1])
    return [float(np.mean(squares)) for squares in squares_by_view]


def scanner_centre(captures: Sequence[Capture]) -> Array:
    """Return the mean centroid (3,) of the scans in the scanner frame."""
    return np.mean([scan.points.mean(axis=0) for c in captures for scan in c.scans], axis=0)


def centroid_hand_eyes(captures: Sequence[Capture]) -> list[Array]:
    """Return distinct hand-eyes T_mount (4, 4) that bring the centroids of a capture's clouds to one point, best first.

    Least squares from `_STARTS` random rotations; results within 3° of a better one are dropped. The centroid of a view
    is biased to the side that it sees, so errors of 2–17° and 20–60 mm are usual.
    """
    centroids = [np.array([s.points.mean(axis=0) for s in c.scans]) for c in captures]
    # A translation that moves all views alike changes no residual: there it stays zero.
    hidden = hidden_translations(captures, np.eye(4))
    shifts = null_space(hidden.T) if hidden.size else np.eye(3)

    def hand_eye(x: Array) -> Array:
        """Return T_mount (4, 4) for x: a rotation vector, then a translation along `shifts`."""
        return frames.make(Rotation.from_rotvec(x[:3]).as_matrix(), shifts @ x[3:])

    def residual(x: Array) -> Array:
        """Return what is left (3ΣV,) between each placed centroid and the mean of its capture, reference frame."""
        T = hand_eye(x)
        rows = []
        for c, centroid in zip(captures, centroids, strict=True):
            placed = frames.transform(c.poses(T), centroid[:, None])[:, 0]
            rows.append((placed - placed.mean(axis=0)).ravel())
        return np.concatenate(rows)

    fits = []
    for start in Rotation.random(_STARTS, rng=np.random.default_rng(0)):
        first = np.r_[start.as_rotvec(), np.zeros(shifts.shape[1])]
        fit = least_squares(residual, first, method="trf", max_nfev=100, x_scale="jac")
        fits.append((float(fit.cost), fit.x))
    fits.sort(key=lambda pair: pair[0])
    distinct: list[Array] = []
    for _, x in fits:
        T = hand_eye(x)
        if all(np.degrees(frames.angle_between(T, other)) > 3 for other in distinct):
            distinct.append(T)
    return distinct


def turn_about(rotation: Array, centre: Array) -> Array:
    """Return the motion (4, 4) that rotates by a rotation vector (3,), rad, about a point (3,)."""
    T = frames.make(Rotation.from_rotvec(rotation).as_matrix(), np.zeros(3))
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def motion_candidates(captures: Sequence[Capture]) -> list[tuple[str, Array]]:
    """Return (source, T_mount (4, 4)) per kind of scan motion and solver of A·X = X·B.

    A are motions of the mount, B of the scanner. A kind with fewer than `_MINIMUM_MOTIONS` plausible motions, and a
    solver that fails, are left out.
    """
    candidates: list[tuple[str, Array]] = []
    for kind, motions in (("features", feature_motions), ("KISS-ICP", sequence_motions)):
        A, B = (np.concatenate(of_captures) for of_captures in zip(*map(motions, captures), strict=True))
        # Under any hand-eye both turn by the same angle: a motion that does not is a wrong registration.
        plausible = angle_differences(A, B) < _ANGLE_TOLERANCE
        if plausible.sum() < _MINIMUM_MOTIONS:
            continue
        for name, solver in AXXB_SOLVERS.items():
            try:
                T_mount = solver(A[plausible], B[plausible])
            except (NoResultError, np.linalg.LinAlgError):
                continue
            if np.isfinite(T_mount).all():
                candidates.append((f"{kind}, {name}", T_mount))
    return candidates


def feature_motions(capture: Capture) -> tuple[Array, Array]:
    """Return (A, B), each (M, 4, 4): motions between neighbours of the sequence by feature matching.

    A·X = X·B, with B the motion that maps view w's scanner frame into view v's, A that of the mount.
    """
    pairs = neighbouring_views(len(capture.scans))
    return motions_between(capture.T_reference_mount, pairs), register_pairs(capture, pairs)


def register_pairs(capture: Capture, pairs: Sequence[tuple[int, int]]) -> Array:
    """Return motions (M, 4, 4) of the scanner: each maps the second view's scanner frame into the first's.

    Surfaces are matched by FPFH features and RANSAC, then improved by ICP.
    """
    # Radii of features and distances of partners are multiples of this length, length_unit.
    size = _FEATURE_SPACINGS * capture.spacing

    def with_features(scan: Scan) -> FeaturedSurface:
        """Return the surface of a scan, thinned, with its features."""
        points, normals = feature_matching.voxel_downsample(
            scan.points, scan.normals, max(size / 2, even_grid_size(scan.points))
        )
        return feature_matching.compute_fpfh(points, normals, 2.5 * size)

    surfaces = list(parallel(with_features, capture.scans))

    def motion(pair: tuple[int, int]) -> Array:
        """Return the motion (4, 4) that maps the scan of the second view onto that of the first."""
        target, source = (surfaces[v] for v in pair)
        T = feature_matching.register_ransac(source, target, reach=1.5 * size, draws=_DRAWS)
        return feature_matching.align_icp(source, target, T, reach=size)

    return np.array(list(parallel(motion, pairs, "pairs of scans"))).reshape(-1, 4, 4)


def neighbouring_views(views: int) -> list[tuple[int, int]]:
    """Return the pairs (v, w) of views that are one or two apart in their order; of two views the one pair."""
    pairs = [(v, v + step) for step in (1, 2) for v in range(views - step)]
    return pairs if views > 2 else [(0, 1)]


def even_grid_size(points: Array) -> float:
    """Return the edge of a grid, in the unit of points (N, 3), that leaves about `_POINTS` points of their surface."""
    extent = np.ptp(points, axis=0)
    return float(np.sqrt(np.prod(np.sort(extent)[1:]) / _POINTS))


def sequence_motions(capture: Capture) -> tuple[Array, Array]:
    """Return (A, B), each (M, 4, 4): motions of a stream of scans by its odometry; none of separate views."""
    scans = [scan.points[even_indices(len(scan.points), _POINTS)] for scan in capture.scans]
    if not is_stream(capture.T_reference_mount, scans):
        return np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
    return motions_of_stream(capture.T_reference_mount, scan_odometry(scans))
