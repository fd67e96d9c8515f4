"""Effects undo nature's laws, which share no code with them; what a session has to have for each, and in which units."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
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
from stitch.effects.contract import find_effect, missing_need, parameters_in, require_available
from stitch.effects.user_file import load as load_effects
from stitch.errors import InputError
from stitch.model.forward import corrected_capture, perturbed_frames
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of, sensor_kind, with_part_origin
from stitch.session.notes import sensor_note
from stitch.session.session import Sighting

# Amplitude 1 is a tenth of a millimetre; a hundredth of that must remain: second-order terms are smaller still.
_LEFT = 0.03


def chain_for(measured):
    session = session_of(measured)
    return measurement_of(session, prepare_capture(session))


def hidden(name, mount):
    return measured_blade(0, views=4, mount=mount, repeatability=(0.0, 0.0), pixels=40, hidden={name: 1.0}, noise=0.0)


RIGID = [
    "mount_drift", "mount_warmup", "joint_offset", "link_geometry", "joint_compliance", "gear_eccentricity",
    "gear_harmonic", "backlash", "settling", "robot_thermal_growth", "base_compliance", "joint_thermal", "joint_step",
    "mount_creep", "mount_step", "link_thermal",
]  # fmt: skip


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("name", RIGID)
def test_undoing_an_effect_gives_natures_poses(still_cells, name, mount):
    """The model with nature's own parameters places every view where it truly was."""
    measured = hidden(name, mount)
    measurement = chain_for(measured)
    told = measured.hidden[name]
    effect = EFFECTS[name]
    values = np.array([told.get(p.name, 0.0) for p in parameters_in(measurement, effect)])
    left, right = perturbed_frames(measurement, [term_of(measurement, effect).at(values)])
    poses = left @ measured.T_mount @ right
    plain, still = perturbed_frames(measurement, [])
    middle = np.array([[0.0, 0.0, 420.0]])
    truth = frames.transform(measured.T_reference_scanner, middle)
    off = np.linalg.norm(frames.transform(poses, middle) - truth, axis=-1).max()
    before = np.linalg.norm(frames.transform(plain @ measured.T_mount @ still, middle) - truth, axis=-1).max()
    assert before > 0.01
    assert off < 1e-6


@pytest.mark.parametrize(
    "name", ["range_scale", "range_nonlinearity", "field_curvature", "lens_distortion", "scanner_thermal_scale"]
)
def test_undoing_a_scanner_effect_gives_the_true_points(name):
    """Same seed with and without: the corrected points are those of the cell without the effect."""
    plain, bent = hidden_pair(name, "eye_to_hand")
    measurement = chain_for(bent)
    effect = EFFECTS[name]
    values = np.array([bent.hidden[name].get(p.name, 0.0) for p in parameters_in(measurement, effect)])
    mended = corrected_capture(measurement, Model(bent.T_mount, (term_of(measurement, effect).at(values),)))
    for scan, true, wrong in zip(mended.scans, plain.clouds, bent.clouds, strict=True):
        before = np.abs(wrong.points - true.points).max()
        assert np.abs(scan.points - true.points).max() <= _LEFT * before + 1e-9


def hidden_pair(name, mount):
    common = {"views": 3, "mount": mount, "repeatability": (0.0, 0.0), "pixels": 50}
    return measured_blade(2, **common), measured_blade(2, hidden={name: 1.0}, **common)


def chain_with_origin(measured):
    session = session_of(measured)
    return with_part_origin(measurement_of(session, prepare_capture(session)), measured.T_mount)


@pytest.mark.parametrize(
    ("effect", "carried"),
    [
        (f"{body}_{law}", mount)
        for law in ("droop", "bend")
        for body, mount in (("mount", "eye_in_hand"), ("fixture", "eye_to_hand"))
    ],
)
def test_only_what_the_arm_turns_against_gravity_can_droop(still_cells, effect, carried):
    for mount in ("eye_to_hand", "eye_in_hand"):
        missing = missing_need(chain_with_origin(still_cells[mount]), EFFECTS[effect])
        assert missing == (() if mount == carried else EFFECTS[effect].needs)


@pytest.mark.parametrize(("effect", "mount"), [("mount_droop", "eye_in_hand"), ("fixture_droop", "eye_to_hand")])
def test_a_weight_beside_the_axis_tilts_what_holds_it_towards_gravity(still_cells, effect, mount):
    """w = d/k: the rotation by K⁻¹·(d×F) of a joint as soft about all axes, about the flange's origin."""
    measurement = chain_with_origin(still_cells[mount])
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
    measurement = chain_with_origin(still_cells["eye_in_hand"])
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


