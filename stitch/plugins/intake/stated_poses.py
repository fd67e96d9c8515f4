"""Whether scans confirm the convention of poses that a person states with arrays, before `stitch check --deep` judges.

`Session.from_arrays` and `stitch.live` find it by the entry-point group `stitch.pose_checks`.
"""

from functools import cache
from pathlib import Path

import numpy as np

from stitch.numerics.units import METRES
from stitch.plugins.intake.cloud_pairs import pairings
from stitch.plugins.intake.convention_choice import choose_convention, require_own_frames
from stitch.plugins.intake.first_session import capture_of
from stitch.plugins.intake.layouts import MM
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import all_readings
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.screening.motions import register_scan_pairs
from stitch.session.session import SessionData

# Two motions, the fewest that tell a reading.
_FEWEST_VIEWS = 3


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
