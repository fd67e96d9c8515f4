"""Exports of trackers: probes and reflectors."""

import csv
import io

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.plugins.intake.controllers.program import import_file


def test_tracker_probe_with_decimal_commas(tmp_path):
    file = tmp_path / "tmac.csv"
    file.write_text("Name;X [m];Y [m];Z [m];Q0;Q1;Q2;Q3\nm1;1,5;-2,25;0,125;0,7071068;0;0,7071068;0\n")
    imported = import_file(file)
    row = next(csv.DictReader(io.StringIO(imported.text)))
    assert imported.table == "frames.csv"
    assert [float(row[c]) for c in ("x", "y", "z")] == pytest.approx([1500, -2250, 125])
    assert [float(row[c]) for c in ("qx", "qy", "qz", "qw")] == pytest.approx(
        [0, np.sqrt(0.5), 0, np.sqrt(0.5)], abs=1e-7
    )


def test_tracker_angles_and_reflectors(tmp_path):
    file = tmp_path / "probe.csv"
    file.write_text("id,x,y,z,Rx (deg),Ry (deg),Rz (deg)\na,1,2,3,10,20,30\n")
    row = next(csv.DictReader(io.StringIO(import_file(file).text)))
    T = frames.from_quaternion(np.zeros(3), np.array([float(row[c]) for c in ("qx", "qy", "qz", "qw")]))
    assert T[:3, :3] == pytest.approx(Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), abs=1e-8)
    file.write_text("Point,X,Y,Z\nT1,1,2,3\nT2,4,5,6\nT1,1,2,4\n")
    imported = import_file(file)
    assert imported.table == "points.csv"
    assert [row["view"] for row in csv.DictReader(io.StringIO(imported.text))] == ["v1", "v1", "v2"]
