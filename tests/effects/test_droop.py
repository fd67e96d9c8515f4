"""Effects of what holds scanner and part under gravity, against nature's beam and closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import flange, joints_of, labelled_cell
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.laws.brackets import GEOMETRY, end_twist
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.ranking import is_certain, rank_all
from stitch.diagnosis.thresholds import ODDS
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need
from stitch.effects.user_file import load
from stitch.model.forward import perturbed_frames
from stitch.model.model import term_of
from stitch.numerics import frames
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of, with_part_origin


def chain_for(measured):
    session = session_of(measured)
    return with_part_origin(measurement_of(session, prepare_capture(session)), measured.T_mount)


@pytest.mark.parametrize(("effect", "carried"), [("mount_droop", "eye_in_hand"), ("fixture_droop", "eye_to_hand")])
def test_only_what_the_arm_turns_against_gravity_can_droop(still_cells, effect, carried):
    for mount in ("eye_to_hand", "eye_in_hand"):
        missing = missing_need(chain_for(still_cells[mount]), EFFECTS[effect])
        assert missing == (() if mount == carried else EFFECTS[effect].needs)


@pytest.mark.parametrize(("effect", "mount"), [("mount_droop", "eye_in_hand"), ("fixture_droop", "eye_to_hand")])
def test_a_weight_beside_the_axis_tilts_what_holds_it_towards_gravity(still_cells, effect, mount):
    """w = d/k: the rotation by K⁻¹·(d×F) of a joint as soft about all axes, about the flange's origin."""
    measurement = chain_for(still_cells[mount])
    lever, shift = np.array([1e-4, -2e-4, 3e-4]), 0.07
    values = np.array([shift, *lever, 0, 0, 0, 0, 0])
    left, right = perturbed_frames(measurement, [term_of(measurement, EFFECTS[effect]).at(values)])
    T = still_cells[mount].T_mount
    for v, T_base_flange in enumerate(measurement.T_base_flange):
        turned = T_base_flange[:3, :3].T @ [0, 0, -1.0] - [0, 0, 1.0]
        drooped = frames.exp(np.append(np.cross(lever, turned), shift * turned * [1, 1, 0]))
        expected = T_base_flange @ drooped @ T
        if mount == "eye_to_hand":
            expected = np.linalg.inv(drooped) @ np.linalg.inv(T_base_flange) @ T
        np.testing.assert_allclose(left[v] @ T @ right[v], expected, atol=1e-9)


ROUND = {"bend_weak": 2e-8, "bend_strong": 2e-8, "twist": 2e-8}
FLAT = {"bend_weak": 4e-8, "bend_strong": 1e-8, "twist": 1e-8}


@pytest.mark.parametrize(("beam", "free", "left_over"), [(ROUND, 4, 0.1), (FLAT, 9, 0.1)])
def test_the_effect_can_do_what_a_beam_does(still_cells, beam, free, left_over):
    """Round: s and w alone. Flat and bent obliquely: with A. The hand-eye takes up what all views share."""
    measurement = chain_for(still_cells["eye_in_hand"])
    T, zero = still_cells["eye_in_hand"].T_mount, term_of(measurement, EFFECTS["mount_droop"])
    vectors = np.concatenate([[20.0, -10.0, 120.0], [30.0, 20.0, 25.0], np.array([0.5, 1.0, 0.0]) / np.sqrt(1.25)])
    if beam is ROUND:
        vectors[3:6] = [5.0, 0.0, 40.0]
    p = dict(zip(GEOMETRY, vectors, strict=True)) | beam
    points = np.array([[x, y, 420.0] for x in (-80.0, 80.0) for y in (-80.0, 80.0)])

    def places(values, right):
        before, behind = perturbed_frames(measurement, [zero.at(values)])
        return frames.transform(before @ T @ right @ behind, points).ravel()

    drooped = [end_twist(p, T_flange[:3, :3].T @ [0, 0, -1.0]) for T_flange in measurement.T_base_flange]
    true = frames.transform(measurement.T_base_flange @ frames.exp(np.array(drooped)) @ T, points).ravel()
    there, step = np.eye(4), 1e-5
    still = places(np.zeros(9), there)
    columns = [(places(step * np.eye(9)[i], there) - still) / step for i in range(free)]
    shared = [(places(np.zeros(9), frames.exp(step * np.eye(6)[i])) - still) / step for i in range(6)]

    def rms_beside(own):
        A = np.array(own).T
        return np.sqrt(np.mean((true - still - A @ np.linalg.lstsq(A, true - still, rcond=1e-12)[0]) ** 2))

    assert rms_beside(shared) > 0.02
    assert rms_beside([*columns, *shared]) < left_over * rms_beside(shared)


