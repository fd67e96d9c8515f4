"""The scans tell what a table does not: on simulated cells of known truth, and on measured scans."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.raw_folders import Convention, raw_folder, session_poses
from data_synth.write import write_session
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake.first_session import StatedFolder, first_session
from stitch.plugins.intake.session_draft import write_draft
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.session_folder import load_session

OBJECTS = ("david", "cone", "sphere", "rubik", "gripperopen")
# The tables are written with nine digits.
DIGITS = 1e-6


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """A session of either mount: seven views, made when first asked for."""

    @cache
    def session(mount):
        folder = tmp_path_factory.mktemp("cells") / mount
        write_session(folder, measured_blade(3, views=7, mount=mount, pixels=60), mount)
        return folder

    return session


def as_read(session, folder):
    """Poses of a session, mm, and those of the session written of its raw form."""
    first = first_session(folder, StatedFolder())
    write_draft(folder, first)
    read = load_session(folder)
    scale = {"mm": 1.0, "m": 1000.0}[read.length_unit]
    T = np.array([v.T_base_flange for v in read.views])
    T[:, :3, 3] *= scale
    return first, read, session_poses(session)[0], T


def test_order_direction_unit_and_mount_are_told_by_four_small_scans(still_cells, tmp_path):
    write_session(tmp_path / "cell", still_cells["eye_in_hand"], "cell")
    folder = raw_folder(tmp_path / "cell", tmp_path / "raw", Convention("zxz", inverse=True, unit="m"))
    first, read, true, T = as_read(tmp_path / "cell", folder)
    assert read.mount == "eye_in_hand" and first.choice.determined
    assert np.abs(T - true).max() < 1e3 * DIGITS
    assert "# ? mount: eye_in_hand, the scanner sits at the flange; the poses are T_flange_base" in (
        (folder / "session.toml").read_text(encoding="utf-8")
    )


@pytest.mark.slow
def test_scans_that_lie_in_one_frame_already_are_refused(tmp_path):
    """Moved into the base by the true hand-eye, as the scanner's software does where it knows it."""
    measured = measured_blade(3, views=7, mount="eye_in_hand", pixels=40)
    write_session(tmp_path / "cell", measured, "cell")
    folder = raw_folder(tmp_path / "cell", tmp_path / "raw", Convention("xyz"))
    T, clouds = session_poses(tmp_path / "cell")
    for pose, name in zip(T @ measured.T_mount, clouds, strict=True):
        file = folder / Path(name).name
        points = frames.transform(pose, read_cloud(file).points)
        file.unlink()
        np.savetxt(file.with_suffix(".xyz"), points)
    with pytest.raises(InputError, match="lie in one frame already") as refused:
        first_session(folder, StatedFolder())
    assert "\n" not in str(refused.value) and "to fix" in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mount", "convention"),
    [
        ("eye_to_hand", Convention("ZYX", degrees=True, angles_first=False)),
        ("eye_in_hand", Convention("yxy", inverse=True, unit="m")),
    ],
)
def test_order_direction_unit_and_mount_of_a_simulated_cell(cells, tmp_path, mount, convention):
    folder = raw_folder(cells(mount), tmp_path / "raw", convention)
    first, read, true, T = as_read(cells(mount), folder)
    assert read.mount == mount and first.choice.determined
    assert frames.angle_between(T, true).max() < DIGITS
    assert np.abs(T - true)[:, :3, 3].max() < 1e3 * DIGITS


@pytest.mark.slow
def test_a_list_in_reverse_order_is_turned_around(cells, tmp_path):
    folder = raw_folder(cells("eye_to_hand"), tmp_path / "raw", Convention())
    table = folder / "RobotPoses.dat"
    table.write_text("\n".join(table.read_text().splitlines()[::-1]) + "\n")
    first, _, true, T = as_read(cells("eye_to_hand"), folder)
    assert first.pairing.rows == tuple(range(7))[::-1]
    assert np.abs(T - true).max() < 1e3 * DIGITS


def test_what_scans_cannot_tell_is_said(still_cells, tmp_path):
    """Poses that have nothing to do with the scans: no way is right, and none is called so."""
    write_session(tmp_path / "cell", still_cells["eye_to_hand"], "cell")
    folder = raw_folder(tmp_path / "cell", tmp_path / "raw", Convention())
    table = folder / "RobotPoses.dat"
    rng = np.random.default_rng(0)
    np.savetxt(table, np.hstack([rng.uniform(-1, 1, (4, 3)), rng.uniform(300, 600, (4, 3))]), delimiter=",")
    first = first_session(folder, StatedFolder())
    assert not first.choice.determined
    assert {g.what for g in first.guesses if not g.determined} >= {"rotation", "mount"}


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTS)
def test_raw_scans_of_reghec_become_the_sessions_that_they_are(reghec, tmp_path, stitch_command, name):
    """As published: angles first, in radians, a comma at the end, no header; then a run of it."""
    folder = raw_folder(reghec(name), tmp_path / name, Convention())
    stitch_command("init", folder, "--yes")
    read, stated = load_session(folder), load_session(reghec(name))
    assert (read.mount, read.length_unit) == (stated.mount, stated.length_unit)
    for a, b in zip(read.views, stated.views, strict=True):
        assert np.abs(a.T_base_flange - b.T_base_flange).max() < 1e3 * DIGITS
        assert np.array_equal(a.cloud.points, b.cloud.points)
    stitch_command("run", folder, "-o", tmp_path / "run", "--no-recording")
    assert (tmp_path / "run" / "stitched.ply").exists()
