"""A robot path moved along with the part."""

from stitch import frames
from stitch.frames import Array


def correct_path(T_base_tool: Array, T_base_part_nominal: Array, T_base_part: Array) -> Array:
    """Poses (N, 4, 4) that stand to the found part as the programmed ones stand to the nominal part.

    T_base_tool' = T_base_part · T_base_part_nominal⁻¹ · T_base_tool.
    """
    return T_base_part @ frames.inverse(T_base_part_nominal) @ T_base_tool
