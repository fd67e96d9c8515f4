"""Scans and labelled points of one session with the robot's poses: what every stage after reading works on.

Labelled points stand in arrays of one shape: S slots a view, empty where a target was not seen.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.units import METRES
from stitch.session.kept_scans import KeptScans
from stitch.session.scan import (
    GRAZING_COSINE,
    Neighbourhoods,
    Scan,
    Stock,
    find_neighbourhoods,
    prepare_scan,
    without_stock,
)
from stitch.session.scanners import scanners_of, stops_of
from stitch.session.session import Cloud, Scanner, SessionData
from stitch.system.threads import parallel
from stitch.system.values import take_rows

# Where neither a row nor scanner.noise says how well the sensor sees: what a good one does, in metres. The factor
# on the noise is estimated from the data anyway.
_USUAL_SIGMA_M = 1e-5
# A probe's own targets lie some 20 cm apart: that is how well it knows its direction, unless it says so itself.
_PROBE_LEVER_M = 0.2
# V·k² pairs of points of one view, k a view: each takes 72 bytes of covariance.
_MOST_PRODUCTS = 8e5
# So many points of a view stay in any case: more than a dozen say little more of a pose that scatters.
_FEWEST_POINTS = 12
# Points of a session whose neighbours may all be held at once, 70 bytes each.
_AT_ONCE = 1_000_000


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
        """(K,) number of views in which each target is used."""
        return np.bincount(self.target[self.used], minlength=len(self.targets)).astype(np.int64)

    @property
    def with_outliers(self) -> "Sightings":
        """The sightings with all points used that were seen, outliers included."""
        return replace(self, used=self.target >= 0)

    def points_by_view(self) -> list[Array]:
        """Return per view the points in use (k, 3), sensor frame; (0, 3) where there is none."""
        return [points[used] for points, used in zip(self.points, self.used, strict=True)]

    def at_most(self, count: int) -> "Sightings":
        """Return the sightings with at most `count` points of each view, spread evenly over its targets.

        Each view begins one target later than the view before, so that all targets appear over the views.
        """
        if count >= self.target.shape[1]:
            return self
        slots = np.full((len(self.target), count), -1)  # of each view the slots that stay; −1 where it shows fewer
        for view, target in enumerate(self.target):
            seen = np.flatnonzero(target >= 0)
            if len(seen) > count:
                seen = seen[(view + np.arange(count) * len(seen) // count) % len(seen)]
            slots[view, : len(seen)] = seen
        views = np.arange(len(slots))[:, None]
        is_filled = slots >= 0
        target = np.where(is_filled, self.target[views, slots], -1)
        points = np.where(is_filled[..., None], self.points[views, slots], 0.0)
        used = self.used[views, slots] & is_filled
        return replace(self, target=target, points=points, sigma=self.sigma[views, slots], used=used)

    def without(self, left_out: Indices) -> "Sightings":
        """Return the sightings without the views at the indices `left_out`."""
        keep = np.setdiff1d(np.arange(len(self.points)), left_out)
        return take_rows(self, keep, "target", "points", "sigma", "used", "rotation", "sigma_rotation")


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
    scanner: Indices | None = None  # (V,) of several scanners the one of each view
    stop: Indices | None = None  # (V,) the stop of each, where the flange errs once for all that scan; None: its own
    # How much more the views scatter than the variance of the surfaces' distances says, for so many of them:
    # what clouds weigh beside labelled points.
    noise_factor: float = 1.0
    none_has_stock: bool = False  # too many seemed to: what stands off is the scanner's error, or the surface's

    @property
    def scanner_rides(self) -> bool:
        """True if the robot carries the scanner, False if it carries the part."""
        return np.array_equal(self.T_reference_mount, self.T_reference_flange)

    @property
    def T_base_flange(self) -> Array:
        """(V, 4, 4) from the robot."""
        return self.T_reference_mount if self.scanner_rides else frames.inverse(self.T_reference_mount)

    @property
    def shares_stop(self) -> Array:
        """(V, V) 1 for views between which the arm has not moved, else 0."""
        stop = np.arange(len(self.T_reference_mount)) if self.stop is None else self.stop
        return np.equal.outer(stop, stop).astype(float)

    @property
    def visible_points(self) -> list[Array]:
        """Per view the points (N, 3) that it shows, scanner frame: of its scan, or its labelled ones; maybe none."""
        if self.scans or self.sightings is None:
            return [scan.points for scan in self.scans]
        return self.sightings.points_by_view()

    @property
    def point_sets(self) -> list[Array]:
        """The visible points (N, 3), scanner frame, of each view that has any: a list that may be shorter than V."""
        return [points for points in self.visible_points if len(points)]

    def seen_by(self, scanner: int) -> list[Array]:
        """Return the visible points (N, 3), scanner frame, of each view of a scanner that has any.

        Args:
            scanner: its index; where the capture has a single scanner all views count.
        """
        every = self.visible_points
        of_view = self.scanner if self.scanner is not None else np.full(len(every), scanner)
        return [points for points, k in zip(every, of_view, strict=True) if k == scanner and len(points)]

    @property
    def spacing(self) -> float:
        """Median distance between neighbouring points, length_unit."""
        return float(np.median([scan.spacing for scan in self.scans]))

    def poses(self, T_mount_scanner: Array) -> Array:
        """Return T_reference_scanner (V, 4, 4) under a hand-eye T_mount_scanner (4, 4)."""
        poses = self.hand_eye_frames(T_mount_scanner)
        return poses if self.T_behind_mount is None else poses @ self.T_behind_mount

    def hand_eye_frames(self, T_mount_scanner: Array) -> Array:
        """Return T_reference_mount · T_mount_scanner (V, 4, 4), without what stands right of the hand-eye.

        Its adjoint maps a right perturbation of the hand-eye, T·exp(ξ), to a twist in the reference frame.
        """
        return self.T_reference_mount @ T_mount_scanner

    def without_stock(self, stock: Mapping[int, Stock | None]) -> "Capture":
        """Return the capture with the points of stock moved back to the surface under it.

        Args:
            stock: view -> stock to take off; None: points that were moved before return to where they were scanned,
                and no view of the capture is searched for stock again (`none_has_stock`).
        """
        scans = tuple(without_stock(s, stock[v]) if v in stock else s for v, s in enumerate(self.scans))
        return replace(self, scans=scans, none_has_stock=self.none_has_stock or None in stock.values())

    def without(self, left_out: Indices) -> "Capture":
        """Return the capture without the views at the indices `left_out`; stops are numbered anew from 0."""
        keep = np.setdiff1d(np.arange(len(self.T_reference_mount)), left_out)
        of_views = ("scans", "T_reference_mount", "T_reference_flange", "T_behind_mount", "scanner")
        return replace(
            take_rows(self, keep, *of_views),
            sightings=None if self.sightings is None else self.sightings.without(left_out),
            stop=None if self.stop is None else np.unique(self.stop[keep], return_inverse=True)[1],
        )


def prepare_capture(session: SessionData, kept: KeptScans | None = None) -> Capture:
    """Return the capture of a session: its scans made ready for matching, its labelled points, its chain of frames.

    Of labelled points without scans so many are used that the fit stays within memory (`_MOST_PRODUCTS`).

    Args:
        kept: scans that an earlier run made ready: those of the same points are taken from there. None: all anew.

    Raises:
        InputError: every cloud is one profile.
        NoResultError: labelled points of which no target is seen twice.
    """
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    scans = _prepare_scans(session, kept or KeptScans({})) if session.has_clouds else ()
    if scans and not any((scan.confidence > GRAZING_COSINE).any() for scan in scans):
        raise InputError(
            f"{session.name}: every cloud is one profile, all its points in a plane through the scanner, and shows no "
            "surface; to fix: clouds swept over the part, or, of profiles of one sphere, stitch calibrate sphere"
        )
    sightings = sightings_of(session)
    if sightings is not None and not scans:
        sightings = sightings.at_most(max(int(np.sqrt(_MOST_PRODUCTS / len(sightings.target))), _FEWEST_POINTS))
    return with_scanners(session, build_capture(session.name, scans, T_base_flange, session.mount, sightings))


def with_scanners(session: SessionData, capture: Capture) -> Capture:
    """Return the capture with the scanner and stop of each view, if the session joins several scanners; else as it is.

    `T_behind_mount` places each further scanner as its own session states it.
    """
    scanners = scanners_of(session)
    if not scanners:
        return capture
    return replace(capture, T_behind_mount=scanners.behind, scanner=scanners.of_view, stop=stops_of(session))


def build_capture(
    name: str, scans: Sequence[Scan], T_base_flange: Array, mount: str, sightings: Sightings | None = None
) -> Capture:
    """Return a capture from scans, labelled points and flange poses.

    Args:
        T_base_flange: (V, 4, 4).
        mount: eye_to_hand | eye_in_hand: which of flange and base is the reference frame.
        sightings: labelled points; None: there are none.
    """
    if mount == "eye_in_hand":
        return Capture(name, tuple(scans), T_base_flange, T_base_flange, sightings=sightings)
    still = np.broadcast_to(np.eye(4), T_base_flange.shape)
    return Capture(name, tuple(scans), frames.inverse(T_base_flange), still, sightings=sightings)


def _prepare_scans(session: SessionData, kept: KeptScans) -> tuple[Scan, ...]:
    """Return the scans of all views that have a cloud, made ready for matching on all cores.

    Where memory allows, the neighbours of all points are found first. The library does that without the interpreter's
    lock, which other threads that still import modules hold again and again.

    Args:
        kept: scans that need not be made again.
    """
    # Each view with its scanner's description; of several scanners each has a session.
    scanners = [part.scanner for part in session.parts] or [session.scanner]
    seen = [(scanners[view.scanner], view.cloud) for view in session.views if view.cloud is not None]

    def known(item: tuple[str, tuple[Scanner, Cloud]]) -> Scan | None:
        """Return the scan of one view where it is made already: that of a thinned cloud's points, or a kept one."""
        name, (scanner, cloud) = item
        if cloud.whole is not None:
            return cloud.whole.scan
        return kept.scan(name, cloud.points, scanner.eye(cloud.points)) if kept.found else None

    scans = list(parallel(known, zip(session.names, seen, strict=True)))
    clouds = [cloud.points if scan is None else None for scan, (_, cloud) in zip(scans, seen, strict=True)]
    around: Iterable[Neighbourhoods | None] = [None] * len(clouds)
    if sum(len(points) for points in clouds if points is not None) <= _AT_ONCE:
        around = list(parallel(lambda points: None if points is None else find_neighbourhoods(points), clouds))

    def prepared(item: tuple[str, Scan | None, tuple[Scanner, Cloud], Neighbourhoods | None]) -> Scan:
        """Return the scan of one view."""
        name, scan, (scanner, cloud), neighbours = item
        return scan or prepare_scan(name, cloud.points, eye=scanner.eye(cloud.points), around=neighbours)

    items = zip(session.names, scans, seen, around, strict=True)
    return tuple(parallel(prepared, items, "preparing scans"))


