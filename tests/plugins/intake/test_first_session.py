"""The scans tell what a table does not: on simulated cells of known truth, and on measured scans.

Folders as people have them become the session of their campaign, or are refused with what mends them.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.intake import kind_verdict
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.field_folders import KINDS, Campaign
from data_synth.fixtures.raw_folders import Convention, raw_folder, session_poses
from data_synth.write import write_session
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.output.urdf_file import to_urdf
from stitch.plugins.intake.first_session import first_session
from stitch.plugins.intake.folder_files import one_scan_a_file
from stitch.plugins.intake.session_draft import write_draft
from stitch.plugins.intake.stated_folder import StatedFolder
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


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Six views of a blade by an arm without errors, with its joints."""
    folder = tmp_path_factory.mktemp("campaign") / "s"
    write_session(folder, measured_blade(11, 6, "eye_in_hand", (0.0, 0.0), pixels=40), "s")
    session = load_session(folder)
    T = np.array([view.T_base_flange for view in session.views])
    joints = np.array([view.joints for view in session.views])
    return Campaign(tuple(view.cloud.points for view in session.views), T, joints, to_urdf(session.robot))


def made(tmp_path, name, campaign, **stated):
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    KINDS[name].write(folder, campaign)
    with one_scan_a_file(folder) as scans:
        first = first_session(scans, StatedFolder(**stated))
        write_draft(out, first, unpacked=scans != folder)
    return first, out


QUICK = ["kuka-e6pos", "halcon-abg", "pose-graph", "colmap", "one-ptx", "pts-with-count", "ply-blank-lines"]
QUICK += ["joint-states-yaml", "label-colon", "units-in-cells", "empty-cloud", "row-of-minus-inf", "code-minus-9999"]
QUICK += ["clouds-in-cm", "code-z-32.768-m", "rtde-125hz", pytest.param("trigger-words", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", QUICK)
def test_a_folder_becomes_the_session_of_its_campaign(tmp_path, campaign, name):
    first, out = made(tmp_path, name, campaign)
    assert kind_verdict(KINDS[name], campaign, out) == "right"
    assert first.choice.determined
    scans = {file.name for file in tmp_path.rglob("*")}
    lost = [words for words in first.not_used if Path(words.split(":")[0]).name in scans and "rows of" not in words]
    assert bool(lost) == bool(KINDS[name].views)


def test_numbered_clouds_find_their_rows_though_three_are_missing(tmp_path, campaign):
    gone = (0, 2, 4)
    for i, _ in enumerate(campaign.T):
        if i not in gone:
            np.savetxt(tmp_path / f"view{i + 1}.xyz", campaign.clouds[i])
    np.savetxt(tmp_path / "poses.txt", np.hstack([campaign.p, campaign.R.as_quat()]))
    first = first_session(tmp_path, StatedFolder())
    assert first.pairing.rows == (1, 3, 5) and "counted from 1" in first.pairing.words


@pytest.mark.parametrize(
    "name",
    # Each tries dozens of readings on the scans: some seconds.
    ["q0-q3-xyzw", *(pytest.param(name, marks=pytest.mark.slow) for name in ("rail-e1-y", "coupled-fanuc"))],
)
def test_the_scans_overrule_the_names_of_columns(tmp_path, campaign, name):
    first, out = made(tmp_path, name, campaign)
    assert kind_verdict(KINDS[name], campaign, out) == "right" and first.choice.overruled
    rotation = next(guess for guess in first.guesses if guess.what == "rotation")
    assert "the scans contradict" in rotation.reason


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("joint-states-no-urdf", "joint angles"),
        ("xyz-alone", "--orientation"),
        ("xyz-alone", "--columns"),
        pytest.param("depth-quarter-mm", '"depth_scale": 4000', marks=pytest.mark.slow),
    ],
)
def test_a_refusal_names_the_cause_and_what_mends_it(tmp_path, campaign, name, told):
    with pytest.raises(InputError, match="; to fix: ") as refused:
        made(tmp_path, name, campaign)
    assert told in str(refused.value)


def test_one_stated_orientation_completes_x_y_z(tmp_path, campaign):
    still = np.tile(campaign.T[0], (4, 1, 1))
    still[:, :3, 3] += 10.0 * np.random.default_rng(0).normal(size=(4, 3))
    angles = tuple(campaign.R[0].as_euler("xyz", degrees=True).tolist())
    moved = (still[0, :3, 3] - still[:, :3, 3]) @ still[0, :3, :3]
    some = Campaign(tuple(campaign.clouds[0] + shift for shift in moved), still)
    _, out = made(tmp_path, "xyz-alone", some, orientation=angles, rotation="xyz-extrinsic", mount="eye_in_hand")
    found = np.array([view.T_base_flange for view in load_session(out).views])
    assert np.abs(found - still).max() < 1e-3


def test_angles_in_names_turn_the_part_about_z(tmp_path, campaign):
    for angle, cloud in zip((0, 15, 35), campaign.clouds, strict=False):
        np.savetxt(tmp_path / f"part_{angle}deg.xyz", cloud)
    first = first_session(tmp_path, StatedFolder())
    T = first.choice.best.interpretation.reading.T
    assert np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0])) == pytest.approx([0, 15, 35])
    assert first.mount == "eye_to_hand"


def test_profiles_of_a_sphere_become_a_session_for_its_calibration(tmp_path, campaign):
    with pytest.raises(InputError, match="--ball RADIUS"):
        made(tmp_path, "profiles", campaign)
    from stitch.plugins.intake.scan_targets import TargetSearch

    first = first_session(tmp_path / "in", StatedFolder(targets=TargetSearch(balls=(25.0,))))
    write_draft(tmp_path / "made", first)
    assert load_session(tmp_path / "made").sphere_radius == 25.0


@pytest.mark.parametrize("others", [slice(4, None), pytest.param(slice(1, None, 2), marks=pytest.mark.slow)])
def test_scans_of_two_parts_are_told_by_name_and_those_of_one_are_not(tmp_path, others):
    """The second part is the first one sheared, scanned at right poses."""
    measured = measured_blade(13, 8, "eye_in_hand", (0.0, 0.0), pixels=60)
    write_session(tmp_path / "s", measured, "s")
    session = load_session(tmp_path / "s")
    poses = np.array([view.T_base_flange for view in session.views])
    T = poses @ measured.T_mount
    shear = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]])
    parts = [frames.transform(pose, view.cloud.points) for pose, view in zip(T, session.views, strict=True)]
    middle = np.vstack(parts).mean(axis=0)
    for folder, sheared in (("one", []), ("two", np.arange(8)[others].tolist())):
        (tmp_path / folder).mkdir()
        for i, (pose, part) in enumerate(zip(T, parts, strict=True)):
            part = (part - middle) @ shear.T + middle if i in sheared else part
            np.save(tmp_path / folder / f"scan_{i}.npy", frames.transform(np.linalg.inv(pose), part))
        np.savetxt(tmp_path / folder / "poses.txt", poses[:, :3].reshape(8, 12))
    assert first_session(tmp_path / "one", StatedFolder()).choice.determined
    with pytest.raises(InputError, match="two parts, or one that changed its shape") as refused:
        first_session(tmp_path / "two", StatedFolder())
    rows = {row for fix in refused.value.fixes for row in [fix.options["rows"]]}
    second = ",".join(str(i + 1) if i in sheared else "-" for i in range(8))
    assert second in rows and len(rows) == 2
