"""Scans and labelled points of one session with the robot's poses: what every stage after reading works on."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.units import METRES
from stitch.session.scan import (
    GRAZING_COSINE,
    Neighbourhoods,
    Scan,
    bounding_box,
    even_indices,
    find_neighbourhoods,
    prepare_scan,
    subsample,
)
from stitch.session.session import Cloud, Scanner, SessionData, View, WholeCloud
from stitch.system.threads import parallel

# Labelled points of all views in arrays of one shape: S slots a view, empty where a target was not seen.

# Where neither a row nor scanner.noise says how well the sensor sees: what a good one does, in metres. The factor
# on the noise is estimated from the data anyway.
_USUAL_SIGMA_M = 1e-5
# A probe's own targets lie some 20 cm apart: that is how well it knows its direction, unless it says so itself.
_PROBE_LEVER_M = 0.2


@dataclass(frozen=True)
class Sightings:
    """What V views show of K targets, sensor frame; lengths in length_unit, angles in rad."""

    targets: tuple[str, ...]  # K
    target: Indices  # (V, S) which target sits in a slot; −1 in an empty one
    points: Array  # (V, S, 3); zero in an empty slot
    sigma: Array  # (V, S) of a coordinate
    used: Mask  # (V, S): seen, and not an outlier
    rotation: Array | None = None  # (V, 3, 3) of a 6D probe, R_sensor_probe
    sigma_rotation: Array | None = None  # (V,)

    @property
    def view_counts(self) -> Indices:
        """(K,) number of views that use each target."""
        return np.asarray(np.bincount(self.target[self.used], minlength=len(self.targets)), np.int64)

    @property
    def with_outliers(self) -> "Sightings":
        """The same with the outliers back in."""
        return replace(self, used=self.target >= 0)

    def points_by_view(self) -> list[Array]:
        """Per view the points in use, (k, 3); none where it shows nothing."""
        return [points[used] for points, used in zip(self.points, self.used, strict=True)]

    def without(self, left_out: Indices) -> "Sightings":
        """The sightings less some views."""
        keep = np.setdiff1d(np.arange(len(self.points)), left_out)
        of_views = ("target", "points", "sigma", "used", "rotation", "sigma_rotation")
        known = {name: values for name in of_views if (values := getattr(self, name)) is not None}
        return replace(self, **{name: values[keep] for name, values in known.items()})


def sightings_of(session: SessionData) -> Sightings | None:
    """All labelled points of a session, its views in order; None without any."""
    seen = [view.sighting for view in session.views]
    names = sorted({name for s in seen if s is not None for name in s.targets})
    if not names:
        return None
    number = {name: k for k, name in enumerate(names)}
    V, S = len(seen), max(len(s.targets) for s in seen if s is not None)
    target, points, sigma = np.full((V, S), -1), np.zeros((V, S, 3)), np.ones((V, S))
    rotation, turn = np.tile(np.eye(3), (V, 1, 1)), np.full(V, np.nan)
    for v, s in enumerate(seen):
        if s is not None:
            k = len(s.targets)
            target[v, :k], points[v, :k], sigma[v, :k] = [number[name] for name in s.targets], s.points, s.sigma
            if s.rotation is not None:
                rotation[v], turn[v] = s.rotation, s.sigma_rotation
    metres = METRES[session.length_unit]
    usual = _USUAL_SIGMA_M / metres if session.scanner.noise is None else session.scanner.noise
    sigma = np.where(np.isnan(sigma), usual, sigma)
    found = Sightings(tuple(names), target, points, sigma, target >= 0)
    if not any(s is not None and s.rotation is not None for s in seen):
        return found
    turn = np.where(np.isnan(turn), sigma[:, 0] * metres / _PROBE_LEVER_M, turn)
    return replace(found, rotation=rotation, sigma_rotation=turn)


@dataclass(frozen=True)
class Capture:
    """The V views of one session. `T_reference_scanner = T_reference_mount @ T_mount_scanner @ T_behind_mount`.

    The reference frame is the flange (eye_to_hand) or the base (eye_in_hand); the mount frame, on
    which the hand-eye sits, is the other one.
    """

    name: str
    scans: tuple[Scan, ...]
    T_reference_mount: Array  # (V, 4, 4) from the robot
    T_reference_flange: Array  # (V, 4, 4) carries a twist of the flange into the reference frame
    T_behind_mount: Array | None = None  # (V, 4, 4) what moves the scanner on its mount; None: nothing does
    sightings: Sightings | None = None  # labelled points; scans may be empty then
    # How much more the views scatter than the variance of the surfaces' distances says, for so many of them:
    # what clouds weigh beside labelled points.
    noise_factor: float = 1.0

    @property
    def scanner_rides(self) -> bool:
        """True if the robot carries the scanner, False if it carries the part."""
        return np.array_equal(self.T_reference_mount, self.T_reference_flange)

    @property
    def T_base_flange(self) -> Array:
        """(V, 4, 4) from the robot."""
        return self.T_reference_mount if self.scanner_rides else frames.inverse(self.T_reference_mount)

    @property
    def visible_points(self) -> list[Array]:
        """Per view the points (N, 3) that it shows, scanner frame: of its scan, or its labelled ones; maybe none."""
        if self.scans or self.sightings is None:
            return [scan.points for scan in self.scans]
        return self.sightings.points_by_view()

    @property
    def point_sets(self) -> list[Array]:
        """The same, (N, 3) each, of the views that show any."""
        return [points for points in self.visible_points if len(points)]

    @property
    def spacing(self) -> float:
        """Median distance between neighbouring points, length_unit."""
        return float(np.median([scan.spacing for scan in self.scans]))

    def poses(self, T_mount_scanner: Array) -> Array:
        """T_reference_scanner (V, 4, 4) under a hand-eye."""
        poses = self.hand_eye_frames(T_mount_scanner)
        return poses if self.T_behind_mount is None else np.asarray(poses @ self.T_behind_mount)

    def hand_eye_frames(self, T_mount_scanner: Array) -> Array:
        """(V, 4, 4) whose adjoint carries a right perturbation of the hand-eye into the reference frame."""
        return np.asarray(self.T_reference_mount @ T_mount_scanner)

    def without(self, left_out: Indices) -> "Capture":
        """The capture less some views."""
        keep = np.setdiff1d(np.arange(len(self.T_reference_mount)), left_out)
        return replace(
            self,
            scans=tuple(self.scans[v] for v in keep) if self.scans else (),
            T_reference_mount=self.T_reference_mount[keep],
            T_reference_flange=self.T_reference_flange[keep],
            T_behind_mount=None if self.T_behind_mount is None else self.T_behind_mount[keep],
            sightings=None if self.sightings is None else self.sightings.without(left_out),
        )


# Points of a session whose neighbours may all be held at once, 70 bytes each.
_AT_ONCE = 1_000_000


def prepare_capture(session: SessionData) -> Capture:
    """Prepare the scans and labelled points of a session and place them on the chain of frames.

    Raises:
        InputError: every cloud is one profile.
        NoResultError: labelled points of which no target is seen twice.
    """
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    scans = _prepare_scans(session) if session.has_clouds else ()
    if scans and not any((scan.confidence > GRAZING_COSINE).any() for scan in scans):
        raise InputError(
            f"{session.name}: every cloud is one profile, all its points in a plane through the scanner, and shows no "
            "surface; to fix: clouds swept over the part, or, of profiles of one sphere, stitch calibrate sphere"
        )
    return build_capture(session.name, scans, T_base_flange, session.mount, sightings_of(session))


def _prepare_scans(session: SessionData) -> tuple[Scan, ...]:
    """The scans of all views.

    Where room is no matter, all neighbours first: a library finds them without Python, for which the rest waits again
    and again while another thread still loads modules.
    """
    held = [None if view.cloud is None or view.cloud.whole is not None else view.cloud.points for view in session.views]
    around: Iterable[Neighbourhoods | None] = [None] * len(held)
    if sum(len(points) for points in held if points is not None) <= _AT_ONCE:
        around = list(parallel(lambda points: None if points is None else find_neighbourhoods(points), held))
    prepared = partial(_prepare_scan, scanner=session.scanner)
    return tuple(parallel(prepared, zip(session.views, around, strict=True), "preparing scans"))


def _prepare_scan(item: tuple[View, Neighbourhoods | None], scanner: Scanner) -> Scan:
    view, around = item
    assert view.cloud is not None
    if view.cloud.whole is not None:
        return view.cloud.whole.scan
    return prepare_scan(view.name, view.cloud.points, eye=scanner.eye(view.cloud.points), around=around)


def build_capture(
    name: str, scans: Sequence[Scan], T_base_flange: Array, mount: str, sightings: Sightings | None = None
) -> Capture:
    """A capture from scans, labelled points and flange poses (V, 4, 4)."""
    if mount == "eye_in_hand":
        return Capture(name, tuple(scans), T_base_flange, T_base_flange, sightings=sightings)
    still = np.broadcast_to(np.eye(4), T_base_flange.shape)
    return Capture(name, tuple(scans), frames.inverse(T_base_flange), still, sightings=sightings)


def part_size(captures: Sequence[Capture]) -> float:
    """Median diameter of the scans, length_unit."""
    return float(np.median([scan.size for c in captures for scan in c.scans]))


# Large scans made light: fewer points, each with the surface of all of them; the whole cloud stays where it is.
#
# Evidence about poses counts in views, and a view is asked a few thousand times (`overlaps.FINE_SAMPLES`). What remains
# must be dense enough that the nearest point lies on the same piece of surface; normals, edges and noise come from all
# points. Only what is fused is every point, and these are read once more when it is their turn.

# Some ten points for every query: √10 spacings of the queries lie between a point and its partner at most. Hand-eye and
# fused surface are then as near to the truth as with all points (docs/large-sessions.md).
MAX_POINTS = 39_000
# Four points for every query still lie within two of their spacings.
_MIN_POINTS = 12_000
# Measured: bytes that a point in memory takes until the run is written, as cloud and scan with its tree, and with its
# share of the correspondences; and what libraries and the slabs take in which everything is fused.
_BYTES_PER_POINT, _FIXED_BYTES = 220, 1.2e9


def points_within(memory: float, views: int) -> int:
    """How many points of each view may stay in memory.

    Args:
        memory: bytes for the whole run.

    Raises:
        InputError: so many views need more.
    """
    room = int((memory - _FIXED_BYTES) / (views * _BYTES_PER_POINT))
    if room < _MIN_POINTS:
        least = np.ceil((_FIXED_BYTES + views * _BYTES_PER_POINT * _MIN_POINTS) / 1e8) / 10
        raise InputError(
            f"memory: {memory / 1e9:.3g} GB are too little for a run of {views} views; to fix: give {least:.1f} GB"
        )
    return min(room, MAX_POINTS)


def thin_session(session: SessionData, at_most: int = MAX_POINTS) -> tuple[SessionData, Capture]:
    """A session with at most `at_most` points a view, evenly over the scan order, and its capture."""

    def of_view(view: View) -> View:
        if view.cloud is None:
            return view
        return replace(view, cloud=thin_cloud(view.name, view.cloud, at_most, session.scanner))

    session = replace(session, views=tuple(parallel(of_view, session.views)))
    return session, prepare_capture(session)


def thin_cloud(
    name: str, cloud: Cloud, at_most: int, scanner: Scanner, reload: Callable[[], Cloud] | None = None
) -> Cloud:
    """A cloud with at most `at_most` of its points, and where the whole is.

    Args:
        name: of the view.
        reload: reads the whole cloud again; None: it stays in memory.
    """
    picked = even_indices(len(cloud.points), at_most)
    if len(picked) == len(cloud.points):
        return cloud
    if cloud.whole is not None:
        return _take_points(cloud, picked, replace(cloud.whole, scan=subsample(cloud.whole.scan, at_most)))
    scan = prepare_scan(name, cloud.points, picked, scanner.eye(cloud.points))
    whole = WholeCloud(reload or (lambda: cloud), len(cloud.points), bounding_box(cloud.points), scan)
    return _take_points(cloud, picked, whole)


def distinct_points(cloud: Cloud) -> Cloud:
    """Return the cloud with every point once, in its order; the same object where none stands twice.

    A copy says nothing more, and normals, noise and spacing would be taken from a point's own copies.
    """
    x, y, z = cloud.points.T
    # Of different points hardly any two agree in one number, which sorts ten times as fast as three.
    if len(np.unique(x + np.sqrt(2) * y + np.sqrt(3) * z)) == len(cloud.points):
        return cloud
    _, first = np.unique(cloud.points, axis=0, return_index=True)
    if len(first) == len(cloud.points):
        return cloud
    first.sort()
    normals = None if cloud.normals is None else cloud.normals[first]
    scalars = {name: values[first] for name, values in cloud.scalars.items()}
    return replace(cloud, points=cloud.points[first], normals=normals, scalars=scalars)


def _take_points(cloud: Cloud, index: Indices, whole: WholeCloud) -> Cloud:
    """Some of the points; those of the scan are the same, so that memory holds them once."""
    normals = None if cloud.normals is None else cloud.normals[index]
    scalars = {name: values[index] for name, values in cloud.scalars.items()}
    return Cloud(whole.scan.points, normals, scalars, whole)
