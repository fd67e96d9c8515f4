"""The rod's readings as a points session: the stand measures a cup, the second robot says where its tip touches it."""

import numpy as np

from stitch import frames
from stitch.cells.base_to_base.report import BaseResult
from stitch.cells.base_to_base.stand import Stand, rod_points
from stitch.cells.session_folder import HandOver, LabelledPoint


def session(stand: Stand, result: BaseResult) -> HandOver:
    """One view for each rod setting; the sensor's frame is the stand's.

    The readings tell where the tip was, not how it was turned: its frame is taken parallel to the base, which changes
    nothing, because the target lies in its origin.
    """
    cups = rod_points(stand.slide, stand.angle, stand.length, stand.turn)
    across = stand.length * stand.sigma_angle
    sigma = np.sqrt((stand.sigma_length**2 + across**2 + stand.sigma_slide**2) / 3)
    points = tuple(
        LabelledPoint(name, "tip", cup, float(s)) for name, cup, s in zip(stand.rod.names, cups, sigma, strict=True)
    )
    T_base2_stand = frames.inverse(result.fit.T_base1_base2) @ result.fit.T_base1_stand
    poses = frames.make(np.tile(np.eye(3), (len(cups), 1, 1)), stand.rod.points)
    return HandOver(
        "rod", stand.length_unit, "eye_to_hand", stand.rod.names, poses, T_base2_stand,
        points=points, targets={"tip": np.zeros(3)},
    )  # fmt: skip
