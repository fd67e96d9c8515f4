"""Poses in the headers of scans: files of pye57, and samples typed after the formats' descriptions."""

from types import SimpleNamespace

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.plugins.intake.first_session import first_session
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.scan_headers import poses_in_scans, times_in_scans
from tests.needs import needs

POINTS = "0 0 100 0.5\n10 0 100 0.25\n0 10 100 1\n10 10 100 1\n"
# A quarter turn about z: the scanner's x lies along y of what it stands in.
TURNED = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
AS_IT_IS = np.eye(4)


def ptx(T):
    """A scan of one column: the scanner's place, its three axes, then the matrix for rows of points."""
    place, axes = T[:3, 3], T[:3, :3].T
    lines = [place, *axes, *T.T]
    return "4\n1\n" + "".join(" ".join(f"{x:.7f}" for x in line) + "\n" for line in lines) + POINTS


def pcd(viewpoint):
    rows = "".join(" ".join(line.split()[:3]) + "\n" for line in POINTS.splitlines())
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\n"
    return f"{head}VIEWPOINT {viewpoint}\nPOINTS 4\nDATA ascii\n{rows}"


def test_poses_in_the_headers_of_ptx_and_pcd_are_read(tmp_path):
    half = np.sqrt(0.5)
    samples = {".ptx": (ptx(AS_IT_IS), ptx(TURNED)), ".pcd": (pcd("0 0 0 1 0 0 0"), pcd(f"1 2 3 {half} 0 0 {half}"))}
    for suffix, texts in samples.items():
        files = [tmp_path / f"{name}{suffix}" for name in ("a", "b")]
        for file, text in zip(files, texts, strict=True):
            file.write_text(text)
        assert np.allclose(poses_in_scans(files), [AS_IT_IS, TURNED])
        assert poses_in_scans([files[0], files[0]]) is None  # all the same: nobody wrote poses there
    assert poses_in_scans([tmp_path / "a.ptx", tmp_path / "b.pcd"]) is None


def test_poses_in_the_headers_of_e57_are_read(tmp_path):
    pye57 = needs("pye57", "formats")
    columns = {f"cartesian{axis}": np.arange(4.0) + k for k, axis in enumerate("XYZ")}
    files = [tmp_path / f"{name}.e57" for name in "ab"]
    for file, places in zip(files, ([0.0, 0, 0], [1.0, 2, 3]), strict=True):
        with pye57.E57(str(file), mode="w") as written:
            quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
            written.write_scan_raw(columns, rotation=quarter, translation=np.array(places))
    assert np.allclose(poses_in_scans(files)[1], TURNED)
    assert np.allclose(poses_in_scans(files)[0, :3, 3], 0)
    assert times_in_scans(files) is None  # nobody wrote them
    sizes = {f"{axis}{end}": float(end == "Maximum") for axis in "xyz" for end in ("Minimum", "Maximum")}
    for file, seconds in zip(files, (1_400_000_000.25, 1_400_000_007.75), strict=True):
        with pye57.E57(str(file), mode="w") as written:
            header = SimpleNamespace(**sizes, acquisitionStart_dateTimeValue=seconds)
            written.write_scan_raw(columns, scan_header=header)
    # 16,203 days, 16 h 53 min 20 s from 1980-01-06.
    assert times_in_scans(files) == ["2024-05-17T16:53:20.250000", "2024-05-17T16:53:27.750000"]
    with pye57.E57(str(tmp_path / "two.e57"), mode="w") as written:
        written.write_scan_raw(columns)
        written.write_scan_raw(columns)
    with pytest.raises(InputError, match="holds 2 scans"):
        read_cloud(tmp_path / "two.e57")


def test_several_scans_in_a_ptx_are_refused(tmp_path):
    (tmp_path / "s.ptx").write_text(ptx(AS_IT_IS) + ptx(TURNED))
    with pytest.raises(InputError, match="to a file of its own"):
        read_cloud(tmp_path / "s.ptx")


def test_a_folder_of_such_scans_needs_no_table(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(4):
        T = AS_IT_IS.copy()
        T[:3, 3] = 0.4, 0.1 * i, 0.5
        rows = "".join(f"{x:.4f} {y:.4f} {0.4 + 0.1 * x:.4f} 1\n" for x, y in rng.uniform(-0.1, 0.1, (400, 2)))
        (tmp_path / f"pos{i}.ptx").write_text(ptx(T).replace(POINTS, rows).replace("4\n1\n", "400\n1\n", 1))
    first = first_session(tmp_path, StatedFolder())
    files = next(guess for guess in first.guesses if guess.what == "files")
    assert "4 poses in their headers" in files.value and first.pairing.by_name
    assert first.choice.best.interpretation.length_unit == "m"
