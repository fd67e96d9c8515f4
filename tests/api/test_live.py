"""Views that come one by one: what is said of each, and that the end is that of a batch."""

import shutil
import threading
import time
from contextlib import suppress
from copy import copy

import numpy as np
import pytest

import stitch
from stitch.cli.main import main
from tests.command_line import ended


@pytest.fixture(scope="module")
def live_blade(arrays):
    """The cell's views, taken one by one."""
    live = stitch.live(mount="eye_in_hand", name="s")
    clouds, poses = arrays
    for cloud, pose in zip(clouds, poses, strict=True):
        live.add_view(cloud, pose)
    return live


@pytest.fixture(scope="module")
def after_four(arrays):
    """The first four views, taken one by one: there is a hand-eye."""
    live = stitch.live(mount="eye_in_hand")
    for cloud, pose in zip(arrays[0][:4], arrays[1], strict=False):
        live.add_view(cloud, pose)
    return live


def branch(live):
    """A live session that goes on from another, which stays as it is: nothing that it holds is changed in place."""
    own = copy(live)
    own.said = list(live.said)
    return own


def test_the_end_is_that_of_a_batch_to_the_last_bit(live_blade, arrays):
    clouds, poses = arrays
    batch = stitch.run(stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", name="s"))
    end = live_blade.finish()
    assert (end.T_mount == batch.T_mount).all()
    assert (end.mount_covariance == batch.mount_covariance).all()
    assert (end.fused.points == batch.fused.points).all()


def test_the_hand_eye_so_far_is_that_of_the_batch_within_its_uncertainty(live_blade, found):
    apart = np.linalg.inv(found.T_mount) @ live_blade.hand_eye.pose
    assert np.linalg.norm(apart[:3, 3]) < 0.5 * live_blade.hand_eye.U.mm


def test_views_wait_until_there_are_enough(live_blade):
    assert [said.verdict for said in live_blade.said[:4]] == ["waiting"] * 3 + ["fits"]
    assert all(said.hand_eye is None for said in live_blade.said[:3])


def test_a_knocked_view_is_named_when_it_comes_and_the_next_ones_say_since_when(arrays, live_blade):
    clouds, poses = arrays
    live = branch(live_blade)
    before = live.hand_eye.pose
    off = live.add_view(clouds[2] + [0.4, 0.3, 0.2], poses[2])
    assert off.verdict == "does_not_belong" and "at least" in off.why
    assert (live.hand_eye.pose == before).all(), "a view that does not belong moves nothing"
    again = live.add_view(clouds[1] + [0.4, 0.3, 0.2], poses[1])
    assert again.verdict == "does_not_belong" and "from v005 on" in again.why


def test_another_part_does_not_belong(arrays, after_four):
    clouds, poses = arrays
    live = branch(after_four)
    said = live.add_view(clouds[4] + [400.0, 0.0, 0.0], poses[4])
    assert said.verdict == "does_not_belong" and "shares no surface" in said.why


def test_a_view_once_more_adds_nothing(arrays):
    """The arm comes back to one pose again and again, each time with its own scatter of 20 µm."""
    clouds, poses = arrays
    live = stitch.live(mount="eye_in_hand")
    rng = np.random.default_rng(0)
    for k in (0, 1, 2, 3, 4, *[4] * 5):
        noise = rng.normal(scale=0.002, size=clouds[k].shape) + rng.normal(scale=0.02, size=3)
        live.add_view(clouds[k] + noise, poses[k])
    said = [own.verdict for own in live.said]
    assert "adds_nothing" in said[5:] and said[4] == "fits" and "does_not_belong" not in said


def test_the_next_pose_lowers_U_as_it_says(live_blade):
    """Four views that turn about one axis alone: the next pose must turn about another."""
    assert stitch.live(mount="eye_in_hand").next_pose() is None
    proposed = live_blade.next_pose()
    assert proposed.U_mm < live_blade.hand_eye.U.mm
    R = proposed.T_base_flange[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3)) and proposed.like in live_blade.session.names


