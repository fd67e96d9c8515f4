"""Programs that follow a part to where `stitch fit` found it: numbers of the copy against scipy."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.cli.main import main

SRC = """DEF place ()
LIN {X 2300.5, Y -120.0, Z 900.25, A 10.0, B -20.0, C 170.0} C_DIS ; in front
LIN {X 2310.0, Y -20.0, Z 900.0, A 12.0, B -21.0, C 171.0}
END
"""
MOD = "MODULE m\n  CONST robtarget p:=[[100,200,300],[0.5,0.5,0.5,0.5],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
MOD += "  PROC main()\n    MoveL p,v100,fine,grip\\WObj:=rack;\n  ENDPROC\nENDMODULE\n"


def pose(x, y, z, a, b, c):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("ZYX", [a, b, c], degrees=True).as_matrix(), [x, y, z]
    return T


NOMINAL, FOUND = pose(2300, 0, 500, 0, 0, 0), pose(2297, 4, 498, 0.3, -0.2, 0.1)


def fit_json(folder, **changed):
    found = {"length_unit": "mm", "T_base_part_nominal": NOMINAL.tolist(), "parts": [{"T_base_part": FOUND.tolist()}]}
    (folder / "fit.json").write_text(json.dumps(found | changed))
    return str(folder)


def export(*arguments):
    with pytest.raises(SystemExit) as stop:
        main(["export", *map(str, arguments)])
    return stop.value.code


def numbers(text):
    return [[float(x) for x in re.findall(r"[XYZABC] (-?[\d.]+)", line)] for line in re.findall(r"\{(.*?)\}", text)]


@pytest.mark.parametrize("frame", ["0,0,0,0,0,0", "500,-40,30,90,5,-3"])
def test_targets_stand_to_the_found_part_as_to_the_nominal_one(tmp_path, frame):
    (tmp_path / "place.src").write_text(SRC)
    out = tmp_path / "out.src"
    assert export(fit_json(tmp_path), "--program", tmp_path / "place.src", "-o", out, "--frame", frame) == 0
    F = pose(*map(float, frame.split(",")))
    for before, after in zip(numbers(SRC), numbers(out.read_text()), strict=True):
        in_part = np.linalg.inv(NOMINAL) @ F @ pose(*before)
        assert np.abs(np.linalg.inv(FOUND) @ F @ pose(*after) - in_part).max() < 2e-4  # four decimals are written
    assert re.sub(r"-?\d+\.\d+", "", out.read_text()) == re.sub(r"-?\d+\.\d+", "", SRC)


def test_metres_and_a_quaternion(tmp_path):
    """A work object at zero; T_base_part in m, the program in mm."""
    metres = np.diag([1e-3, 1e-3, 1e-3, 1])
    found, nominal = (metres @ T @ np.linalg.inv(metres) for T in (FOUND, NOMINAL))
    folder = fit_json(
        tmp_path, length_unit="m", T_base_part_nominal=nominal.tolist(), parts=[{"T_base_part": found.tolist()}]
    )
    (tmp_path / "p.mod").write_text(MOD)
    assert export(folder, "--program", tmp_path / "p.mod", "-o", tmp_path / "q.mod", "--frame", "0,0,0,1,0,0,0") == 0
    place, q = re.search(r"\[\[(.*?)\],\[(.*?)\]", (tmp_path / "q.mod").read_text()).groups()
    w, *xyz = map(float, q.split(","))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat([*xyz, w]).as_matrix(), [float(x) for x in place.split(",")]
    meant = np.eye(4)
    meant[:3, :3], meant[:3, 3] = Rotation.from_quat([0.5] * 4).as_matrix(), [100, 200, 300]
    assert np.abs(T - FOUND @ np.linalg.inv(NOMINAL) @ meant).max() < 2e-4


@pytest.mark.parametrize(
    ("changed", "program", "more", "message"),
    [
        ({"T_base_part_nominal": None}, SRC, (), "states no [nominal]"),
        ({"length_unit": None}, SRC, (), 'states no length_unit = "mm"'),
        ({"parts": None}, SRC, (), "is no fit.json of this version"),
        ({}, SRC, ("--part", "2"), "has 1 parts, no part 2"),
        ({}, "PTP {A1 0, A2 -90, A3 90, A4 0, A5 10, A6 0}\n", (), "line1 is taught by joint angles"),
    ],
)
def test_what_cannot_follow_is_refused(tmp_path, capsys, changed, program, more, message):
    (tmp_path / "place.src").write_text(program)
    told = fit_json(tmp_path, **changed), "--program", tmp_path / "place.src", "-o", tmp_path / "o.src"
    assert export(*told, "--frame", "0,0,0,0,0,0", *more) == 2
    assert message in " ".join(capsys.readouterr().err.split()) and not (tmp_path / "o.src").exists()
