"""From a folder of scans and poses to the first session: read, paired, judged by the scans, with reasons.

What a person states is taken; what the files tell is read; the rest is decided by the scans (`doctor.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.cloud_pairs import Pairing, pairings
from stitch.intake.doctor import ConventionChoice, choose_convention
from stitch.intake.found_files import FolderFiles, find_folder_files
from stitch.intake.guesses import Guess
from stitch.intake.header_poses import header_poses
from stitch.intake.joint_poses import JOINT_ANGLES, joint_layouts, joint_readings
from stitch.intake.layouts import possible_layouts
from stitch.intake.mounting import Mounting, choose_mounting
from stitch.intake.one_frame import require_own_frames
from stitch.intake.plausible_units import CLOUD_UNITS, cloud_units, pose_units
from stitch.intake.program_poses import is_program, program_poses
from stitch.intake.raw_poses import RawPoses, read_raw_poses
from stitch.intake.readings import Reading, readings
from stitch.intake.stated import StatedFolder, StatedTable
from stitch.intake.target_motions import target_motions
from stitch.intake.targets_of_folder import find_folder_targets
from stitch.intake.ways import MM
from stitch.intake.why import session_guesses
from stitch.integrity.relative_scans import register_scan_pairs
from stitch.measurement.capture import Capture
from stitch.measurement.cloud import Cloud
from stitch.measurement.labelled_points import Sighting
from stitch.measurement.session import Scanner, Session, View
from stitch.measurement.thinning import thin_session
from stitch.reading.clouds import read_cloud

# Enough points a view to tell conventions.
_POINTS = 8000
_FEWEST = 3


@dataclass(frozen=True)
class FirstSession:
    """What was found in a folder and how it is to be taken."""

    files: FolderFiles
    raw: RawPoses
    cloud_unit: str
    choice: ConventionChoice
    mounting: Mounting
    guesses: tuple[Guess, ...]
    optical_axis: str
    sightings: tuple[Sighting, ...] = ()  # mm, of every cloud, where targets are looked for

    @property
    def pairing(self) -> Pairing:
        """Which row belongs to which cloud."""
        return self.choice.best.interpretation.pairing


def first_session(folder: Path, stated: StatedFolder) -> FirstSession:
    """Find, read and judge.

    Raises:
        InputError: no clouds or poses, or one that cannot be read; names the file and what to do.
    """
    found = find_folder_files(folder, stated.poses)
    raw = _read_folder_poses(found)
    raw = raw.renamed(stated.columns) if stated.columns else raw
    ways_to_read = all_readings(raw, found.urdf, stated)
    clouds = [read_cloud(file) for file in found.clouds]
    for file, cloud in zip(found.clouds, clouds, strict=True):
        if len(cloud.points) < _FEWEST:
            raise InputError(f"{file}: {len(cloud.points)} points show no surface; to fix: take the scan out")
    points = [c.points for c in clouds]
    own_units = [stated.cloud_unit] if stated.cloud_unit else cloud_units(points)
    pairs = pairings(found.clouds, raw.labels, raw.numbers)
    capture = capture_of(clouds, CLOUD_UNITS[own_units[0]] / MM)
    units = candidate_units(ways_to_read, stated)
    seen, of_targets = find_folder_targets(found, points, CLOUD_UNITS[own_units[0]], stated.targets)
    motions = cache(lambda: register_scan_pairs(capture))
    shown = target_motions(seen) if seen else None
    decided = choose_convention(capture, motions, ways_to_read, pairs, units, stated.carries, shown)
    require_own_frames(folder, motions, decided)
    of_joints = decided.best.interpretation.reading.rotation == JOINT_ANGLES
    settled = choose_mounting(decided, stated.mount, stated.inverse, of_joints)
    axis, axis_guess = guess_optical_axis(clouds)
    told = session_guesses(found, raw, decided, points, own_units, stated)
    guesses = (*told, settled.guess, axis_guess, *of_targets)
    return FirstSession(found, raw, own_units[0], decided, settled, guesses, optical_axis=axis, sightings=seen)


def _read_folder_poses(files: FolderFiles) -> RawPoses:
    if not files.poses:
        return header_poses(files.clouds)
    first = files.poses[0]
    if is_program(first):
        return program_poses(first)
    return read_raw_poses(files.poses)


def all_readings(raw: RawPoses, urdf: Path | None, stated: StatedTable) -> list[Reading]:
    """Every reading of a table that is not ruled out by what a person states.

    Args:
        urdf: of the robot, where the table may hold joint angles.

    Raises:
        InputError: columns that hold no pose.
    """
    out: list[Reading] = []
    for layout in possible_layouts(raw):
        if layout.rotation.shape[1]:
            out += readings(layout, stated.rotation, stated.angle_unit)
        else:
            out += joint_readings(layout, urdf, stated.angle_unit)
    if raw.header is None and raw.numbers.shape[1] >= 6 and urdf is not None and stated.rotation is None:
        out += [r for layout in joint_layouts(raw) for r in joint_readings(layout, urdf, stated.angle_unit)]
    return out


def candidate_units(readings: Sequence[Reading], stated: StatedTable) -> list[str]:
    """Units that positions can have of which the file does not say it: stated, or plausible."""
    if stated.length_unit:
        return [stated.length_unit]
    open_ = [r for r in readings if r.layout.length_unit is None]
    return list(dict.fromkeys(unit for r in open_ for unit in pose_units(r.T[:, :3, 3]))) or ["mm"]


def capture_of(clouds: Sequence[Cloud], scale: float) -> Capture:
    """Scans made light, in mm, at no poses."""
    views = tuple(
        View(
            name=f"v{i}",
            cloud=Cloud(cloud.points * scale, cloud.normals),
            T_base_flange=np.eye(4),
            joints=None,
            approach=None,
            time_s=None,
            covariates={},
        )
        for i, cloud in enumerate(clouds)
    )
    session = Session(
        path=Path(),
        name="",
        length_unit="mm",
        mount="eye_in_hand",
        scanner=Scanner(None, None, None, np.array([0.0, 0.0, 1.0])),
        robot=None,
        sphere_radius=None,
        cad=None,
        cad_unit=None,
        views=views,
    )
    return thin_session(session, _POINTS)[1]


def guess_optical_axis(clouds: Sequence[Cloud]) -> tuple[str, Guess]:
    """The side of z on which the points lie."""
    middle: Array = np.mean([np.median(c.points, axis=0) for c in clouds], axis=0)
    axis = "-z" if middle[2] < 0 and abs(middle[2]) > np.linalg.norm(middle[:2]) else "+z"
    told = abs(middle[2]) > np.linalg.norm(middle[:2])
    where = ", ".join(f"{x:.3g}" for x in middle)
    reason = f"the middle of the scans lies at ({where}) in the scanner's frame"
    return axis, Guess("optical_axis", axis, reason, bool(told), "optical_axis in session.toml")