def sightings_of(session: SessionData) -> Sightings | None:
    """Return all labelled points of a session as arrays over views and slots; None without any.

    Targets are numbered in the order of their names. A missing sigma is the scanner's noise, else `_USUAL_SIGMA_M`; a
    missing one of a probe's rotation is the sigma of its position over `_PROBE_LEVER_M`.
    """
    seen = {v: view.sighting for v, view in enumerate(session.views) if view.sighting is not None}
    names = sorted({name for sighting in seen.values() for name in sighting.targets})
    if not names:
        return None
    number = {name: k for k, name in enumerate(names)}
    V = len(session.views)
    S = max(len(sighting.targets) for sighting in seen.values())
    target = np.full((V, S), -1)
    points = np.zeros((V, S, 3))
    sigma = np.ones((V, S))
    rotation = np.tile(np.eye(3), (V, 1, 1))
    sigma_rotation = np.full(V, np.nan)
    for v, sighting in seen.items():
        k = len(sighting.targets)
        target[v, :k] = [number[name] for name in sighting.targets]
        points[v, :k] = sighting.points
        sigma[v, :k] = sighting.sigma
        if sighting.rotation is not None:
            rotation[v] = sighting.rotation
            sigma_rotation[v] = sighting.sigma_rotation
    metres = METRES[session.length_unit]
    usual = _USUAL_SIGMA_M / metres if session.scanner.noise is None else session.scanner.noise
    sigma = np.where(np.isnan(sigma), usual, sigma)
    sightings = Sightings(tuple(names), target, points, sigma, target >= 0)
    if all(sighting.rotation is None for sighting in seen.values()):
        return sightings
    sigma_rotation = np.where(np.isnan(sigma_rotation), sigma[:, 0] * metres / _PROBE_LEVER_M, sigma_rotation)
    return replace(sightings, rotation=rotation, sigma_rotation=sigma_rotation)


def part_size(captures: Sequence[Capture]) -> float:
    """Return the median diameter of the scans, length_unit."""
    return float(np.median([scan.size for c in captures for scan in c.scans]))
