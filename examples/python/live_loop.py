"""A live loop: each view is judged as it comes, and a knock of the scanner is named at its first view."""

from scipy.spatial.transform import Rotation

import stitch
from data_synth.made_session import make

cell = make("blade-table", {}, seed=3, views=10)  # a simulated cell, in place of yours
turn = Rotation.from_rotvec([0.0, 0.003, 0.0])
live = stitch.live(mount="eye_in_hand", unit="mm")
for number, (cloud, pose) in enumerate(zip(cell.clouds, cell.T_base_flange, strict=True)):
    points = turn.apply(cloud.points) if number >= 8 else cloud.points  # knocked before v008
    print(live.add_view(points, pose))
print(live.finish())
