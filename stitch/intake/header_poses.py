"""Poses of a folder without a table: those in the headers of its scans."""

from collections.abc import Sequence
from pathlib import Path

from stitch.errors import InputError
from stitch.intake.raw_poses import RawPoses
from stitch.reading.poses_in_scans import poses_in_scans, times_in_scans


def header_poses(clouds: Sequence[Path]) -> RawPoses:
    """The pose in the header of each scan, named as its file is, with the time where the header has one.

    Raises:
        InputError: a header without a pose.
    """
    poses = poses_in_scans(list(clouds))
    if poses is None:
        raise InputError(
            f"{clouds[0].parent}: no poses in the headers of the scans; to fix: name them with --poses FILE"
        )
    told = times_in_scans(list(clouds))
    times: Sequence[tuple[str, ...]] = [()] * len(clouds) if told is None else [(time,) for time in told]
    words = "they may be the scanner's own, of scans that were registered already: then the hand-eye is about unity"
    return RawPoses(
        source=f"{clouds[0].name} … {clouds[-1].name}",
        header=None,
        numbers=poses.reshape(-1, 16),
        labels=tuple((cloud.name, *time) for cloud, time in zip(clouds, times, strict=True)),
        words=words,
    )
