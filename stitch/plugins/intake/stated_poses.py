"""Poses that a person passes as arrays: rows of numbers are read as a table is, and scans confirm what was stated.

`Session.from_arrays` and `stitch.live` find this by the entry-point groups `stitch.pose_tables`, `stitch.pose_checks`.
"""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from stitch.numerics.units import METRES
from stitch.plugins.intake.cloud_pairs import pairings
from stitch.plugins.intake.convention_choice import choose_convention, require_own_frames
from stitch.plugins.intake.first_session import capture_of
from stitch.plugins.intake.layouts import MM, cloud_units, pose_units
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import Reading, all_readings
from stitch.plugins.intake.refusals import Fix, Refusal, state
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.screening.motions import register_scan_pairs
from stitch.session.reading.arrays import cloud_of
from stitch.session.session import SessionData

# Two motions, the fewest that tell a reading.
_FEWEST_VIEWS = 3
# Numbers of a pose in a row: six to sixteen.
_WIDTHS = range(6, 17)


def matrices_of_table(poses: Any, scans: Sequence[Any], length_unit: str, cloud_unit: str, mount: str) -> Any:
    """Return rows of numbers as poses (V, 4, 4), as a table of them would be read; what is none of that as it is.

    Args:
        poses: (V, 6 … 16) or (V, 3, 4) numbers, or a DataFrame whose columns have names.
        scans: as passed, that tell the reading where names and numbers do not; None: none.

    Raises:
        InputError: numbers that hold no pose, or that can be read in several ways.
    """
    names = tuple(map(str, poses.columns)) if hasattr(poses, "columns") else None
    try:
        table = np.asarray(poses, float)
    except (TypeError, ValueError):
        return poses
    table = table.reshape(len(table), -1) if table.shape[1:] == (3, 4) else table
    if table.ndim != 2 or table.shape == (4, 4) or (names is None and table.shape[1] not in _WIDTHS):
        return poses
    raw = RawPoses("poses", names, table, ((),) * len(table), "an array")
    found = all_readings(raw, None, StatedFolder(length_unit=length_unit))
    return (found[0] if len(found) == 1 else _told_by_scans(found, raw, scans, length_unit, cloud_unit, mount)).T


def _told_by_scans(
    found: Sequence[Reading], raw: RawPoses, scans: Sequence[Any], length_unit: str, cloud_unit: str, mount: str
) -> Reading:
    words = "pass matrices (V, 4, 4), such as scipy's Rotation and the positions make"
    refusal = Refusal(f"poses: {raw.numbers.shape} numbers can be read in {len(found)} ways", Fix(words))
    if len(scans) != len(raw.numbers) or len(scans) < _FEWEST_VIEWS or any(scan is None for scan in scans):
        raise refusal
    clouds = [cloud_of(scan, f"view {i}") for i, scan in enumerate(scans)]
    pairs = pairings([Path("scan")] * len(scans), raw.labels)[:1]
    by_size = (
        next((unit for unit in pose_units(found[0].T[:, :3, 3]) if unit in METRES), length_unit),
        cloud_units([cloud.points for cloud in clouds])[0],
    )
    for unit, own in dict.fromkeys([(length_unit, cloud_unit), by_size]):
        capture = capture_of(clouds, METRES[own] / MM)
        motions = cache(partial(register_scan_pairs, capture))
        choice = choose_convention(capture, motions, found, pairs, [unit], mount == "eye_in_hand")
        if choice.determined and (unit, own) != (length_unit, cloud_unit):
            told = f"with poses in {unit} and clouds in {own}, not as stated"
            raise Refusal(f"poses: {raw.numbers.shape} numbers fit the scans {told}", state(unit=unit, cloud_unit=own))
        if choice.determined:
            return choice.best.interpretation.reading
    raise refusal


def scans_confirm(session: SessionData) -> bool:
    """Return True if the scans tell one reading of the poses from all others, and it is the one that was stated.

    Raises:
        InputError: the scans lie in one frame already.
    """
    T = np.array([view.T_base_flange for view in session.views])
    if len(T) < _FEWEST_VIEWS:
        return False
    clouds = [view.cloud for view in session.views if view.cloud is not None]
    raw = RawPoses(str(session.path), None, T.reshape(-1, 16), ((),) * len(T), "an array")
    stated = StatedFolder(length_unit=session.length_unit)
    capture = capture_of(clouds, METRES[session.length_unit] / MM)
    motions = cache(lambda: register_scan_pairs(capture))
    pairs = pairings([Path("scan")] * len(T), raw.labels)
    choice = choose_convention(capture, motions, all_readings(raw, None, stated), pairs, [session.length_unit])
    require_own_frames(session.path, motions, choice)
    best = choice.best.interpretation
    in_order = best.pairing.rows == tuple(range(len(T)))
    return choice.determined and in_order and best.carries == (session.mount == "eye_in_hand")
