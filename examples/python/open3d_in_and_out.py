"""Open3D clouds and poses in; hand-eye and an Open3D cloud out."""

from pathlib import Path

import open3d as o3d

import stitch
from data_synth.made_session import make

cell = make("blade-table", {}, seed=3, views=6)  # a simulated cell, in place of yours
clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points)) for cloud in cell.clouds]
session = stitch.Session.from_arrays(clouds, cell.T_base_flange, mount="eye_in_hand", unit="mm")
run = stitch.run(session)
print(run.hand_eye)
o3d.io.write_point_cloud(Path("stitched.ply"), run.stitched.to_open3d())
