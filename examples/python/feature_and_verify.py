"""U of a feature, and scans that no fit has seen judge the hand-eye."""

import stitch
from data_synth.made_session import make

cell = make("blade-table", {}, seed=3, views=16)  # a simulated cell, in place of yours
clouds, poses = [cloud.points for cloud in cell.clouds], cell.T_base_flange
first = stitch.Session.from_arrays(clouds[::2], poses[::2], mount="eye_in_hand", name="part")
run = stitch.run(first)
place = len(run.stitched) // 2
at, normal = run.stitched.points[place], run.stitched.normals[place]
patch = stitch.Feature("patch", "point", at=at, axis=normal, radius=4.0, calibrated=0.0, calibrated_U=0.05)
print(stitch.measure(run, [patch]).rows()[0])
artefact = stitch.Session.from_arrays(clouds[1::2], poses[1::2], mount="eye_in_hand", name="artefact")
print(*stitch.verify(run, artefact, [patch]).sentences, sep="\n")
