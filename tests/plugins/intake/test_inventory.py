"""Every list of numbers in a folder is found, and the one that serves the clouds is taken for the poses."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.plugins.intake.folder_files import find_folder_files

R = Rotation.random(5, np.random.default_rng(1))
P = np.random.default_rng(2).uniform(300, 800, (5, 3))
TABLE = np.hstack([P, R.as_quat()])


@pytest.fixture
def scans(tmp_path):
    """A folder with five clouds."""
    for i in range(5):
        (tmp_path / f"scan_{i}.ply").write_bytes(b"ply\n")
    return tmp_path


def matrices():
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), P
    return T.tolist()


def test_a_camera_description_beside_a_list_of_frames_is_no_pose(scans):
    lens = {"fl_x": 500.0, "fl_y": 500.0, "cx": 320.0, "cy": 240.0, "k1": 0.0, "k2": 0.0}
    frames = [{"file_path": f"images/scan_{i}.png", "transform_matrix": T} for i, T in enumerate(matrices())]
    (scans / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    found = find_folder_files(scans)
    assert np.allclose(found.raw.numbers.reshape(5, 4, 4), matrices())
    assert found.raw.part == "frames" and found.raw.labels[3] == ("images/scan_3.png",)


@pytest.mark.parametrize("beside", ["temperature,21.5\nexposure,8500\n\nlens,\nfx,386.1\n", "only words\n"])
def test_descriptions_named_like_the_clouds_are_left_aside(scans, beside):
    for i in range(5):
        (scans / f"scan_{i}_metadata.csv").write_text(beside)
    np.savetxt(scans / "table.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = find_folder_files(scans)
    assert [file.name for file in found.poses] == ["table.csv"]
    (aside,) = [entry for entry in found.inventory if not entry.taken_for]
    assert len(aside.files) == 5 and aside.why_not


def test_one_list_of_a_file_is_named_behind_its_name(scans):
    rows = [{"marker": T, "robot": T} for T in matrices()]
    (scans / "both.json").write_text(json.dumps(rows))
    assert find_folder_files(scans).raw.part == "robot"
    assert find_folder_files(scans, scans / "both.json#marker").raw.part == "marker"
    with pytest.raises(InputError, match="both.json#marker, both.json#robot"):
        find_folder_files(scans, scans / "both.json#table")


def test_a_refusal_shows_what_stands_in_the_folder(scans):
    (scans / "lens.json").write_text(json.dumps({"fx": 1.0, "fy": 1.0, "cx": 0.5, "cy": 0.5, "k1": 0.1}))
    (scans / "notes.txt").write_text("the robot was warm\n")
    (scans / "temperatures.csv").write_text("a,b\n" + "1,2\n" * 5)
    with pytest.raises(InputError, match="no list of poses there") as refused:
        find_folder_files(scans)
    text = str(refused.value)
    assert "lens.json: 1 row of 5 numbers (fx, fy, cx, cy, k1)" in text and "temperatures.csv: 5 rows of 2" in text
    assert "--poses FILE#LIST" in text and "--columns" in text


def test_texts_of_other_things_do_not_stop_it(scans):
    (scans / "drawing.svg").write_text(f'<svg><path d="{"0.5,0.25 " * 30000}"/></svg>')
    (scans / "quoted.txt").write_text(f'"{"a,b " * 60000}"\nx,y\n1,2\n')
    (scans / "broken.xml").write_text("<a><b>")
    (scans / "broken.yaml").write_text("a: [1,2\n b: }")
    (scans / "blank.txt").write_text("\n")
    np.savetxt(scans / "a.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = find_folder_files(scans)
    assert [file.name for file in found.poses] == ["a.csv"] and len(found.inventory) == 6


def test_a_text_of_another_ending_is_opened(scans):
    lines = [f'<Rob><RIst X="{x}" Y="{y}" Z="{z}" A="10" B="20" C="{30 + x}"/></Rob>' for x, y, z in P.tolist()]
    (scans / "log.rsi").write_text("\n".join(lines))
    found = find_folder_files(scans)
    assert found.raw.part == "RIst" and np.allclose(found.raw.numbers[:, :3], P)


def test_its_own_files_are_passed_over_and_another_points_csv_is_not(scans):
    np.savetxt(scans / "points.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    (scans / "session.toml").write_text('format = "stitch-session/1"\n')
    (scans / "views.csv").write_text("view,cloud,x,y,z,qx,qy,qz,qw\na,scan_0.ply,0,0,0,0,0,0,1\n")
    assert [file.name for file in find_folder_files(scans).poses] == ["points.csv"]


def test_rows_that_are_all_alike_and_columns_of_other_names_are_no_poses(scans):
    (scans / "links.json").write_text(json.dumps([dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 0.0)] * 5))
    lens = [dict.fromkeys(("fx", "fy", "cx", "cy", "k1"), 1.0) | {"k2": i / 10} for i in range(5)]
    (scans / "robot.json").write_text(json.dumps(lens))
    np.savetxt(scans / "a.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = find_folder_files(scans)
    assert [file.name for file in found.poses] == ["a.csv"]
    reasons = {entry.files[0].name: entry.why_not for entry in found.inventory}
    assert reasons["links.json"] == "all its rows are alike"