@pytest.mark.parametrize(("mount", "body"), [("eye_in_hand", "mount"), ("eye_to_hand", "fixture")])
@pytest.mark.parametrize("oblique", [False, True])
def test_a_bracket_along_the_flanges_axis_droops_and_an_oblique_one_bends(mount, body, oblique):
    """Either does what a droop does: the special case is named where it is enough, and only there."""
    joints = joints_of(np.random.default_rng(9), 40)
    turned = np.array([flange(q)[:3, :3].T @ [0, 0, -1.0] for q in joints]) - [0, 0, 1.0]
    # Softest across a line 60° off the axis, or about the axis itself.
    line = np.array([0.0, np.sqrt(0.75), 0.5]) if oblique else np.array([0.0, 0.0, 1.0])
    shift = 0.3 * turned @ (np.eye(3) - np.outer(line, line))
    moved = np.hstack([np.cross([2e-4, -3e-4, 4e-4], turned), shift])
    session, *_ = labelled_cell(9, 40, mount, errors=(np.zeros((40, 6)), moved))
    linear = linear_model_of(run(session)).restricted(())
    asked = [candidate_of(linear, EFFECTS[f"{body}_{name}"]) for name in ("droop", "bend")]
    first, second = rank_all(linear, asked)[0]
    assert first.name == f"{body}_{'bend' if oblique else 'droop'}" and is_certain(first)
    assert first.log_posterior > second.log_posterior + ODDS