def test_a_copied_scan_is_said_to_be_one_and_the_next_view_is_not_accused(arrays, after_four):
    clouds, poses = arrays
    after_one = stitch.live(mount="eye_in_hand")
    after_one.add_view(clouds[0], poses[0])
    for at, live in ((1, after_one), (4, branch(after_four))):
        again = live.add_view(clouds[0], poses[0])
        assert (again.verdict, again.why) == ("adds_nothing", "Its scan is a copy of that of v000, at the same pose.")
        moved = live.add_view(clouds[0], poses[2])
        assert moved.verdict == "does_not_belong" and "v000, at another pose" in moved.why
        for cloud, pose in zip(clouds[at:], poses[at:], strict=True):
            said = live.add_view(cloud, pose)
        assert said.verdict == "fits", said.why


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt, *(pytest.param(e, marks=pytest.mark.slow) for e in (MemoryError, ValueError))]
)
def test_whatever_ends_a_call_the_view_is_out(arrays, after_four, error, monkeypatch):
    clouds, poses = arrays
    live = branch(after_four)
    before = live.hand_eye.pose

    def fails(*_):
        raise error

    with monkeypatch.context() as patched:
        patched.setattr("stitch.api.live.fit_live_hand_eye", fails)
        with pytest.raises(error):
            live.add_view(clouds[4], poses[4])
    assert len(live.session.views) == len(live.said) == 4 and (live.hand_eye.pose == before).all()
    assert live.add_view(clouds[4], poses[4]).verdict == "fits"


def test_a_recording_that_fails_leaves_the_view_out(arrays):
    class Broken:
        def view(self, *_):
            raise OSError("the viewer was closed")

    live = stitch.live(mount="eye_in_hand")
    live._recording = Broken()
    with pytest.raises(OSError):
        live.add_view(arrays[0][0], arrays[1][0])
    assert not live.said and not live.session.views


def test_views_of_several_threads_are_taken_one_after_the_other(arrays):
    live = stitch.live(mount="eye_in_hand")
    given = zip(*arrays, strict=True)
    threads = [threading.Thread(target=live.add_view, args=view) for view in given]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(said.name for said in live.said) == live.session.names == [f"v{i:03d}" for i in range(5)]


def test_three_points_or_none_are_no_scan_that_breaks_the_session(arrays, after_four):
    live, cloud, pose = branch(after_four), arrays[0][4], arrays[1][4]
    for nothing in (cloud[:3], None, cloud[:0]):
        with suppress(stitch.InputError):
            live.add_view(nothing, pose)
    assert live.add_view(cloud, pose).verdict == "fits"


def test_inverted_poses_are_refused_when_the_first_hand_eye_is_sought(arrays):
    clouds, poses = arrays
    live = stitch.live(mount="eye_in_hand")
    with pytest.raises(stitch.InputError, match="T_flange_base"):
        for cloud, pose in zip(clouds, np.linalg.inv(poses), strict=True):
            live.add_view(cloud, pose)
    assert len(live.session.views) == len(live.said) == 3, "the refused view is not there"


@pytest.mark.parametrize(
    "changes, message",
    [({"name": "v000"}, "there is one of that name"), ({"time_s": 1.0}, "its time lies before")],
)
def test_a_view_that_cannot_follow_is_refused_and_changes_nothing(arrays, changes, message):
    clouds, poses = arrays
    live = stitch.live(mount="eye_in_hand")
    live.add_view(clouds[0], poses[0], time_s=2.0)
    with pytest.raises(stitch.InputError, match=message):
        live.add_view(clouds[1], poses[1], **changes)
    assert len(live.session.views) == len(live.said) == 1


def test_a_folder_is_followed_as_it_fills(cell_folder, tmp_path, capfd, monkeypatch):
    """Rows come before their scans, and half a row before the rest, as a slow disk shows them."""
    monkeypatch.setattr("stitch.cli.run._EVERY", 0.1)
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "clouds").mkdir()
    shutil.copy(cell_folder / "session.toml", folder)
    head, *rows = (cell_folder / "views.csv").read_text().splitlines(keepends=True)

    def fill():
        table = head
        for i, row in enumerate(rows):
            time.sleep(0.15)
            (folder / "views.csv").write_text(table + row[: len(row) // 2])
            time.sleep(0.15)
            table += row
            (folder / "views.csv").write_text(table)
            cloud = sorted((cell_folder / "clouds").iterdir())[i]
            shutil.copy(cloud, folder / "clouds")

    writer = threading.Thread(target=fill)
    writer.start()
    with pytest.raises(SystemExit) as end:
        main(["run", str(folder), "--follow", "--views", str(len(rows)), "-o", str(tmp_path / "run"), "--no-recording"])
    writer.join()
    assert not end.value.code
    shown = capfd.readouterr().out
    assert shown.count("waiting. The hand-eye is fitted") >= 2 and "The first hand-eye." in shown
    assert (tmp_path / "run" / "result.json").is_file()


def test_the_number_of_views_is_stated_with_follow_alone(cell_folder):
    assert "add --follow" in ended("run", cell_folder, "--views", 3, code=2).err
