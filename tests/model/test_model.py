"""The model of a cell: what is printed of its hand-eye, the covariance of its effects, its file, and its use in sessions.

The hand-eye without its model: at the mean of the effects over the views, with what single views differ by.

What a model hands on to another session.

Slopes of poses and points against differences and against nature.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.edits import edit
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import TABLE, TARGETS, flange, joints_of, labelled_cell
from stitch.api.pipeline import run, run_rig
from stitch.api.rig import require_effects
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need, parameters_in
from stitch.errors import InputError
from stitch.model.forward import PointSlopes, perturbed_frames, pose_derivatives
from stitch.model.hand_eye_alone import hand_eye_alone
from stitch.model.model import (
    EffectsCovariance,
    Model,
    Term,
    expanded_uncertainty,
    kept_root,
    printed_covariance,
    term_of,
    with_fitted_effects,
)
from stitch.model.model_toml import (
    ModelFile,
    arm_model,
    bind_to_session,
    convert_unit,
    read_model,
    without_events,
    write_model,
)
from stitch.numerics import frames
from stitch.output.result_document import model_of
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of, with_part_origin
from stitch.session.robot import unit_torques

SHIFT = np.array([0, 0, 0, 2.0, -1.0, 0.5])
SLIP = np.array([0.02, -0.01, 0.03]), np.array([1.0, -2.0, 0.5])  # rad, mm, reference frame
SLIPPED_AT, OTHER_SESSION = 30, 50


@pytest.mark.parametrize("angle", [1e-5, 0.8, 3.1])
def test_the_printed_hand_eye_scatters_as_printed(angle):
    """Hand-eyes drawn from the scanner-frame covariance, printed each, have the covariance that is predicted."""
    rng = np.random.default_rng(2)
    axis = np.array([2.0, -1.0, 2.0]) / 3
    T = frames.make(Rotation.from_rotvec(angle * axis).as_matrix(), np.array([650.0, -150.0, 900.0]))
    half = rng.normal(size=(6, 6)) * np.array([1e-5] * 3 + [1e-2] * 3)[:, None]
    drawn = T @ frames.exp(rng.standard_normal((200_000, 6)) @ half.T)
    turns = (Rotation.from_matrix(drawn[:, :3, :3]).as_rotvec() - angle * axis).T
    printed = np.cov(np.vstack([turns, drawn[:, :3, 3].T]))
    expected = printed_covariance(T, half @ half.T)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(printed / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.015)
    np.testing.assert_allclose(expanded_uncertainty(T, half @ half.T), 2 * scale)


def test_axes_of_the_scanner_are_not_those_of_the_mount():
    """Sure along the scanner's z alone; the scanner looks along the base's x: there the sigma must stand."""
    T = frames.make(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.zeros(3))
    covariance = np.diag([0.0, 0, 0, 0.123**2, 0.05**2, 0.0126**2])
    np.testing.assert_allclose(expanded_uncertainty(T, covariance)[3:], 2 * np.array([0.0126, 0.05, 0.123]))


@pytest.fixture
def term():
    parameters = EFFECTS["joint_offset"].parameters(6, (), "mm")
    return Term(EFFECTS["joint_offset"], parameters)


@pytest.fixture
def matrix():
    half = np.random.default_rng(0).normal(size=(3, 3)) * [1e-5, 2e-4, 3e-5]
    return half.T @ half


def known(term, matrix, names):
    sigma = dict(zip(names, np.sqrt(np.diag(matrix)), strict=True))
    return replace(
        term, parameters=tuple(replace(p, sigma=sigma.get(p.name, np.nan)) for p in term.parameters)
    ), EffectsCovariance(tuple(f"joint_offset.{n}" for n in names), matrix)


def test_the_root_squared_is_the_matrix_wherever_its_parameters_stand(term, matrix):
    own, covariance = known(term, matrix, ["d4", "d2", "d3"])
    L = covariance.root([own])
    whole = np.zeros((6, 6))
    at = [3, 1, 2]
    whole[np.ix_(at, at)] = matrix
    np.testing.assert_allclose(L @ L.T, whole, rtol=1e-9, atol=1e-22)


def test_a_sigma_that_was_edited_counts_alone(term, matrix):
    own, covariance = known(term, matrix, ["d4", "d2", "d3"])
    edited = tuple(replace(p, sigma=7e-4) if p.name == "d2" else p for p in own.parameters)
    L = covariance.root([replace(own, parameters=edited)])
    whole = L @ L.T
    assert whole[1, 1] == pytest.approx(49e-8) and not whole[1, [0, 2, 3, 4, 5]].any()
    np.testing.assert_allclose(whole[np.ix_([3, 2], [3, 2])], matrix[np.ix_([0, 2], [0, 2])], rtol=1e-9)


def test_parameters_of_another_run_are_kept_beside_those_that_are_fitted(term, matrix):
    own, covariance = known(term, matrix, ["d4", "d2", "d3"])
    assert kept_root([own], covariance).shape == (6, 0)
    own = replace(own, parameters=tuple(replace(p, kept=p.name in ("d2", "d3", "d4")) for p in own.parameters))
    root = kept_root([own], covariance)
    fitted = np.array([False, False, False, False, True, False])
    model = Model(np.eye(4), (own,))
    both = with_fitted_effects(model, fitted, np.array([[4e-10]]), root, np.zeros((6, 7))).effects_covariance
    assert both.names == tuple(f"joint_offset.d{i}" for i in (2, 3, 4, 5))
    at = [both.names.index(f"joint_offset.{n}") for n in ("d4", "d2", "d3")]
    np.testing.assert_allclose(both.matrix[np.ix_(at, at)], matrix, rtol=1e-9, atol=1e-22)
    assert both.matrix[3, 3] == pytest.approx(4e-10)


def test_lengths_of_the_matrix_follow_the_unit():
    rows = EFFECTS["link_geometry"].parameters(2, (), "mm")
    lengths, angles = (next(p for p in rows if p.unit == unit) for unit in ("mm", "rad"))
    names = tuple(f"link_geometry.{p.name}" for p in (lengths, angles))
    file = ModelFile("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6), {"link_geometry": {p.name: p for p in rows}})
    file = replace(file, effects_covariance=EffectsCovariance(names, np.array([[4.0, 0.2], [0.2, 1.0]])))
    np.testing.assert_allclose(convert_unit(file, "m").effects_covariance.matrix, [[4e-6, 2e-4], [2e-4, 1.0]])


def without(session, *columns):
    """The session without some covariates."""
    views = [replace(v, covariates={k: x for k, x in v.covariates.items() if k not in columns}) for v in session.views]
    return replace(session, views=tuple(views))


def massless(session):
    return replace(session, robot=replace(session.robot, mass=np.zeros(6), payload_mass=0.0))


def wrist_only(session):
    """The session as if joints 1 to 3 had stood still."""
    first = session.views[0].joints[:3]
    views = [replace(v, joints=np.concatenate([first, v.joints[3:]])) for v in session.views]
    return replace(session, views=tuple(views))


@pytest.fixture(scope="module")
def placed_session(still_cells):
    """A session with its scans made ready once; what tests change of it the scans do not know."""
    session = session_of(still_cells["eye_to_hand"])
    return session, prepare_capture(session)


def fitted(measurement, name):
    """A model in which every parameter of an effect has a value and a sigma of its own."""
    size = len(parameters_in(measurement, EFFECTS[name]))
    values, sigmas = np.arange(1.0, size + 1) * 1e-6, np.arange(1.0, size + 1) * 1e-8
    term = term_of(measurement, EFFECTS[name]).at(values, sigmas)
    stated = {name: {p.name: p for p in term.parameters}}
    return ModelFile("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6), stated), values, sigmas


def test_compliances_of_an_arm_without_masses_mean_the_same_in_every_session(placed_session):
    """Fitted on views that move all joints, used on views that move the wrist alone: every coefficient still bends."""
    session, own = placed_session
    full, wrist = (measurement_of(s, own) for s in (massless(session), wrist_only(massless(session))))
    model, values, sigmas = fitted(full, "joint_compliance")
    (term,) = bind_to_session(model, wrist).terms
    np.testing.assert_array_equal(term.values, values)
    np.testing.assert_array_equal(term.sigmas, sigmas)
    assert {f.unit for f in model.effects["joint_compliance"].values()} == {"kg rad/(N m)"}
    unit, bent = unit_torques(wrist.robot, wrist.views.joints), np.zeros(wrist.views.joints.shape)
    for name, f in model.effects["joint_compliance"].items():
        joint, link = (int(number) - 1 for number in name[1:].split("_"))
        bent[:, joint] += f.value * unit[:, joint, link]
    np.testing.assert_allclose(wrist.views.sag(term.values), bent, rtol=1e-12)


def test_parameters_of_a_model_are_never_dropped_or_read_in_another_unit(placed_session):
    session, own = placed_session
    with_masses, bare = (measurement_of(s, own) for s in (session, massless(session)))
    for there, here in ((with_masses, bare), (bare, with_masses)):
        with pytest.raises(InputError, match="the model's joint_compliance has c.*link masses") as error:
            bind_to_session(fitted(there, "joint_compliance")[0], here)
        assert "\n" not in str(error.value)
    for name, column in (("part_growth", "part_temperature_c"), ("robot_thermal_growth", "robot_temperature_c")):
        warm, timed = with_masses, measurement_of(without(session, column), own)
        assert all(p.unit.endswith("/°C") for p in parameters_in(warm, EFFECTS[name]))
        assert all(p.unit.endswith("/h") for p in parameters_in(timed, EFFECTS[name]))
        for there, here in ((warm, timed), (timed, warm)):
            bind_to_session(fitted(there, name)[0], there)
            with pytest.raises(InputError, match=f"{name}.g is in '1/(h|°C)'.*{column}"):
                bind_to_session(fitted(there, name)[0], here)


def test_sessions_of_a_rig_have_the_same_parameters_or_are_refused(placed_session):
    session, own = placed_session
    bare = massless(session)
    require_effects([measurement_of(s, own) for s in (bare, wrist_only(bare))], ["joint_compliance"])
    for others, effect, told in (
        ((session, bare), "joint_compliance", r"do not share c1 \(rad/\(N m\)\)"),
        ((session, without(session, "part_temperature_c")), "part_growth", r"do not share .*g \(1/h\)"),
        ((session, without(session, "scanner_temperature_c")), "scanner_thermal_scale", "scanner_temperature_c.*other"),
    ):
        rig = [others[0], replace(others[1], name="other")]
        with pytest.raises(InputError, match=told):
            run_rig(rig, effects=[effect])
        with pytest.raises(InputError, match=told):
            run_rig(rig, fitted(measurement_of(session, own), effect)[0])


def test_a_scan_does_not_count_twice(placed_session):
    session, _ = placed_session
    with pytest.raises(InputError, match="the scan of view v000 is that of view v000"):
        run_rig([session, replace(session, name="other")])


@pytest.mark.parametrize(("old", "new", "expected"), [
    ('length_unit = "mm"', 'length_unit = "cm"', "length_unit is 'cm'"), ('length_unit = "mm"\n', "", "length_unit is None"),
    ("^", "effects_file = 5\n", "effects_file is 5"),
])  # fmt: skip
def test_a_model_that_was_edited_wrongly_is_refused(tmp_path, old, new, expected):
    file = tmp_path / "model.toml"
    write_model(ModelFile("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6)), file)
    edit(file, old, new)
    with pytest.raises(InputError, match=f"model.toml: {expected}; "):
        read_model(file)


@pytest.mark.parametrize("at, value", [((4, 4), -1e-2), ((3, 5), 2e-2), ((0, 1), -3e-8)])
@pytest.mark.parametrize("mirrored", [True, False])
def test_a_covariance_that_is_none_is_refused_in_a_line(tmp_path, at, value, mirrored):
    covariance = np.diag([1e-8] * 3 + [1e-2] * 3)
    file = tmp_path / "model.toml"
    write_model(ModelFile("mm", "eye_in_hand", np.eye(4), np.eye(4), covariance), file)
    assert np.array_equal(read_model(file).covariance, covariance)
    covariance[at] = value
    if mirrored:
        covariance[at[::-1]] = value
    with np.errstate(invalid="ignore"):
        write_model(ModelFile("mm", "eye_in_hand", np.eye(4), np.eye(4), covariance), file)
    with pytest.raises(InputError, match=r"hand_eye.covariance is not symmetric, or negative") as refused:
        read_model(file)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("value", "sigma"), [("1e-4", "-1e-5"), ("nan", "1e-5"), ("1e-4", "inf")])
def test_a_number_of_an_effect_that_cannot_be_is_refused_in_a_line(tmp_path, value, sigma):
    file = tmp_path / "model.toml"
    write_model(ModelFile("mm", "eye_in_hand", np.eye(4), np.eye(4), np.eye(6)), file)
    table = f'\n[effects.joint_offset.o1]\nvalue = {value}\nsigma = {sigma}\nunit = "rad"\n'
    text = file.read_text("utf-8").replace("\n[effects]\n", "\n")
    file.write_text(text + table, "utf-8")
    with pytest.raises(InputError, match=r"effects\.joint_offset\.o1 is .*; to fix: copy that of the run"):
        read_model(file)


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_without_effects_of_base_arm_or_mount_there_is_no_other(mount):
    fitted = run(labelled_cell(3, 20, mount)[0], effects=["part_slip"])
    assert hand_eye_alone(fitted.measurement, fitted.model) is None


def test_a_bracket_that_droops_alike_in_all_views_is_in_the_hand_eye():
    """The mean twist of the views, written out: g less z of each, times what the bracket gives way by."""
    joints = joints_of(np.random.default_rng(5), 30)
    turned = np.array([flange(q)[:3, :3].T @ [0, 0, -1.0] for q in joints]) - [0, 0, 1.0]
    lever, sideways = np.array([2e-3, -3e-3, 4e-3]), 1.5
    moved = np.hstack([np.cross(lever, turned), sideways * turned * [1, 1, 0]])
    session, T_mount, _ = labelled_cell(5, 30, "eye_in_hand", errors=(np.zeros((30, 6)), moved))
    with_it = run(session, effects=["mount_droop"])
    alone = hand_eye_alone(with_it.measurement, with_it.model)
    expected = frames.exp(moved.mean(axis=0)) @ T_mount
    middle = np.mean([view.sighting.points.mean(axis=0) for view in session.views], axis=0)[None]

    def apart(T, other):
        return float(np.linalg.norm(frames.transform(T, middle) - frames.transform(other, middle)))

    assert apart(with_it.T_mount, expected) > 0.2
    assert apart(alone.T_mount, expected) < 0.15 * apart(with_it.T_mount, expected)
    assert alone.displacement == pytest.approx(apart(alone.T_mount, with_it.T_mount), rel=1e-6)
    spread = [apart(frames.exp(twist) @ T_mount, expected) for twist in moved]
    assert alone.spread == pytest.approx(np.sqrt(np.mean(np.square(spread))), rel=0.2)
    # Its U is no smaller than what single views differ by.
    lever = np.hstack([-frames.skew(middle[0]), np.eye(3)])
    assert np.trace(lever @ alone.covariance @ lever.T) >= alone.spread**2


def test_a_step_of_the_mount_counts_as_it_ended():
    session, *_ = labelled_cell(6, 24)
    fitted = run(session, effects=["mount_step"])
    (step,) = fitted.terms
    values = np.where([p.discrete for p in step.parameters], 12.0, np.append(SHIFT, 0.0))
    model = fitted.model.with_terms([step.at(values)])
    alone = hand_eye_alone(fitted.measurement, model)
    np.testing.assert_allclose(alone.T_mount, fitted.T_mount @ frames.exp(SHIFT), atol=1e-9)
    assert alone.spread == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def sessions():
    """A session in which the part slips before a view, and a later one of the same cell."""
    turn = Rotation.from_rotvec(SLIP[0]).as_matrix()
    slipped = (TARGETS + TABLE) @ turn.T + SLIP[1] - TABLE
    before, after = (labelled_cell(7, 80, "eye_in_hand", targets=places)[0] for places in (TARGETS, slipped))
    views = before.views[:SLIPPED_AT] + after.views[SLIPPED_AT:]
    return replace(before, views=views[:OTHER_SESSION]), replace(before, views=views[OTHER_SESSION:])


def test_a_slip_stays_in_its_session_and_the_targets_stand_where_they_ended(sessions):
    first, later = sessions
    file = model_of(run(first, effects=["part_slip"]))
    assert "part_slip" in file.effects
    handed_on = without_events(file)
    assert handed_on.effects == {} and handed_on.T_mount is file.T_mount
    again = run(later, file)
    assert again.model.terms == ()
    noise = run(later).fit.stages[-1].rms
    assert again.fit.stages[0].rms < 3 * noise + 0.05


def test_after_a_step_of_the_mount_another_session_finds_the_scanner_where_it_ended():
    xi = np.array([1e-3, -2e-3, 5e-4, 0.3, -0.2, 0.1])
    still = labelled_cell(8, 30)[0]
    moved = [
        replace(v, sighting=replace(v.sighting, points=_in_moved_scanner(v.sighting.points, xi))) for v in still.views
    ]
    stepped = replace(still, views=(*still.views[:15], *moved[15:]))
    handed_on = without_events(model_of(run(stepped, effects=["mount_step"])))
    assert handed_on.effects == {}
    ended = run(replace(still, views=tuple(moved))).T_mount
    off = np.linalg.inv(ended) @ handed_on.T_mount
    assert np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec()) < 1e-4


def _in_moved_scanner(points, xi):
    turn = Rotation.from_rotvec(xi[:3]).as_matrix()
    return (points - xi[3:]) @ turn


def test_of_the_arm_nothing_is_handed_on_that_began_at_a_view(sessions):
    assert arm_model(model_of(run(sessions[0], effects=["part_slip"]))) is None


def chain_for(measured):
    session = session_of(measured)
    return measurement_of(session, prepare_capture(session))


MOVING = [n for n, e in EFFECTS.items() if e.place in ("base", "robot", "links", "mount", "part")]


# What the arm must carry to give way under its weight; the base stands left of the hand-eye on either.
CARRIED = ("mount_droop", "mount_bend")


@pytest.mark.parametrize(
    ("name", "mount"),
    [
        *((n, "eye_to_hand") for n in MOVING if n not in CARRIED),
        *((n, "eye_in_hand") for n in (*CARRIED, "base_compliance")),
    ],
)
def test_twists_are_the_derivative_of_the_poses(still_cells, name, mount):
    """Central differences of half the size about the same place, by another route: a point carried along."""
    measurement = with_part_origin(chain_for(still_cells[mount]), still_cells[mount].T_mount)
    effect = EFFECTS[name]
    if missing_need(measurement, effect):
        pytest.skip(f"needs {missing_need(measurement, effect)}")
    parameters = parameters_in(measurement, effect)
    # A twist that is zero hides its time constant: begin where it is not.
    values = np.array([p.grid[0] if p.grid else 0.3 * p.typical for p in parameters])
    T = still_cells[mount].T_mount
    centre = np.array([5.0, -3.0, 80.0])
    (slopes,) = pose_derivatives(measurement, Model(T), [term_of(measurement, effect).at(values)], centre)
    point = np.array([10.0, 20.0, 120.0])
    for i, parameter in enumerate(parameters):
        if parameter.discrete:
            assert not slopes[i].any()
            continue
        h = (0.001 if parameter.grid else 0.01) * parameter.typical
        carried = []
        for sign in (1, -1):
            left, right = perturbed_frames(
                measurement, [term_of(measurement, effect).at(values + sign * h * np.eye(len(values))[i])]
            )
            left0, right0 = perturbed_frames(measurement, [term_of(measurement, effect).at(values)])
            carried.append(frames.transform(left @ T @ right @ frames.inverse(left0 @ T @ right0), point[None])[:, 0])
        expected = (carried[0] - carried[1]) / (2 * h)
        predicted = slopes[i][:, 3:] + np.cross(slopes[i][:, :3], point - centre)
        # At the plausible size, within two parts in a thousand and a nanometre.
        off = np.abs(predicted - expected).max() * parameter.typical
        assert off < 2e-3 * np.abs(expected).max() * parameter.typical + 1e-6


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.place in ("sensor", "shape")])
def test_point_slopes_are_minus_what_nature_does(still_cells, name):
    """To first order the correction is the negative of the effect itself."""
    measured = still_cells["eye_to_hand"]
    measurement = chain_for(measured)
    effect = EFFECTS[name]
    pose = measured.T_reference_scanner[2]
    index = np.arange(0, 200, 7)
    zero = Term(effect, parameters_in(measurement, effect))
    slopes = PointSlopes(measurement, [zero], Model(np.eye(4))).at(2, pose, index)
    view = measurement.scan_views[2]
    view = replace(view, cosine=view.cosine[index], intensity=view.intensity[index])
    points = measurement.capture.scans[2].points[index]
    at = frames.transform(pose, points) if effect.place == "shape" else points
    for i, parameter in enumerate(parameters_in(measurement, effect)):
        h = 1e-3 * parameter.typical
        values = h * np.eye(len(slopes))[i]
        moved = (effect.function(at, view, **zero.at(values).arguments) - at) / h
        expected = -frames.rotate(frames.inverse(pose), moved) if effect.place == "shape" else -moved
        assert np.allclose(slopes[i], expected, rtol=1e-2, atol=1e-6 * np.abs(expected).max())
