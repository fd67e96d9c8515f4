"""`stitch detect` at the command line: sessions of organised clouds and of depth images, and what it refuses."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from data_synth.fixtures.board_scans import (
    Camera,
    board_print,
    poses_before,
    scan_print,
    write_board_session,
    write_pcd,
)
from stitch.cli.main import main
from stitch.numerics import frames
from stitch.numerics.units import METRES
from stitch.session.reading.session_folder import load_session

cv2 = pytest.importorskip("cv2")
BOARD = "charuco:8x6:12:9:DICT_4X4_50"
T_FLANGE_SCANNER = frames.make(Rotation.from_rotvec([0.3, -0.2, 0.8]).as_matrix(), np.array([40.0, -20, 90]))
T_BASE_BOARD = frames.make(Rotation.from_rotvec([3.0, 0.1, 0.2]).as_matrix(), np.array([700.0, 100, 50]))


@pytest.fixture(scope="module")
def cell():
    """Scans of a board from three poses, and the poses of the flange."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    print_ = board_print(cv2.aruco.CharucoBoard((8, 6), 12.0, 9.0, dictionary), 8, 6, 12.0)
    inner = np.array([[c * 12.0, r * 12.0] for r in range(1, 6) for c in range(1, 8)])
    poses = poses_before(200, 3, np.array([48.0, 36.0]), tilt=0.5)
    scans = [scan_print(print_, T, inner, seed=i) for i, T in enumerate(poses)]
    return scans, T_BASE_BOARD @ frames.inverse(poses) @ frames.inverse(T_FLANGE_SCANNER)


def ended(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    printed = capsys.readouterr()
    return end.value.code or 0, printed.out, printed.err


def scatter_in_base(session):
    """Rms distance (mm) of each corner, placed by the true poses, from its mean over the views."""
    placed: dict[str, list[np.ndarray]] = {}
    for view in session.views:
        for name, point in zip(view.sighting.targets, view.sighting.points, strict=True):
            T = view.T_base_flange @ frames.make(
                T_FLANGE_SCANNER[:3, :3], T_FLANGE_SCANNER[:3, 3] * 1e-3 / METRES[session.length_unit]
            )
            placed.setdefault(name, []).append(frames.transform(T, point[None])[0])
    off = [np.array(p) - np.mean(p, axis=0) for p in placed.values() if len(p) > 1]
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2))) * METRES[session.length_unit] * 1e3


def test_organised_clouds_with_colour(cell, tmp_path, capsys):
    folder = write_board_session(tmp_path / "s", *cell)
    code, out, err = ended(capsys, "detect", folder, "--board", BOARD, "--json", "-o", folder / "points.csv")
    assert code == 0, err
    assert json.loads(out)["views"].keys() == {"v0", "v1", "v2"} and "stitch run" in err
    assert scatter_in_base(load_session(folder)) < 0.05
    table = (folder / "points.csv").read_text()
    code, _, err = ended(capsys, "detect", folder, "--board", BOARD, "-o", folder / "points.csv")
    assert code == 2 and "exists already" in err
    code, out, _ = ended(capsys, "detect", folder, "--board", BOARD)
    assert code == 0 and out == table


def test_depth_images_beside_pictures(cell, tmp_path, capsys):
    """Depth in whole tenths of a millimetre, the session in metres: the same corners."""
    scans, poses = cell
    folder = write_board_session(tmp_path / "s", scans, frames.make(poses[:, :3, :3], poses[:, :3, 3] / 1000))
    table = (folder / "views.csv").read_text().replace("clouds/v", "clouds/depth_").replace(".pcd", ".png")
    (folder / "views.csv").write_text(table)
    told = (folder / "session.toml").read_text().replace('length_unit = "mm"', 'length_unit = "m"')
    (folder / "session.toml").write_text(told)
    K = Camera().matrix
    intrinsics = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "depth_scale": 10000}
    (folder / "clouds/intrinsics.json").write_text(json.dumps(intrinsics))
    for i, scan in enumerate(scans):
        depth = np.round(np.nan_to_num(scan.points[..., 2]) * 10).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"clouds/depth_{i}.png"), depth)
        Image.fromarray(scan.grey).save(folder / f"clouds/color_{i}.png")
    code, _, err = ended(capsys, "detect", folder, "--board", BOARD, "-o", folder / "points.csv")
    assert code == 0, err
    assert scatter_in_base(load_session(folder)) < 0.05


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        ((), 2, "state --board"),
        (("--board", "charuco"), 2, "is no board that is known"),
        (("--board", "charuco:8x6:24:18:DICT_4X4_50"), 2, "squares are 1"),
        (("--board", "apriltag:36h11:20"), 1, "no view shows"),
    ],
)
def test_what_cannot_be_found_ends_in_one_line(cell, tmp_path, capsys, arguments, code, told):
    scans, poses = cell
    folder = write_board_session(tmp_path / "s", scans[:1], poses[:1])
    ended_with, out, err = ended(capsys, "detect", folder, *arguments)
    assert ended_with == code and told in err and not out and len(err.strip().splitlines()) == 1
    assert not (folder / "points.csv").exists()


def test_clouds_without_pixels_are_refused(session, capsys):
    code, _, err = ended(capsys, "detect", session, "--board", BOARD)
    assert code == 2 and "no scan is an image with brightness" in err


@pytest.mark.slow
def test_a_flat_board_tells_how_poses_are_to_be_read(cell, tmp_path, capsys):
    """A plane slides on itself under any reading; its corners do not."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    print_ = board_print(cv2.aruco.CharucoBoard((8, 6), 12.0, 9.0, dictionary), 8, 6, 12.0)
    inner = np.array([[c * 12.0, r * 12.0] for r in range(1, 6) for c in range(1, 8)])
    poses = poses_before(200, 6, np.array([48.0, 36.0]), seed=4, tilt=0.5)
    raw = tmp_path / "raw"
    raw.mkdir()
    small = Camera(240, 180, 300.0)
    for i, T in enumerate(poses):
        write_pcd(raw / f"scan{i}.pcd", scan_print(print_, T, inner, seed=i, camera=small))
    T_base_flange = T_BASE_BOARD @ frames.inverse(poses) @ frames.inverse(T_FLANGE_SCANNER)
    angles = Rotation.from_matrix(T_base_flange[:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = np.hstack([T_base_flange[:, :3, 3], angles])
    np.savetxt(raw / "poses.txt", rows, fmt="%.6f", delimiter=",")
    code, out, err = ended(capsys, "init", raw, "--board", BOARD, "--unit", "mm", "--yes", "--json")
    assert code == 0, err
    told = {guess["what"]: guess for guess in json.loads(out)["guesses"]}
    assert told["rotation"]["told"] and told["rotation"]["value"].startswith("zyx-intrinsic, degrees")
    assert told["pairing"]["told"] and told["targets"]["value"] == "35 in 6 of 6 clouds"
    session = load_session(raw)
    assert session.mount == "eye_in_hand" and scatter_in_base(session) < 0.1