def test_a_bracket_of_nature_is_told_from_an_arm_that_errs():
    """Certain, and ahead of what bends and turns the wrist as gravity does; the smallest cell that shows it."""
    cell = replace(clean("blade-table", rays=40), repeatability=(1e-5, 0.01))
    linear = linear_model_of(run(session_of(simulated(cell, {"mount_droop": 2.0}, 3, views=12)))).restricted(())
    asked = [candidate_of(linear, EFFECTS[name]) for name in ("mount_droop", "joint_compliance", "gear_eccentricity")]
    first, second, *_ = rank_all(linear, asked)[0]
    assert first.name == "mount_droop" and is_certain(first)
    assert first.log_posterior > second.log_posterior + ODDS


@pytest.mark.parametrize(("mount", "effect"), [("eye_in_hand", "mount_droop"), ("eye_to_hand", "fixture_droop")])
def test_labelled_points_show_how_far_a_bracket_tilts(mount, effect):
    lever, sideways = np.array([2e-4, -3e-4, 4e-4]), 0.15
    joints = joints_of(np.random.default_rng(5), 30)
    turned = np.array([flange(q)[:3, :3].T @ [0, 0, -1.0] for q in joints]) - [0, 0, 1.0]
    moved = np.hstack([np.cross(lever, turned), sideways * turned * [1, 1, 0]])
    session, T_mount, _ = labelled_cell(5, 30, mount, errors=(np.zeros((30, 6)), moved))
    found = run(session, effects=[effect])
    fitted = {p.name: p for p in found.terms[0].parameters}
    true = dict(zip(("s", "wx", "wy", "wz"), [sideways, *lever], strict=True))
    for name, value in true.items():
        assert abs(fitted[name].value - value) < 4 * fitted[name].sigma < 1.2 * abs(value)
    error = frames.log(frames.inverse(found.T_mount) @ T_mount)
    assert error @ np.linalg.solve(found.mount_covariance, error) < 22.5  # 99.9 % of χ²(6)


def test_a_users_effect_of_the_mount_knows_gravity_and_the_flanges_pose(tmp_path, still_cells):
    (tmp_path / "own.py").write_text(
        "import numpy as np\n"
        "from stitch.effects import effect, twist\n\n"
        '@effect("mount", needs=["gravity_at_mount"], xi=twist("", 3e-4, 0.1))\n'
        "def rubber_mount(views, xi):\n"
        '    """M·exp(ξ·g_y³)"""\n'
        "    gravity = np.array([T[:3, :3].T @ [0, 0, -1.0] for T in views.T_base_flange])\n"
        "    assert np.allclose(gravity, views.gravity_at_mount)\n"
        "    return views.at_scanner(np.outer(gravity[:, 1] ** 3, xi))\n"
    )
    xi, T = np.array([1e-4, 0, 2e-4, 0.1, 0, 0]), still_cells["eye_in_hand"].T_mount
    (name,) = load(tmp_path / "own.py")
    try:
        measurement = chain_for(still_cells["eye_in_hand"])
        left, right = perturbed_frames(measurement, [term_of(measurement, EFFECTS[name]).at(xi)])
    finally:
        del EFFECTS[name]
    for v, T_base_flange in enumerate(measurement.T_base_flange):
        bent = frames.exp(xi * (T_base_flange[:3, :3].T @ [0, 0, -1.0])[1] ** 3)
        np.testing.assert_allclose(left[v] @ T @ right[v], T_base_flange @ bent @ T, atol=1e-9)
