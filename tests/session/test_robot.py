"""Kinematics, exact and with links a little wrong, against textbook products, finite differences and potential energy.

URDF: what is read, and what cannot serve.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from rerun.chunk import RrdReader

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.output.urdf_file import to_urdf
from stitch.session.reading.robot_description import robot_from_dh, robot_from_urdf
from stitch.session.robot import (
    Links,
    exact_links,
    flange_slopes,
    forward,
    forward_with_errors,
    gravity_torques,
    jacobian,
    joint_axes,
    link_frames,
)
from viz.robot_scene import log_meshes
from viz.rrd_file import RecordingFile

ROWS = [
    {"a": 350, "alpha_deg": -90, "d": 815, "theta_deg": 0, "mass": 120, "com": [-175, 20, 10]},
    {"a": 850, "alpha_deg": 0, "d": 0, "theta_deg": -90, "mass": 80, "com": [-400, 0, 60]},
    {"a": 145, "alpha_deg": -90, "d": 12, "theta_deg": 0, "mass": 60, "com": [-60, 10, 0]},
    {"a": 0, "alpha_deg": 90, "d": 820, "theta_deg": 15, "mass": 30, "com": [0, -200, 0]},
    {"a": 7, "alpha_deg": -90, "d": 0, "theta_deg": 0, "mass": 12, "com": [0, 0, 20]},
    {"a": 0, "alpha_deg": 0, "d": 170, "theta_deg": 180, "mass": 3, "com": [0, 0, -30]},
]
PAYLOAD = {"mass": 20, "com": [10, -5, 80]}
GRAVITY = np.array([0.5, -0.2, -9.81])


def robot(convention="standard"):
    return robot_from_dh("test", convention, ROWS, PAYLOAD, GRAVITY, "mm")


def elementary(kind, value):
    c, s = np.cos(value), np.sin(value)
    return {
        "Rx": [[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]],
        "Rz": [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Tx": [[1, 0, 0, value], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Tz": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, value], [0, 0, 0, 1]],
    }[kind]


@pytest.mark.parametrize(("convention", "order"), [("standard", "Rz Tz Tx Rx"), ("modified", "Rx Tx Rz Tz")])
def test_forward_is_the_product_of_elementary_matrices(convention, order):
    q = np.random.default_rng(0).uniform(-3, 3, 6)
    T = np.eye(4)
    for row, angle in zip(ROWS, q, strict=True):
        values = {
            "Rz": angle + np.radians(row["theta_deg"]),
            "Tz": row["d"],
            "Tx": row["a"],
            "Rx": np.radians(row["alpha_deg"]),
        }
        for kind in order.split():
            T = T @ np.array(elementary(kind, values[kind]))
    assert np.allclose(forward(robot(convention), q), T, atol=1e-9)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_the_jacobian_agrees_with_finite_differences(convention):
    arm, q, step = robot(convention), np.random.default_rng(1).uniform(-3, 3, 6), 1e-6
    J = jacobian(arm, q)
    for i in range(6):
        dq = np.eye(6)[i] * step
        twist = frames.log(frames.inverse(forward(arm, q - dq)) @ forward(arm, q + dq)) / (2 * step)
        assert np.allclose(J[:, i], twist, atol=1e-5)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_gravity_torque_is_minus_the_slope_of_potential_energy(convention):
    arm = robot(convention)

    def energy(q):
        T = link_frames(arm, q)[1:]
        centres = [t[:3, :3] @ r["com"] + t[:3, 3] for t, r in zip(T, ROWS, strict=True)]
        work = sum(r["mass"] * c @ GRAVITY for r, c in zip(ROWS, centres, strict=True))
        tool = T[-1][:3, :3] @ PAYLOAD["com"] + T[-1][:3, 3]
        return -(work + PAYLOAD["mass"] * tool @ GRAVITY) * 1e-3

    for q in np.random.default_rng(2).uniform(-3, 3, (5, 6)):
        slope = [(energy(q + d) - energy(q - d)) / 2e-5 for d in np.eye(6) * 1e-5]
        assert np.allclose(gravity_torques(arm, q), -np.array(slope), atol=1e-5)


def test_axes_turn_the_flange():
    arm, q = robot(), np.random.default_rng(3).uniform(-3, 3, 6)
    points, axes = joint_axes(arm, q)
    for i in range(6):
        moved = forward(arm, q + np.eye(6)[i] * 0.3) @ frames.inverse(forward(arm, q))
        on_axis = frames.transform(moved, points[i][None])[0]
        assert np.allclose(on_axis, points[i], atol=1e-9)
        assert np.allclose(moved[:3, :3] @ axes[i], axes[i], atol=1e-12)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_urdf_of_a_dh_robot_gives_the_same_flange(convention, tmp_path):
    arm = robot(convention)
    (tmp_path / "arm.urdf").write_text(to_urdf(arm))
    again = robot_from_urdf(tmp_path / "arm.urdf", "base_link", "flange", "mm", GRAVITY)
    q = np.random.default_rng(4).uniform(-3, 3, (50, 6))
    # 1e-9 m, written as mm.
    assert np.abs(forward(arm, q) - forward(again, q)).max() < 1e-6


DOWNWARDS = np.array([0, 0, -9.81])


def arm_of(convention, rows):
    return robot_from_dh("x", convention, rows, None, DOWNWARDS, "mm")


def rows_from(rng):
    return [
        {
            "a": rng.uniform(0, 400),
            "alpha_deg": rng.uniform(-90, 90),
            "d": rng.uniform(0, 300),
            "theta_deg": rng.uniform(-90, 90),
        }
        for _ in range(6)
    ]


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_wrong_rows_are_another_arm(convention):
    """Errors of DH rows give the same pose as an arm built with those rows."""
    rng = np.random.default_rng(0)
    rows = rows_from(rng)
    da, dd, dalpha = rng.normal(0, 0.3, 6), rng.normal(0, 0.3, 6), rng.normal(0, 1e-3, 6)
    other = [
        r | {"a": 1.001 * (r["a"] + a), "d": 1.001 * (r["d"] + d), "alpha_deg": r["alpha_deg"] + np.degrees(alpha)}
        for r, a, d, alpha in zip(rows, da, dd, dalpha, strict=True)
    ]
    q = rng.uniform(-2, 2, (7, 6))
    found = forward_with_errors(
        arm_of(convention, rows), q, Links(np.full(7, 1.001), np.ones((7, len(da))), da, dd, dalpha)
    )
    assert np.allclose(found, forward(arm_of(convention, other), q), atol=1e-9)


@pytest.mark.parametrize("convention", ["standard", "modified", "urdf"])
def test_slopes_of_the_flange_are_finite_differences(convention):
    """About an arm whose every row and length is off, in each of its errors."""
    rng, step = np.random.default_rng(1), 1e-5
    arm = replace(arm_of("modified" if convention == "modified" else "standard", rows_from(rng)), convention=convention)
    q = rng.uniform(-2, 2, (5, 6))
    at = Links(
        1 + rng.normal(0, 1e-2, 5), 1 + rng.normal(0, 1e-2, (5, 6)), *rng.normal(0, [[3.0], [3.0], [1e-2]], (3, 6))
    )
    slopes = flange_slopes(arm, q, at)

    def difference(up, down):
        return frames.log(frames.inverse(down) @ up) / (2 * step)

    for i, one in enumerate(np.eye(6)):
        turned = [forward_with_errors(arm, q + s * step * one, at) for s in (1, -1)]
        assert np.allclose(slopes.joints[..., i], difference(*turned), atol=2e-6)
        for name in ("da", "dd", "dalpha"):
            both = [
                forward_with_errors(arm, q, replace(at, **{name: getattr(at, name) + s * step * one})) for s in (1, -1)
            ]
            assert np.allclose(getattr(slopes, name)[..., i], difference(*both), atol=2e-6)
        longer = [forward_with_errors(arm, q, replace(at, lengths=at.lengths + s * step * one)) for s in (1, -1)]
        assert np.allclose(slopes.lengths[..., i], difference(*longer), atol=2e-6)
    both = [forward_with_errors(arm, q, replace(at, scale=at.scale + s * step)) for s in (1, -1)]
    assert np.allclose(slopes.scale, difference(*both), atol=2e-6)


def test_slopes_of_a_right_arm_are_its_jacobian():
    rng = np.random.default_rng(2)
    arm, q = arm_of("standard", rows_from(rng)), rng.uniform(-2, 2, (4, 6))
    assert np.allclose(flange_slopes(arm, q, exact_links(4, 6)).joints, jacobian(arm, q), atol=1e-9)


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
