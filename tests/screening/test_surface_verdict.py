"""A plate with holes looks alike from several sides: motions between scans mislead, all surfaces at once do not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated, with_part
from data_synth.scene import load_scene
from stitch.numerics import frames
from stitch.screening.deep_check import deep_check


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ["euler", "quaternion"])
def test_a_convention_is_named_on_a_plate_with_holes(mistake):
    scene = with_part(
        load_scene("blade-table"), "curved_drill_plate", length=150.0, width=120.0, pitch=36.0, radius=150.0
    )
    scene = replace(scene, scanner=replace(scene.scanner, columns=100, rows=100))
    session = session_of(simulated(scene, {}, 31, 12))
    T = np.array([view.T_base_flange for view in session.views])
    R = Rotation.from_matrix(T[:, :3, :3])
    wrong = Rotation.from_euler("xyz", R.as_euler("ZYX")) if mistake == "euler" else R.inv()
    poses = frames.make(wrong.as_matrix(), T[:, :3, 3])
    views = zip(session.views, poses, strict=True)
    session = replace(session, views=tuple(replace(v, T_base_flange=pose, joints=None) for v, pose in views))
    assert [p.kind for p in deep_check(session)] == [mistake]
