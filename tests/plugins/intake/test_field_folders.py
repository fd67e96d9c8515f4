"""Folders as people have them become the session of their campaign, or are refused with what mends them."""

import numpy as np
import pytest

from bench.intake import kind_verdict
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.field_folders import KINDS, Campaign
from data_synth.write import write_session
from stitch.errors import InputError
from stitch.output.urdf_file import to_urdf
from stitch.plugins.intake.first_session import StatedFolder, first_session
from stitch.plugins.intake.folder_files import one_scan_a_file
from stitch.plugins.intake.session_draft import write_draft
from stitch.session.reading.session_folder import load_session


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Six views of a blade by an arm without errors, with its joints."""
    folder = tmp_path_factory.mktemp("campaign") / "s"
    write_session(folder, measured_blade(11, 6, "eye_in_hand", (0.0, 0.0), pixels=60), "s")
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
QUICK += ["clouds-in-cm", "code-z-32.768-m", "trigger-words", "rtde-125hz"]


@pytest.mark.parametrize("name", QUICK)
def test_a_folder_becomes_the_session_of_its_campaign(tmp_path, campaign, name):
    first, out = made(tmp_path, name, campaign)
    assert kind_verdict(KINDS[name], campaign, out) == "right"
    assert first.choice.determined
    lost = [guess for guess in first.guesses if guess.what == "left_out"]
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
    assert first.mounting.mount == "eye_to_hand"


def test_profiles_of_a_sphere_become_a_session_for_its_calibration(tmp_path, campaign):
    with pytest.raises(InputError, match="--ball RADIUS"):
        made(tmp_path, "profiles", campaign)
    from stitch.plugins.intake.scan_targets import TargetSearch

    first = first_session(tmp_path / "in", StatedFolder(targets=TargetSearch(balls=(25.0,))))
    write_draft(tmp_path / "made", first)
    assert load_session(tmp_path / "made").sphere_radius == 25.0
