"""The rod's readings as a points session: the stand measures a cup, the second robot says where its tip touches it."""

import numpy as np

from stitch import frames
from stitch.cells.base_to_base.stand import Stand, rod_points
from stitch.cells.base_to_base.stand_solution import BaseResult
from stitch.cells.session_tables import points_table
from stitch.writing.session_files import SessionFiles, pose_columns


def rod_session(stand: Stand, result: BaseResult) -> SessionFiles:
    """One view for each rod setting; the sensor's frame is the stand's.

    The readings tell where the tip was, not how it was turned: its frame is taken parallel to the base, which changes
    nothing, because the target lies in its origin.
    """
    cups = rod_points(stand.slide, stand.angle, stand.length, stand.turn)
    across = stand.length * stand.sigma_angle
    sigma = np.sqrt((stand.sigma_length**2 + across**2 + stand.sigma_slide**2) / 3)
    T_base2_stand = frames.inverse(result.fit.T_base1_base2) @ result.fit.T_base1_stand
    T_base2_tip = frames.make(np.tile(np.eye(3), (len(cups), 1, 1)), stand.rod.points)
    names = stand.rod.names
    return SessionFiles(
        name="rod",
        length_unit=stand.length_unit,
        mount="eye_to_hand",
        tables={"scanner": {"pose": T_base2_stand.tolist()}},
        views={"view": names, **pose_columns(T_base2_tip)},
        points=points_table(names, ["tip"] * len(names), cups, sigma),
        targets={"tip": np.zeros(3)},
    )
