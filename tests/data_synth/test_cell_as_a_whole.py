"""A cell as a whole: with nothing hidden stitching leaves the noise put in, with a hidden effect visibly more."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.write import write_session
from stitch.api import pipeline
from stitch.numerics import frames
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import FINE_SAMPLES, collect_overlaps
from stitch.session.capture import prepare_capture
from stitch.session.reading.session_folder import load_session
from stitch.system.threads import library_threads_off

VIEWS = 8


HIDDEN = ("joint_compliance", "part_slip")


def leaves(folder, hidden: dict[str, float], scene: str = "blade"):
    """Rms of the correct stage, rms under the true poses, the run."""
    measured = simulated(clean(scene, rays=130), hidden, 1, VIEWS)
    write_session(folder / "s", measured, "s")
    session = load_session(folder / "s")
    run = pipeline.run(session)
    own = prepare_capture(session)
    with library_threads_off():
        true = collect_overlaps(own, measured.T_reference_scanner, run.overlaps.gate,
                       [sample_points(scan, FINE_SAMPLES) for scan in own.scans]).gram.rms  # fmt: skip
    return run.stages[1].rms, true, run, measured


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return leaves(tmp_path_factory.mktemp("still"), {})


def test_nothing_hidden_leaves_the_noise_that_was_put_in(still):
    rms, true, run, measured = still
    assert [stage.name for stage in run.stages] == ["coarse", "correct", "register", "fuse"]
    # Six numbers fitted to thousands of distances: they take away less than a permille of the square.
    assert rms == pytest.approx(true, rel=0.03)
    assert rms == pytest.approx(run.noise_floor, rel=0.10)
    # Two surfaces, each with the scanner's noise across it: less than along the ray by the slant,
    # times the square of the range over the standoff (the plan moves by 12 %).
    noise = measured.scene.scanner.noise * np.sqrt(2)
    assert 0.6 * noise < rms < 1.25 * noise


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_is_visible(still, tmp_path, name):
    rms, _, run, _ = leaves(tmp_path, {name: 1.0})
    # The hand-eye takes what it can of the effect; 0.1 mm on noise of 0.02 mm cannot hide.
    assert rms > 1.3 * still[0]
    assert rms > 1.2 * run.noise_floor


def test_true_poses_are_still_the_best_where_the_robot_scatters(still, tmp_path):
    """Repeatability as set spreads the views about their reported poses by as much."""
    scene = replace(clean("blade", rays=40), repeatability=(20e-6, 0.05))
    measured = simulated(scene, {}, 3, 16)
    reported = np.linalg.inv(measured.T_base_flange) @ measured.T_mount
    # T_reference_scanner = scatter⁻¹ · reported, and scatter acts on the flange: its twist is seen in the flange.
    twists = frames.log(reported @ frames.inverse(measured.T_reference_scanner))
    spread = np.sqrt((twists**2).mean(axis=0))
    # 48 numbers each: their rms is known to 1/√96.
    assert np.sqrt((spread[:3] ** 2).mean()) == pytest.approx(20e-6, rel=4 / np.sqrt(96))
    assert np.sqrt((spread[3:] ** 2).mean()) == pytest.approx(0.05, rel=4 / np.sqrt(96))


def test_joints_that_scatter_put_the_flange_where_their_angles_say():
    """To first order a view stands off by what its joints are off by, every view anew, and by nothing else."""
    scene = replace(clean("blade", rays=40), joint_repeatability=30e-6)
    measured = simulated(scene, {}, 3, 16)
    arm, q = scene.arm, measured.plan.joints
    T_flange = measured.T_mount @ frames.inverse(measured.T_reference_scanner)  # eye to hand: both of the scanner
    off = frames.log(frames.inverse(kinematics.flange(arm, q)) @ T_flange)
    per_rad = [
        frames.log(frames.inverse(kinematics.flange(arm, q)) @ kinematics.flange(arm, q + 1e-6 * joint)) / 1e-6
        for joint in np.eye(6)
    ]
    angles = np.linalg.solve(np.transpose(per_rad, (1, 2, 0)), off[:, :, None])[:, :, 0]
    # 96 numbers: their rms is known to 1/√192.
    assert np.sqrt((angles**2).mean()) == pytest.approx(30e-6, rel=4 / np.sqrt(192))
    assert np.abs(np.corrcoef(angles.T) - np.eye(6)).max() < 4 / np.sqrt(16)
