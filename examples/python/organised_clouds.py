"""Organised clouds (H, W, 3) with brightness, NaN where nothing was measured; the stitched cloud as GLB."""

import numpy as np

import stitch
from data_synth.made_session import make

cell = make("blade-table", {}, seed=3, views=6)  # a simulated cell, in place of yours
clouds = []
for cloud in cell.clouds:
    image = np.full((300, 400, 3), np.nan)
    image.reshape(-1, 3)[: len(cloud.points)] = cloud.points
    clouds.append({"points": image, "intensity": np.linalg.norm(image, axis=2)})
run = stitch.run(stitch.Session.from_arrays(clouds, cell.T_base_flange, mount="eye_in_hand", unit="mm"))
print(run.hand_eye)
stitch.export_run(run, "glb", "stitched.glb")