def test_labelled_points_show_how_far_a_base_tilts_under_its_load(tmp_path):
    """The second example of docs/extend.md, by its name: what the payload does is told from what the links may do."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "extend.md").read_text(encoding="utf-8")
    (tmp_path / "own.py").write_text(next(block for block in page.split("```python\n")[1:]).split("```")[0])
    c, rng = np.array([6e-6, 9e-6]), np.random.default_rng(7)
    joints, load = joints_of(np.random.default_rng(7), 40), rng.uniform(0, 20, 40)
    poses = np.array([flange(q) for q in joints])
    moments = np.cross(poses[:, :3, 3] / 1000, load[:, None] * [0, 0, -9.81])
    turned = np.hstack([moments[:, :2] * c, np.zeros((40, 4))])
    moved = np.einsum("vij,vj->vi", frames.adjoint(frames.inverse(poses)), turned)
    session, *_ = labelled_cell(7, 40, payload=load, errors=(np.zeros((40, 6)), moved))
    (name,) = load_effects(tmp_path / "own.py")
    try:
        fitted = {p.name: p for p in run(session, effects=[name]).terms[0].parameters}
    finally:
        del EFFECTS[name]
    for key, true in zip(("c_x", "c_y"), c, strict=True):
        assert abs(fitted[key].value - true) < 4 * fitted[key].sigma < true


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
    (name,) = load_effects(tmp_path / "own.py")
    try:
        measurement = chain_with_origin(still_cells["eye_in_hand"])
        left, right = perturbed_frames(measurement, [term_of(measurement, EFFECTS[name]).at(xi)])
    finally:
        del EFFECTS[name]
    for v, T_base_flange in enumerate(measurement.T_base_flange):
        bent = frames.exp(xi * (T_base_flange[:3, :3].T @ [0, 0, -1.0])[1] ** 3)
        np.testing.assert_allclose(left[v] @ T @ right[v], T_base_flange @ bent @ T, atol=1e-9)


SENSOR = {name for name, e in EFFECTS.items() if e.place == "sensor" and e.tier == "physical"}


@pytest.mark.parametrize(
    ("kind", "never"),
    [
        (None, set()),
        ("area", set()),
        ("line", set()),
        ("camera", {"incidence_bias", "intensity_bias"}),
        ("tracker", SENSOR),
        ("probe", SENSOR),
    ],
)
def test_a_tracker_has_no_lens_and_a_camera_sees_no_slant(kind, never):
    session, *_ = labelled_cell(2, views=4)
    session = replace(session, scanner=replace(session.scanner, kind=kind))
    measurement = measurement_of(session, prepare_capture(session))
    words = {"optics", "surfaces"}
    assert {name for name in SENSOR if words & set(missing_need(measurement, EFFECTS[name]))} == never
    if kind == "tracker":
        with pytest.raises(InputError, match=r"lens_distortion needs a sensor with optics .*\[scanner\]"):
            require_available(measurement, EFFECTS["lens_distortion"])


def test_a_sensor_that_shows_points_beside_and_behind_itself_has_no_lens():
    """If its kind is not stated: a tracker turns to every target, a lens has all of them ahead."""
    session, *_ = labelled_cell(2, views=40)
    assert measurement_of(session, prepare_capture(session)).has_optics
    middle = np.mean([view.sighting.points.mean(axis=0) for view in session.views], axis=0)
    around = [
        replace(view, sighting=replace(view.sighting, points=view.sighting.points - middle)) for view in session.views
    ]
    session = replace(session, views=tuple(around))
    assert not measurement_of(session, prepare_capture(session)).has_optics
    session = replace(session, scanner=replace(session.scanner, kind="camera"))
    assert measurement_of(session, prepare_capture(session)).has_optics


@pytest.mark.parametrize(("away", "taken"), [(0.0, "tracker"), (10.0, "tracker"), (1500.0, None)])
def test_a_tracker_that_speaks_in_the_robots_base_is_no_scanner(away, taken):
    """Points on the flange that stand still in it are given in the base; a scanner stands at some distance."""
    session, *_ = labelled_cell(3, views=30)
    ball = np.array([30.0, -40.0, 150.0])
    seen = [
        replace(
            view,
            sighting=Sighting(
                ("ball",),
                (view.T_base_flange[:3, :3] @ ball + view.T_base_flange[:3, 3])[None] + [away, 0, 0],
                np.array([0.01]),
            ),
        )
        for view in session.views
    ]
    session = replace(session, views=tuple(seen), scanner=replace(session.scanner, kind=None))
    assert sensor_kind(session) == taken
    assert ("taken for a tracker" in sensor_note(session)) == (taken is not None)
    assert sensor_note(replace(session, scanner=replace(session.scanner, kind="line"))) == ""


def test_parameters_are_in_the_unit_of_the_session():
    effect = EFFECTS["mount_drift"]
    mm, m = (effect.parameters(6, (), unit) for unit in ("mm", "m"))
    assert [p.unit for p in mm] == ["rad/h"] * 3 + ["mm/h"] * 3
    assert m[3].unit == "m/h"
    assert m[3].typical == pytest.approx(mm[3].typical / 1000)
    kappa = EFFECTS["part_sag"].parameters(6, (), "m")[0]
    assert kappa.unit == "1/m"
    assert kappa.typical == pytest.approx(1000 * EFFECTS["part_sag"].parameters(6, (), "mm")[0].typical)


def test_the_view_of_an_event_is_told_by_its_name(still_cells):
    measurement = chain_for(still_cells["eye_to_hand"])
    names = session_of(still_cells["eye_to_hand"]).names
    (place,) = (p for p in parameters_in(measurement, EFFECTS["part_slip"]) if p.discrete)
    assert str(replace(place, value=2.0).formatted) == names[2]
    # Of the views that are left, numbers and names stay those of the session.
    (without,) = (p for p in parameters_in(measurement.without([0]), EFFECTS["part_slip"]) if p.discrete)
    assert str(replace(without, value=2.0).formatted) == names[2]
    assert str(replace(place, value=2.0, names=()).formatted) == "view 2, counted from 0"


def test_unknown_and_impossible_effects_are_refused(still_cells):
    with pytest.raises(InputError, match="no effect 'elbow'"):
        find_effect("elbow")
    with pytest.raises(InputError, match="velocity_deg_s"):
        require_available(chain_for(still_cells["eye_to_hand"]), EFFECTS["latency"])


@pytest.mark.parametrize(
    "name", [n for n, e in EFFECTS.items() if e.place == "sensor" and e.needs in ((), ("intensity",))]
)
def test_a_scanner_that_looks_along_minus_z_has_the_same_errors(blade_capture, name):
    """Turning the scanner's frame by 180° about x turns every effect of the scanner with it."""
    measured, capture = blade_capture
    measurement, effect, turn = measurement_of(session_of(measured), capture), EFFECTS[name], np.diag([1.0, -1.0, -1.0])
    term = term_of(measurement, effect)
    arguments = term.at(term.typical).arguments
    points = capture.scans[0].points
    moved = effect.function(points, measurement.scan_views[0], **arguments)
    assert np.abs(moved - points).max() > 1e-3
    assert np.allclose(effect.function(points @ turn, measurement.scan_views[0], **arguments) @ turn, moved, atol=1e-12)
