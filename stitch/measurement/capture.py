"""Scans and labelled points of one session with the robot's poses: what every stage after reading works on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array, Indices
from stitch.measurement.scan import GRAZING_COSINE, Scan, prepare_scan
from stitch.measurement.session import Scanner, Session, View
from stitch.measurement.sightings import Sightings, sightings_of
from stitch.system.threads import parallel


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


def prepare_capture(session: Session) -> Capture:
    """Prepare the scans and labelled points of a session and place them on the chain of frames.

    Raises:
        InputError: every cloud is one profile.
        NoResultError: labelled points of which no target is seen twice.
    """
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    prepared = partial(_prepare_scan, scanner=session.scanner)
    scans = tuple(parallel(prepared, session.views, "preparing scans")) if session.has_clouds else ()
    if scans and not any((scan.confidence > GRAZING_COSINE).any() for scan in scans):
        raise InputError(
            f"{session.name}: every cloud is one profile, all its points in a plane through the scanner, and shows no "
            "surface; to fix: clouds swept over the part, or, of profiles of one sphere, stitch calibrate sphere"
        )
    return build_capture(session.name, scans, T_base_flange, session.mount, sightings_of(session))


def _prepare_scan(view: View, scanner: Scanner) -> Scan:
    assert view.cloud is not None
    if view.cloud.whole is not None:
        return view.cloud.whole.scan
    return prepare_scan(view.name, view.cloud.points, eye=scanner.eye(view.cloud.points))


def build_capture(
    name: str, scans: Sequence[Scan], T_base_flange: Array, mount: str, sightings: Sightings | None = None
) -> Capture:
    """A capture from scans, labelled points and flange poses (V, 4, 4)."""
    if mount == "eye_in_hand":
        return Capture(name, tuple(scans), T_base_flange, T_base_flange, sightings=sightings)
    still = np.broadcast_to(np.eye(4), T_base_flange.shape)
    return Capture(name, tuple(scans), frames.inverse(T_base_flange), still, sightings=sightings)


def part_size(captures: Sequence[Capture]) -> float:
    """Median diameter of the scans' point sets: twice the rms distance from their centroids."""
    spread = [np.sqrt(scan.points.var(axis=0).sum()) for c in captures for scan in c.scans]
    return 2 * float(np.median(spread))
