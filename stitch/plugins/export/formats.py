"""Names of the formats of `stitch export`; nothing is imported, so that its help waits for no library."""

from typing import Literal, get_args

HandEye = Literal["ros", "urdf", "opencv", "zivid", "kuka", "fanuc", "abb", "ur"]
Arm = Literal["arm-dh", "arm-urdf"]
Cloud = Literal["ply", "pcd", "las", "laz", "e57", "glb"]
HAND_EYE: tuple[str, ...] = get_args(HandEye)
ARM: tuple[str, ...] = get_args(Arm)
CLOUD: tuple[str, ...] = get_args(Cloud)

# Largest believable move, mm: an industrial arm that nobody calibrated is off by 1 to 2 mm (IRB 1600: at most 2.2 mm,
# Nubiola & Bonev 2013, Robotics and Computer-Integrated Manufacturing 29:236); more than twice that is another arm, a
# wrong frame or a wrong tool.
LIMIT_MM = 5.0
