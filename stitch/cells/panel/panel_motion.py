"""Commands of the six robots: pre-positioning, master and slaves, pose adjustment."""

import numpy as np

from stitch import frames
from stitch.frames import Array


def preposition(T_world_base: Array, T_world_panel: Array, T_panel_contact: Array, T_flange_contact: Array) -> Array:
    """T_base_flange (N, 4, 4) that brings every clamp to its place on a panel that stands at T_world_panel (4, 4).

    T_Bi_Fi = T_W_Bi⁻¹ · T_W_P · T_P_CPi · T_Fi_CPi⁻¹.
    """
    return np.asarray(frames.inverse(T_world_base) @ T_world_panel @ T_panel_contact @ frames.inverse(T_flange_contact))


def follow(T_world_base: Array, T_base_flange: Array, master: int, T_base_flange_master: Array) -> Array:
    """All T_base_flange (N, 4, 4) once the master (index) goes to T_base_flange_master (4, 4).

    Clamps keep their relative poses: T_BiS_FiS' = T_BiS_BM · T_BM_FM' · T_FiS_FM⁻¹, where T_FiS_FM follows from the
    poses (N, 4, 4) at which the robots stand now and T_BiS_BM from the global model.
    """
    T_slave_master = frames.inverse(T_world_base) @ T_world_base[master]
    T_world_flange = T_world_base @ T_base_flange
    T_flange_master = frames.inverse(T_world_flange) @ T_world_flange[master]
    moved = T_slave_master @ T_base_flange_master @ frames.inverse(T_flange_master)
    moved[master] = T_base_flange_master
    return np.asarray(moved)


def adjust_pose(
    T_world_base: Array, T_base_flange: Array, master: int, T_world_panel: Array, T_world_target: Array
) -> Array:
    """All T_base_flange (N, 4, 4) that take the panel from its measured pose to its target pose, both (4, 4).

    The panel rides on the master: T_BM_FM' = T_W_BM⁻¹ · (T_W_target · T_W_P⁻¹) · T_W_BM · T_BM_FM.
    """
    base = T_world_base[master]
    motion = T_world_target @ frames.inverse(T_world_panel)
    T_master = frames.inverse(base) @ motion @ base @ T_base_flange[master]
    return follow(T_world_base, T_base_flange, master, T_master)
