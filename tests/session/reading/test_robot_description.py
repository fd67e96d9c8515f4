"""URDF: what is read, and what cannot serve."""

import numpy as np
import pytest
import trimesh
from rerun.chunk import RrdReader

from stitch.errors import InputError
from stitch.session.reading.robot_description import robot_from_urdf
from stitch.session.robot import forward, link_frames
from viz.robot_scene import log_meshes
from viz.rrd_file import RecordingFile

GRAVITY = np.array([0.5, -0.2, -9.81])


def test_urdf_axis_origin_and_fixed_joints(tmp_path):
    """By hand: 1 m up, turn about y by 90°, 0.5 m along the turned x, which now points down."""
    (tmp_path / "a.urdf").write_text(
        '<robot name="a"><link name="b"/><link name="l"/><link name="f"/>'
        '<joint name="j" type="revolute"><origin xyz="0 0 1"/><parent link="b"/><child link="l"/><axis xyz="0 1 0"/></joint>'
        '<joint name="k" type="fixed"><origin xyz="0.5 0 0"/><parent link="l"/><child link="f"/></joint></robot>'
    )
    arm = robot_from_urdf(tmp_path / "a.urdf", "b", "f", "mm", GRAVITY)
    assert np.allclose(forward(arm, np.array([np.pi / 2]))[:3, 3], [0, 0, 500])


@pytest.mark.parametrize(("joint", "message"), [("prismatic", "revolute"), ("revolute", "no chain")])
def test_a_urdf_that_cannot_serve_is_refused_with_the_reason(tmp_path, joint, message):
    (tmp_path / "a.urdf").write_text(
        f'<robot name="a"><link name="b"/><link name="l"/><joint name="j" type="{joint}"><parent link="b"/><child link="l"/></joint></robot>'
    )
    flange = "l" if joint == "prismatic" else "nowhere"
    with pytest.raises(InputError, match=message):
        robot_from_urdf(tmp_path / "a.urdf", "b", flange, "mm", GRAVITY)


def test_meshes_of_links_stand_where_the_urdf_puts_them(tmp_path):
    """The arm above: what hangs on its link by 0.1 m along x, and on the flange, both point down; names of packages."""
    (tmp_path / "kit" / "urdf").mkdir(parents=True)
    (tmp_path / "kit" / "meshes").mkdir()
    for name in ("base", "arm", "tip"):
        trimesh.creation.box((0.02, 0.02, 0.02)).export(tmp_path / "kit" / "meshes" / f"{name}.stl")

    def link(name, mesh, more=""):
        return f'<link name="{name}"><visual>{more}<geometry><mesh {mesh}/></geometry></visual></link>'

    (tmp_path / "kit" / "urdf" / "a.urdf").write_text(
        '<robot name="a">'
        + link("b", 'filename="../meshes/base.stl"')
        + link("l", 'filename="package://kit/meshes/arm.stl" scale="2 1 1"', '<origin xyz="0.1 0 0"/>')
        + link("f", 'filename="package://elsewhere/meshes/tip.stl"')
        + link("gone", 'filename="nowhere.stl"')
        + link("odd", 'filename="../meshes/tip.stl"', '<origin xyz="here"/>')
        + '<joint name="j" type="revolute"><origin xyz="0 0 1"/><parent link="b"/><child link="l"/><axis xyz="0 1 0"/></joint>'
        + "".join(
            f'<joint name="{child}" type="fixed"><origin xyz="{x} 0 0"/><parent link="{parent}"/><child link="{child}"/></joint>'
            for parent, child, x in (("l", "f", 0.5), ("f", "gone", 0.0), ("f", "odd", 0.0))
        )
        + "</robot>"
    )
    arm = robot_from_urdf(tmp_path / "kit" / "urdf" / "a.urdf", "b", "f", "mm", GRAVITY)
    frames_of_links = link_frames(arm, np.array([np.pi / 2]))
    places = {own.file.stem: (frames_of_links[own.link] @ own.T_link_mesh)[:3, 3] for own in arm.meshes}
    assert places == {
        "base": pytest.approx([0, 0, 0]),
        "arm": pytest.approx([0, 0, 900]),
        "tip": pytest.approx([0, 0, 500]),
    }
    assert {own.file.stem: tuple(own.scale) for own in arm.meshes}["arm"] == (2000.0, 1000.0, 1000.0)
    # As the recording has them: a box of 20 mm about its place, along z twice as long once the joint has turned.
    file = RecordingFile("t", tmp_path / "r.rrd")
    log_meshes(file.stream, arm, np.array([np.pi / 2]))
    file.write()
    chunks = [
        chunk.to_record_batch() for chunk in RrdReader(str(tmp_path / "r.rrd")).stream() if "links" in chunk.entity_path
    ]
    boxes = [np.array(batch.column("Mesh3D:vertex_positions")[0].as_py()) for batch in chunks]
    long = next(box for box in boxes if np.ptp(box, axis=0).max() > 30)
    np.testing.assert_allclose([long.min(axis=0), long.max(axis=0)], [[-10, -10, 880], [10, 10, 920]], atol=1e-3)
