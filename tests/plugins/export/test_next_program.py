"""Programs that drive to proposed views, read back by the readers of the controllers' own files."""

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.export.next_program import next_program
from stitch.plugins.intake.controllers.program import read_program

JOINTS = [[-1.25, -68.5, 111.0, 69.125, 67.0, 6.5], [10.0, -70.0, 100.0, -30.0, 55.5, 170.25]]
POSES = np.array(
    [
        frames.exp(np.array([0.3, -1.1, 0.4, 900.0, -120.5, 640.25])),
        frames.exp(np.array([0, 0, 1.0, 1.0, 2.0, 3.0])),
    ]
)
ABOUT = "Drives to the view that decides between gear_eccentricity and gear_harmonic."


@pytest.mark.parametrize("ending", [".src", ".mod", ".ls", ".script"])
def test_a_joint_program_is_read_back_with_the_angles_that_were_written(tmp_path, ending):
    file = tmp_path / f"next{ending}"
    text = next_program(file, JOINTS, POSES, ABOUT, j3="own")
    file.write_bytes(text.encode())
    points = read_program(file).points
    read = np.degrees([point.joints for point in points])
    np.testing.assert_allclose(read, JOINTS, atol=6e-4)


def test_a_yaskawa_job_is_read_back_with_the_flange_in_the_base(tmp_path):
    file = tmp_path / "next.jbi"
    file.write_bytes(next_program(file, JOINTS, POSES, ABOUT).encode())
    points = read_program(file).points
    read = np.array([point.T_frame_tool for point in points])
    np.testing.assert_allclose(read, POSES, atol=6e-4)


@pytest.mark.parametrize("ending", [".src", ".mod", ".ls", ".script", ".jbi"])
def test_every_program_says_that_it_has_to_be_checked_and_stops_at_each_view(ending, tmp_path):
    text = next_program(tmp_path / f"next{ending}", JOINTS, POSES, ABOUT, j3="own")
    told = " ".join(line.split("!")[-1].rstrip(" ;") for line in text.splitlines())
    assert "reduced speed" in told
    stops = {".src": "HALT", ".mod": "Stop;", ".ls": "PAUSE ;", ".script": "popup(", ".jbi": "PAUSE"}
    assert text.count(stops[ending]) == len(JOINTS)


def test_the_joints_of_a_fanuc_count_from_the_horizontal(tmp_path):
    file = tmp_path / "next.ls"
    with pytest.raises(InputError, match=r"--j3 j2\+j3"):
        next_program(file, JOINTS, POSES, ABOUT)
    file.write_text(next_program(file, JOINTS, POSES, ABOUT, j3="j2+j3"))
    read = np.degrees([point.joints for point in read_program(file).points])
    np.testing.assert_allclose(read[:, 2], [q[2] - q[1] for q in JOINTS], atol=6e-4)


def test_an_ending_that_no_controller_has_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.src, \.mod, \.ls, \.script, \.jbi"):
        next_program(tmp_path / "next.txt", JOINTS, POSES, ABOUT)


def test_a_job_in_pulses_is_refused_with_its_line(tmp_path):
    file = tmp_path / "old.jbi"
    file.write_text("/JOB\n//NAME A\n//POS\n///POSTYPE PULSE\n///PULSE\nC00000=1,2,3,4,5,6\n//INST\n")
    with pytest.raises(InputError, match="line 6: C00000 is in pulses"):
        read_program(file)
