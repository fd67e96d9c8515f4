"""What is only another way to write the same cell down leaves the same answer, to 1e-6."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.session.reading.session_folder import load_session

SAME = 1e-6  # mm, rad, and shares of an effect or an rms
B = frames.make(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), np.array([300.0, -200.0, 150.0]))
S = frames.make(Rotation.from_rotvec([0.0, 0.0, 0.9]).as_matrix(), np.zeros(3))
OFFSET = np.array([0, 1e-3, -1.5e-3, 0, 8e-4, 0])


def of_views(session, change):
    return replace(session, views=tuple(change(i, view) for i, view in enumerate(session.views)))


def on_another_base(session):
    robot = session.robot
    if robot is not None:
        before = np.array([B @ robot.before[0], *robot.before[1:]])
        # A frame before the first joint is none of a DH row: the arm counts as a URDF's.
        robot = replace(robot, before=before, gravity=B[:3, :3] @ robot.gravity, convention="urdf")
    return of_views(replace(session, robot=robot), lambda i, v: replace(v, T_base_flange=B @ v.T_base_flange))


def as_urdf(session):
    return replace(session, robot=replace(session.robot, convention="urdf"))


def scaled(T, factor):
    return frames.make(T[..., :3, :3], T[..., :3, 3] * factor)


def in_metres(session):
    def change(i, view):
        s = view.sighting
        cloud = view.cloud and replace(view.cloud, points=view.cloud.points / 1e3)
        seen = s and replace(s, points=s.points / 1e3, sigma=s.sigma / 1e3)
        return replace(view, T_base_flange=scaled(view.T_base_flange, 1e-3), cloud=cloud, sighting=seen)

    scanner, robot = session.scanner, session.robot
    if robot is not None:
        links = {name: scaled(getattr(robot, name), 1e-3) for name in ("before", "after")}
        lengths = {name: getattr(robot, name) / 1e3 for name in ("a", "d", "com", "payload_com")}
        robot = replace(robot, **links, **lengths, metres_per_unit=1.0)
    lengths = {name: x and x / 1e3 for name in ("noise", "standoff") for x in [getattr(scanner, name)]}
    scanner = replace(scanner, T_mount=None if scanner.T_mount is None else scaled(scanner.T_mount, 1e-3), **lengths)
    return of_views(replace(session, length_unit="m", scanner=scanner, robot=robot), change)


def in_a_turned_sensor(session):
    back = frames.inverse(S)

    def change(i, view):
        s, cloud = view.sighting, view.cloud
        if cloud is not None:
            normals = None if cloud.normals is None else cloud.normals @ back[:3, :3].T
            cloud = replace(cloud, points=frames.transform(back, cloud.points), normals=normals)
        return replace(view, cloud=cloud, sighting=s and replace(s, points=frames.transform(back, s.points)))

    T_mount = session.scanner.T_mount
    scanner = replace(session.scanner, T_mount=None if T_mount is None else T_mount @ S)
    return of_views(replace(session, scanner=scanner), change)


def renamed(session):
    return of_views(session, lambda i, view: replace(view, name=f"scan {len(session.views) - i:03d} b"))


def later(session):
    return of_views(session, lambda i, view: replace(view, time_s=1.7e9 + view.time_s))


def turned_once_more(session):
    return of_views(session, lambda i, view: replace(view, joints=view.joints + 2 * np.pi * np.eye(6)[5]))


def answer(session, effects=()):
    found = run(session, effects=effects)
    values = [p.value for term in found.terms for p in term.parameters]
    mm = 1e3 * (1.0 if session.length_unit == "m" else 1e-3)
    return scaled(found.T_mount, mm), np.array([found.residual_rms * mm, found.heldout_rms * mm, *values])


def require_same(told, first, left=None, right=None):
    T = (np.eye(4) if left is None else left) @ first[0] @ (np.eye(4) if right is None else right)
    assert np.abs(frames.log(frames.inverse(T) @ told[0])).max() < SAME * max(1.0, np.abs(T[:3, 3]).max() / 100)
    assert told[1] == pytest.approx(first[1], rel=SAME, abs=1e-9)


@pytest.fixture(scope="module")
def arm():
    session = labelled_cell(41, views=20, offset=OFFSET)[0]
    return of_views(session, lambda i, view: replace(view, time_s=10.0 * i))


@pytest.fixture(scope="module")
def first(arm):
    return answer(arm, ["joint_offset"])


CHANGES = {
    "metres": (in_metres, None),
    "sensor": (in_a_turned_sensor, S),
    "names": (renamed, None),
    "time": (later, None),
    "turn": (turned_once_more, None),
}


@pytest.mark.parametrize("change", CHANGES)
def test_points_say_the_same(arm, first, change):
    changed, right = CHANGES[change]
    require_same(answer(changed(arm), ["joint_offset"]), first, right=right)


def test_points_say_the_same_on_another_base(arm):
    told, before = (answer(session, ["joint_offset"]) for session in (on_another_base(arm), as_urdf(arm)))
    require_same(told, before, left=B)


def test_columns_may_stand_in_any_order(arm, tmp_path):
    folder = write_labelled(tmp_path / "s", arm)
    before = answer(load_session(folder), ["joint_offset"])
    for name in ("views.csv", "points.csv"):
        rows = list(csv.reader((folder / name).open(encoding="utf-8")))
        with (folder / name).open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream).writerows([row[::-1] for row in rows])
    require_same(answer(load_session(folder), ["joint_offset"]), before)


@pytest.fixture(scope="module")
def blade():
    session = session_of(measured_blade(11, 6, "eye_in_hand", (0.0, 0.0), pixels=60))
    session = of_views(session, lambda i, view: replace(view, time_s=10.0 * i))
    return session, answer(session)


@pytest.mark.slow
@pytest.mark.parametrize("change", [*CHANGES, "base"])
def test_surfaces_say_the_same(blade, change):
    session, before = blade
    if change == "base":
        require_same(answer(on_another_base(session)), before)
        return
    changed, right = CHANGES[change]
    require_same(answer(changed(session)), before, right=right)
