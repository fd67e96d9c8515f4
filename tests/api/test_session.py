"""Sessions from memory: the same as from a folder, refused with the same sentences, and back into a folder."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stitch
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.write import robot_table
from stitch.errors import InputError
from stitch.screening.deep_check import refuse_whole
from stitch.session.session import View
from tests.api.same import taken


def same_view(a, b, digits=0.0):
    """True if two views hold the same numbers, within so many units in the last place of places about 1000."""
    for own in fields(View):
        x, y = getattr(a, own.name), getattr(b, own.name)
        if isinstance(x, np.ndarray) and not np.allclose(x, y, rtol=0, atol=digits):
            return False
    clouds = [cloud for cloud in (a.cloud, b.cloud) if cloud is not None]
    same = a.name == b.name and a.time_s == b.time_s and a.covariates == b.covariates and len(clouds) in (0, 2)
    if len(clouds) == 2:
        one, two = clouds
        same = same and np.array_equal(one.points, two.points) and one.scalars.keys() == two.scalars.keys()
        same = same and all(np.array_equal(one.scalars[name], two.scalars[name]) for name in one.scalars)
    return same


def test_what_was_read_comes_back_from_its_arrays_to_the_last_digit(loaded):
    found = stitch.Session.from_arrays(**taken(loaded))
    assert all(same_view(a, b) for a, b in zip(found.views, loaded.views, strict=True))
    assert found.in_memory and not loaded.in_memory
    kept = ("name", "length_unit", "mount", "scanner", "robot")
    assert all(getattr(found, name) is getattr(loaded, name) for name in kept)


def test_robot_and_scanner_may_be_the_tables_of_a_session(cell, loaded):
    given = taken(loaded) | {"robot": robot_table(cell.scene.arm), "scanner": {"noise": 0.02, "optical_axis": "+z"}}
    found = stitch.Session.from_arrays(**given)
    assert np.array_equal(found.robot.before, loaded.robot.before) and found.scanner.noise == 0.02
    joints_alone = stitch.Session.from_arrays(**given | {"poses": None})
    assert np.allclose(
        [v.T_base_flange for v in joints_alone.views], [v.T_base_flange for v in loaded.views], atol=1e-3
    )


def test_a_large_scan_is_thinned_and_fused_whole(arrays):
    clouds, poses = arrays
    # No point twice: copies are dropped.
    many = [np.repeat(cloud, 160, axis=0) + 1e-9 * np.arange(160 * len(cloud))[:, None] for cloud in clouds]
    found = stitch.Session.from_arrays(many, poses, mount="eye_in_hand", check=False)
    whole = found.views[0].cloud
    assert len(whole.points) < 40_000 < whole.count == len(many[0])
    assert np.array_equal(whole.whole.read().points, many[0])
    many[0][:] = 1.0
    with pytest.raises(InputError, match="changed"):
        whole.whole.read()


def test_scans_in_metres_beside_poses_in_millimetres(arrays, loaded):
    clouds, poses = arrays
    found = stitch.Session.from_arrays([c / 1e3 for c in clouds], poses, mount="eye_in_hand", cloud_unit="m")
    assert np.allclose(found.views[0].cloud.points, loaded.views[0].cloud.points)
    with pytest.raises(InputError, match='set cloud_unit = "m"'):
        stitch.Session.from_arrays([c / 1e3 for c in clouds], poses, mount="eye_in_hand")


def mistaken(poses, mistake):
    """Poses of another convention, and the mount that is stated."""
    T = poses.copy()
    if mistake == "euler":
        T[:, :3, :3] = Rotation.from_euler("xyz", Rotation.from_matrix(T[:, :3, :3]).as_euler("zyx")).as_matrix()
    elif mistake == "inverse":
        T = np.linalg.inv(T)
    elif mistake == "reversed":
        T = T[::-1]
    elif mistake == "quaternion":
        T[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    return T


@pytest.mark.parametrize(
    "mistake", ["euler", *(pytest.param(m, marks=pytest.mark.slow) for m in ("inverse", "reversed", "quaternion"))]
)
def test_a_wrong_convention_is_refused_with_the_sentence_of_a_deep_check(arrays, loaded, mistake):
    clouds, poses = arrays
    T = mistaken(poses, mistake)
    views = tuple(replace(v, T_base_flange=T[i], joints=None) for i, v in enumerate(loaded.views))
    with pytest.raises(InputError) as deep:
        refuse_whole(replace(loaded, views=views, robot=None))
    with pytest.raises(InputError) as refused:
        stitch.Session.from_arrays(clouds, T, mount="eye_in_hand", name="blade")
    said = str(deep.value).removeprefix(str(loaded.path)).replace(" in session.toml", "")
    assert str(refused.value) == f"<blade>{said}" and f": {mistake}" in said


def test_the_other_mount_is_refused(arrays):
    clouds, poses = arrays
    with pytest.raises(InputError, match='set mount = "eye_in_hand"'):
        stitch.Session.from_arrays(clouds, poses, mount="eye_to_hand")


def test_scans_that_lie_in_one_frame_already_are_refused(cell, arrays):
    clouds, poses = arrays
    T = poses @ cell.T_mount
    moved = [cloud @ t[:3, :3].T + t[:3, 3] for cloud, t in zip(clouds, T, strict=True)]
    with pytest.raises(InputError, match="they lie in one frame already"):
        stitch.Session.from_arrays(moved, poses, mount="eye_in_hand")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"mount": "eye in hand"}, "<session>: mount is 'eye in hand'; use 'eye_to_hand' or 'eye_in_hand'"),
        ({"unit": "cm"}, "<session>: unit is 'cm'; use 'mm' or 'm'"),
        ({"name": "a/b"}, "name: name 'a/b' cannot name a folder"),
        ({"poses": np.tile(np.eye(4), (3, 1, 1))}, "poses: 3 for 5 views"),
        ({"poses": None}, "poses: none; to fix: pass them, or joints with the robot"),
        ({"clouds": None}, "clouds: none, and no labelled points"),
        ({"times": [0, 1, 2, 4, 3]}, "times: not finite, or a later view stands before an earlier one"),
        ({"times": [0, 1]}, "times: shape (2,) for 5 views"),
        ({"covariates": {"humidity": "wet"}}, "covariates humidity: shape (0,) for 5 views"),
        ({"joints": np.zeros((5, 2))}, "joints: 2 a view, the robot has 6"),
        ({"scanner": {"noise": -1}}, "<session>: scanner.noise is -1; use a positive number"),
        ({"points": [None]}, "points: 1 for 5 views"),
        ({"joints": np.full((5, 6), 0.3)}, "view v000: joints and reported pose differ by"),
        ({"joints": np.full((5, 6), 95.0), "robot": None}, "joints: one is 95 rad, many turns"),
        ({"covariates": {"humidity": np.full(5, "2026-01-01", "M8[s]")}}, "covariates humidity: dates or durations"),
        ({"scanner": {"nose": 0.1}}, "<session>: unknown key 'scanner.nose'; did you mean 'noise'?"),
        ({"scanner": {"within": [[-1, -1, -1], [1, 1, 1]]}}, "<session>: unknown key 'scanner.within'"),
        ({"robot": {"joint": []}}, "<session>: unknown key 'robot.joint'; did you mean 'joints'?"),
        ({"times": np.array([0, 1, "NaT", 3, 4], "m8[s]")}, "times: not finite"),
        *(
            ({"covariates": {name: np.ones(5)}}, f"covariates: {name!r} can be no covariate's name")
            for name in ("x", "view", "time_s", "cloud", "qx", "j1_deg", "j1_approach", "", " humidity")
        ),
        ({"covariates": {"hu\nmidity": np.ones(5)}}, "covariates: covariate 'hu\\nmidity' holds the character"),
        ({"points": [{"a\nb": np.ones(3)}] * 5}, "view v000: target 'a\\nb' holds the character"),
        ({"points": [np.ones(3)] * 5}, "view v000: labelled points are of type ndarray"),
        ({"name": 5}, "name: is of type int; to fix: pass str"),
        ({"unit": np.ones(3)}, "unit: is of type ndarray; to fix: pass str"),
        ({"scanner": 0.5}, "scanner: is of type float; to fix: pass Scanner or Mapping or None"),
        ({"covariates": np.ones(5)}, "covariates: is of type ndarray; to fix: pass Mapping or None"),
        ({"axes": [5]}, "axes, 0: is of type int; to fix: pass Mapping"),
        ({"check": np.ones(2)}, "check: is of type ndarray; to fix: pass bool"),
        ({"times": np.ones(5, complex)}, "times: complex numbers"),
        ({"poses": np.ones((5, 4, 4), complex)}, "poses: poses are not all matrices"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(arrays, loaded, change, says):
    given = {"clouds": arrays[0], "poses": arrays[1], "mount": "eye_in_hand"}
    given |= {"robot": loaded.robot} if "joints" in change else {}
    with pytest.raises(InputError) as refused:
        stitch.Session.from_arrays(**given | change)
    assert str(refused.value).startswith(says) and "\n" not in str(refused.value)


def test_a_scan_that_is_none_is_refused_with_its_index(arrays):
    clouds = [*arrays[0][:3], None, arrays[0][4]]
    with pytest.raises(InputError, match="clouds: that of view v003, index 3, is None"):
        stitch.Session.from_arrays(clouds, arrays[1], mount="eye_in_hand")


def test_dates_and_durations_become_seconds(arrays):
    for times in (np.datetime64("2026-05-01T10:00:00") + np.arange(5) * np.timedelta64(1500, "ms"), np.arange(5)):
        as_durations = times.astype("m8[ms]") if times.dtype.kind == "i" else times
        session = stitch.Session.from_arrays(*arrays, mount="eye_in_hand", times=as_durations, check=False)
        step = 1.5 if times.dtype.kind == "M" else 1e-3
        assert [view.time_s for view in session.views] == pytest.approx([step * v for v in range(5)])


def test_what_is_masked_is_not_measured(arrays):
    clouds, poses = arrays
    mask = np.zeros(clouds[0].shape, bool)
    mask[:7, 2] = True
    masked = [np.ma.array(clouds[0], mask=mask), *clouds[1:]]
    heat = np.ma.array([1.0, 2, 3, 4, 5], mask=[0, 0, 1, 0, 0])
    session = stitch.Session.from_arrays(masked, poses, mount="eye_in_hand", covariates={"heat": heat}, check=False)
    assert np.array_equal(session.views[0].cloud.points, clouds[0][7:])
    assert [view.covariates for view in session.views][1:3] == [{"heat": 2.0}, {}]
    mapped = [{"points": cloud} for cloud in masked]
    assert len(stitch.Session.from_arrays(mapped, poses, mount="eye_in_hand", check=False).views[0].cloud.points) == (
        len(clouds[0]) - 7
    )
    with pytest.raises(InputError, match="pose 2 is not finite"):
        bad = np.ma.array(poses, mask=np.zeros(poses.shape, bool))
        bad[2, 0, 3] = np.ma.masked
        stitch.Session.from_arrays(clouds, bad, mount="eye_in_hand")


def test_a_folder_that_would_read_back_otherwise_takes_no_name(loaded, tmp_path):
    odd = replace(loaded, views=(replace(loaded.views[0], covariates={"x": 5.0}), *loaded.views[1:]))
    with pytest.raises(InputError):
        odd.save(tmp_path / "odd")
    aside = replace(loaded.views[1], covariates={"q9_deg ": 5.0})
    with pytest.raises(InputError, match="the covariates of view v001 cannot be written"):
        replace(loaded, views=(loaded.views[0], aside, *loaded.views[2:])).save(tmp_path / "odd")
    assert not [*tmp_path.iterdir()]


def test_a_saved_session_is_read_as_it_was(loaded, tmp_path):
    given = taken(loaded)
    given["clouds"]["v000"] = replace(loaded.views[0].cloud, normals=np.ones_like(loaded.views[0].cloud.points))
    found = stitch.Session.from_arrays(**given | {"covariates": {"humidity": [1 / 3, 2, 3, np.nan, 5]}})
    there = found.save(tmp_path / "there")
    again = stitch.load_session(tmp_path / "there")
    # A rotation that was a quaternion between is the same but for rounding.
    assert all(same_view(a, b, 1e-11) for a, b in zip(again.views, found.views, strict=True))
    assert np.array_equal(again.views[0].cloud.normals, found.views[0].cloud.normals)
    assert again.views[0].covariates == {"humidity": 1 / 3} and not again.views[3].covariates
    assert there.path == tmp_path / "there" and not there.in_memory
    assert np.allclose(again.robot.before, loaded.robot.before) and np.allclose(again.robot.mass, loaded.robot.mass)
    assert np.allclose(again.scanner.T_mount, loaded.scanner.T_mount, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="exists already"):
        found.save(tmp_path / "there")


def test_an_arm_that_came_as_urdf_is_saved_as_one(loaded, tmp_path):
    bare = replace(loaded, robot=replace(loaded.robot, a=None, alpha=None, d=None, convention="urdf", payload_mass=0.0))
    bare.save(tmp_path / "urdf")
    again = stitch.load_session(tmp_path / "urdf")
    assert again.robot.convention == "urdf"
    assert np.allclose(
        [v.T_base_flange for v in again.views], [v.T_base_flange for v in loaded.views], rtol=0, atol=1e-11
    )


def test_labelled_points_alone_make_a_session(tmp_path):
    session, _, _ = labelled_cell(0)
    points = [dict(zip(v.sighting.targets, v.sighting.points, strict=True)) for v in session.views]
    T = np.array([v.T_base_flange for v in session.views])
    found = stitch.Session.from_arrays(None, T, mount=session.mount, points=points, name="balls")
    assert found.names[0] == "v000" and not found.has_clouds
    found.save(tmp_path / "balls")
    again = stitch.load_session(tmp_path / "balls")
    assert all(
        np.array_equal(a.sighting.points, b.sighting.points) and a.sighting.targets == b.sighting.targets
        for a, b in zip(again.views, found.views, strict=True)
    )
    run = stitch.run(found)
    assert run.hand_eye.U.mm > 0 and "[[balls]]" in str(run) and run.residuals.num_rows > 0
    assert "<iframe" in run._repr_html_() and len(run.stitched) == len(points[0])
