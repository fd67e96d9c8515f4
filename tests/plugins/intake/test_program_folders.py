"""Folders whose poses stand in a program: which file is read, which points count."""

import numpy as np
import pytest

from data_synth.fixtures.robot_programs import program
from stitch.plugins.intake.folder_files import find_folder_files
from stitch.plugins.intake.raw_poses import is_program, program_poses, read_raw_poses

POSES = [np.array([[0.0, -1, 0, 900 + 10 * i], [1, 0, 0, 20], [0, 0, 1, 700], [0, 0, 0, 1]]) for i in range(4)]
DATA = "DEFDAT WORK\n" + "".join(
    f"DECL E6POS XP{i + 1}={{X {900 + 10 * i},Y 20,Z 700,A 90,B 0,C 0,S 2,T 35,E1 0}}\n" for i in range(4)
)
MOTIONS = (
    "DEF WORK()\nPTP {A1 0,A2 -90,A3 90,A4 0,A5 0,A6 0}\n" + "".join(f"LIN XP{i}\n" for i in (1, 2, 3, 4)) + "END\n"
)


@pytest.fixture
def folder(tmp_path):
    for i in range(4):
        np.savetxt(tmp_path / f"scan_{i + 1}.xyz", np.full((500, 3), i + 1.0))
    (tmp_path / "work.dat").write_text(DATA)
    return tmp_path


def test_the_program_is_read_and_not_its_points_beside_it(folder):
    assert is_program(folder / "work.dat") and find_folder_files(folder).poses == (folder / "work.dat",)
    (folder / "work.src").write_text(MOTIONS)
    assert find_folder_files(folder).poses == (folder / "work.src",)
    for file in ("work.dat", "work.src"):
        raw = program_poses(folder / file)
        places = raw.numbers[:, [raw.header.index(axis) for axis in "xyz"]]
        assert np.allclose(places, [T[:3, 3] for T in POSES])
        assert [texts[0] for texts in raw.labels] == ["XP1", "XP2", "XP3", "XP4"]


def test_joint_targets_without_a_pose_are_left_out_and_said(tmp_path):
    for controller, suffix in (("kuka", ".src"), ("ur", ".script"), ("abb", ".mod")):
        file = tmp_path / f"work{suffix}"
        file.write_text(program(controller, [np.zeros(6)], POSES))
        raw = program_poses(file)
        assert len(raw.numbers) == 4 and "1 without a pose left out" in raw.words


def test_a_table_may_end_in_dat(tmp_path):
    (tmp_path / "poses.dat").write_text("1,2,3,4,5,6\n2,3,4,5,6,7\n")
    assert not is_program(tmp_path / "poses.dat") and len(read_raw_poses([tmp_path / "poses.dat"]).numbers) == 2


def test_what_the_camera_wrote_beside_the_poses_is_no_table_of_poses(tmp_path):
    """Neither file says in its name what it holds."""
    for i in range(3):
        np.savetxt(tmp_path / f"scan_{i + 1}.xyz", np.full((500, 3), i + 1.0))
    (tmp_path / "camera_info.yaml").write_text(
        "height: 480\nwidth: 640\nk: [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]\n"
        "r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
    )
    (tmp_path / "remarks.txt").write_text("3 scans, gripper new, 22.5 degrees in the hall\n")
    rows = "".join(f"{800 + i} 20 700 0.1 0.2 {0.3 * i}\n" for i in range(3))
    (tmp_path / "run7.txt").write_text(rows)
    assert find_folder_files(tmp_path).poses == (tmp_path / "run7.txt",)
