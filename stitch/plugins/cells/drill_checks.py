"""What a drilling cell shows of itself: the plate's place by its locating holes, and trial drives to the holes.

Trial drives tell what camera and rangers see at a hole, before and after the correction, and what a pin that is driven
into it bounds (tables 4, 6 and 7 of the source).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array
from stitch.plugins.cells.drilling_sensors import HoleSight
from stitch.plugins.cells.job_files import CsvColumns, JobTable, on_a_line, read_columns

MIN_LOCATING = 3
STAGES = ("drawing", "corrected", "levelled")  # driven by the drawing, by the correction, and then along the normal


@dataclass(frozen=True)
class PlatePlace:
    """Of the nine holes along the flange's z, length unit."""

    height: float  # mean, h of the source
    stated: float
    parallelism: float  # largest distance of a hole from that mean
    locating_rms: float | None  # of the locating holes, fitted; None where the plate is given in the flange frame


def holes_in_flange(file: Path, plate_xyz: Array, T_measuring_flange: Array) -> tuple[Array, float]:
    """Return the plate's holes (N, 3) in the flange frame and the locating holes' rms.

    Args:
        file: locating holes, x y z in the plate's frame and seen_x seen_y seen_z in the measuring system.
        plate_xyz: (N, 3) in the plate's frame.
        T_measuring_flange: (4, 4) at the home pose.

    Raises:
        InputError: a column is missing, or fewer than three holes off one line.
    """
    table = read_columns(file, "", "x y z seen_x seen_y seen_z")
    nominal = table.stack("x y z")
    seen = table.stack("seen_x seen_y seen_z")
    if len(nominal) < MIN_LOCATING or on_a_line(nominal) or on_a_line(seen):
        raise InputError(f"{file}: the holes fix no plate; to fix: measure {MIN_LOCATING} or more off one line")
    T_measuring_plate = align_points(nominal, seen)
    off = seen - frames.transform(T_measuring_plate, nominal)
    inside = frames.transform(frames.inverse(T_measuring_flange) @ T_measuring_plate, plate_xyz)
    return inside, float(np.sqrt((off**2).sum(axis=1).mean()))


def plate_place(plate_xyz: Array, stated: float, locating_rms: float | None) -> PlatePlace:
    """Return height and parallelism of holes (N, 3) in the flange frame."""
    z = plate_xyz[:, 2]
    return PlatePlace(float(z.mean()), stated, float(np.abs(z - z.mean()).max()), locating_rms)


@dataclass(frozen=True)
class TrialError:
    """Error of one drive; lengths in length unit, angles in rad."""

    hole: str
    stage: str
    height: float  # h' − h
    tilt: float  # of the surface's normal against the flange's z
    in_plane: float  # e2D, by the camera
    distance: float  # of all three
    pin_position: float | None  # largest error that lets the pin in
    pin_tilt: float | None


def read_trials(file: Path, rangers: tuple[str, ...], with_pin: bool) -> CsvColumns:
    """Read trial drives: hole, stage, u, v, a column for each ranger and, with a pin, the hole's diameter.

    Raises:
        InputError: a column is missing, an unknown stage, or fewer than three rangers.
    """
    if len(rangers) < 3:
        raise InputError(f"{file}: trials need three rangers for a normal; to fix: name the rangers' table")
    table = read_columns(file, "hole stage", f"u v {' '.join(rangers)}{' diameter' if with_pin else ''}")
    for stage in table.texts["stage"]:
        if stage not in STAGES:
            raise InputError(f"{file}: stage is {stage!r}; to fix: write one of {', '.join(STAGES)}")
    return table


def read_pin(document: JobTable) -> tuple[float, float] | None:
    """Return diameter and feed along the hole, from the levelled pose, of a pin in the tool's place; None without."""
    if "pin" not in document:
        return None
    table = document.table("pin", ("diameter", "feed"))
    return table.number("diameter", positive=True), table.number("feed", positive=True)


def trial_error(hole: str, stage: str, sight: HoleSight, pin: tuple[float, float] | None = None) -> TrialError:
    """Return the error of one drive to a hole from what was seen there.

    Args:
        pin: the hole's play about a pin that was driven into it (difference of diameters), and the pin's feed.
    """
    height = float(sight.offset[2])
    position = turn = None
    if pin is not None:
        play, feed = pin
        # The pin went in: it leaves the hole no more room than this, nor can it stray further than its tilt says.
        position = min(play / 2, sight.in_plane + feed * np.tan(sight.tilt))
        turn = float(np.arctan(position / feed))
    return TrialError(
        hole,
        stage,
        height=height,
        tilt=sight.tilt,
        in_plane=sight.in_plane,
        distance=float(np.hypot(height, sight.in_plane)),
        pin_position=position,
        pin_tilt=turn,
    )
