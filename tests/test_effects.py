"""Effects of the model against nature's laws, which share no code with them, and against finite differences."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import measured_blade
from in_memory import session_of

from stitch import frames
from stitch.cli.main import main
from stitch.effects import EFFECTS
from stitch.effects.user_file import load
from stitch.errors import InputError
from stitch.measurement.capture import capture
from stitch.measurement.measurement import Term, measurement_of
from stitch.measurement.robot import forward, forward_with_errors, unit_torques
from stitch.model.forward import corrected, placed
from stitch.model.jacobian import shifts, twists
from stitch.model.model_toml import Model
from stitch.model.terms import fitted_of, known, require, sigmas_of, terms_of
from stitch.pipeline import run_rig
from stitch.stages.rig import require_effects

# Amplitude 1 is a tenth of a millimetre; a hundredth of that must remain: second-order terms are smaller still.
_LEFT = 0.03


@pytest.fixture(scope="module")
def cells():
    """Per mount a cell with nothing wrong and perfect poses, and its chain."""
    out = {}
    for mount in ("eye_to_hand", "eye_in_hand"):
        measured = measured_blade(0, views=4, mount=mount, repeatability=(0.0, 0.0), pixels=40)
        out[mount] = measured
    return out


def chain_for(measured):
    session = session_of(measured)
    return measurement_of(session, capture(session))


def hidden(name, mount):
    return measured_blade(0, views=4, mount=mount, repeatability=(0.0, 0.0), pixels=40, hidden={name: 1.0}, noise=0.0)


RIGID = [
    "mount_drift", "mount_warmup", "joint_offset", "link_geometry", "joint_compliance", "gear_eccentricity",
    "gear_harmonic", "backlash", "settling", "robot_thermal_growth",
]  # fmt: skip


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("name", RIGID)
def test_undoing_an_effect_gives_natures_poses(cells, name, mount):
    """The model with nature's own parameters places every view where it truly was."""
    measured = hidden(name, mount)
    measurement = chain_for(measured)
    told = measured.hidden[name]
    effect = EFFECTS[name]
    values = np.array([told.get(p.name, 0.0) for p in measurement.parameters(effect)])
    left, right = placed(measurement, [Term(effect, values)])
    poses = left @ measured.T_mount @ right
    plain, still = placed(measurement, [])
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
    values = np.array([bent.hidden[name][p.name] for p in measurement.parameters(effect)])
    mended = corrected(measurement, [Term(effect, values)], bent.T_mount)
    for scan, true, wrong in zip(mended.scans, plain.clouds, bent.clouds, strict=True):
        before = np.abs(wrong.points - true.points).max()
        assert np.abs(scan.points - true.points).max() <= _LEFT * before + 1e-9


def hidden_pair(name, mount):
    common = {"views": 3, "mount": mount, "repeatability": (0.0, 0.0), "pixels": 50}
    return measured_blade(2, **common), measured_blade(2, hidden={name: 1.0}, **common)


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.place in ("robot", "links", "mount", "part")])
def test_twists_are_the_derivative_of_the_poses(cells, name):
    """Central differences of half the size about the same place, by another route: a point carried along."""
    measurement = chain_for(cells["eye_to_hand"])
    effect = EFFECTS[name]
    if measurement.lacks(effect):
        pytest.skip(f"needs {measurement.lacks(effect)}")
    parameters = measurement.parameters(effect)
    # A twist that is zero hides its time constant: begin where it is not.
    values = np.array([p.grid[0] if p.grid else 0.3 * p.typical for p in parameters])
    T = cells["eye_to_hand"].T_mount
    centre = np.array([5.0, -3.0, 80.0])
    slopes = twists(measurement, [], Term(effect, values), T, centre)
    point = np.array([10.0, 20.0, 120.0])
    for i, parameter in enumerate(parameters):
        if parameter.discrete:
            assert not slopes[i].any()
            continue
        h = (0.001 if parameter.grid else 0.01) * parameter.typical
        carried = []
        for sign in (1, -1):
            left, right = placed(measurement, [Term(effect, values + sign * h * np.eye(len(values))[i])])
            left0, right0 = placed(measurement, [Term(effect, values)])
            carried.append(frames.transform(left @ T @ right @ frames.inverse(left0 @ T @ right0), point[None])[:, 0])
        expected = (carried[0] - carried[1]) / (2 * h)
        predicted = slopes[i][:, 3:] + np.cross(slopes[i][:, :3], point - centre)
        # At the plausible size, within two parts in a thousand and a nanometre.
        off = np.abs(predicted - expected).max() * parameter.typical
        assert off < 2e-3 * np.abs(expected).max() * parameter.typical + 1e-6


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.place in ("sensor", "shape")])
def test_point_slopes_are_minus_what_nature_does(cells, name):
    """To first order the correction is the negative of the effect itself."""
    measured = cells["eye_to_hand"]
    measurement = chain_for(measured)
    effect = EFFECTS[name]
    pose = measured.T_reference_scanner[2]
    index = np.arange(0, 200, 7)
    slopes = shifts(measurement, [], Term(effect, np.zeros(len(measurement.parameters(effect)))), 2, pose, index)
    view = measurement.scan_views[2]
    view = replace(view, cosine=view.cosine[index], intensity=view.intensity[index])
    points = measurement.capture.scans[2].points[index]
    at = frames.transform(pose, points) if effect.place == "shape" else points
    for i, parameter in enumerate(measurement.parameters(effect)):
        h = 1e-3 * parameter.typical
        values = h * np.eye(len(slopes))[i]
        moved = (effect.function(at, view, **measurement.arguments(effect, values)) - at) / h
        expected = -frames.rotate(frames.inverse(pose), moved) if effect.place == "shape" else -moved
        assert np.allclose(slopes[i], expected, rtol=1e-2, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_wrong_rows_are_another_arm(convention):
    """Errors of DH rows give the same pose as an arm built with those rows."""
    from stitch.reading.dh_rows import robot_from_dh

    rng = np.random.default_rng(0)
    rows = [{"a": float(rng.uniform(0, 400)), "alpha_deg": float(rng.uniform(-90, 90)), "d": float(rng.uniform(0, 300)),
                 "theta_deg": 10.0} for _ in range(6)]  # fmt: skip
    da, dd, dalpha = rng.normal(0, 0.3, 6), rng.normal(0, 0.3, 6), rng.normal(0, 1e-3, 6)
    other = [dict(r, a=1.001 * (r["a"] + da[i]), d=1.001 * (r["d"] + dd[i]), alpha_deg=r["alpha_deg"] + np.degrees(dalpha[i]))
             for i, r in enumerate(rows)]  # fmt: skip
    gravity = np.array([0, 0, -9.81])
    arm, wrong = (robot_from_dh("x", convention, r, None, gravity, "mm") for r in (rows, other))
    q = rng.uniform(-2, 2, (7, 6))
    assert np.allclose(forward_with_errors(arm, q, np.full(7, 1.001), da, dd, dalpha), forward(wrong, q), atol=1e-9)


def test_parameters_are_in_the_unit_of_the_session():
    effect = EFFECTS["mount_drift"]
    mm, m = (effect.parameters(6, (), unit) for unit in ("mm", "m"))
    assert [p.unit for p in mm] == ["rad/h"] * 3 + ["mm/h"] * 3
    assert m[3].unit == "m/h"
    assert m[3].typical == pytest.approx(mm[3].typical / 1000)
    kappa = EFFECTS["part_sag"].parameters(6, (), "m")[0]
    assert kappa.unit == "1/m"
    assert kappa.typical == pytest.approx(1000 * EFFECTS["part_sag"].parameters(6, (), "mm")[0].typical)


USER = '''
from stitch.effects import effect, number

@effect("sensor", needs=["humidity_percent"], k=number("mm", typical=0.02, limit=1.0))
def humidity_bias(points, view, k):
    """x = x* + u·k·(humidity − first humidity)"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
'''


def test_a_users_effect_takes_its_place(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(USER)
    try:
        assert load(file) == ["humidity_bias"]
        assert EFFECTS["humidity_bias"].tier == "user"
        assert EFFECTS["humidity_bias"].formula.startswith("x = x*")
        assert load(file) == ["humidity_bias"]  # a second time is no conflict with itself
    finally:
        EFFECTS.pop("humidity_bias", None)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x = 1 +\n", "line 1"),
        ("from stitch.effects import effect, number\nraise ValueError('no')\n", "line 2"),
        ("x = 1\n", "no effect in it"),
        (USER.replace("humidity_bias", "range_scale"), "in the library already"),
        (USER.replace('"sensor"', '"elbow"'), "places are"),
    ],
)
def test_a_bad_effects_file_is_one_line(tmp_path, text, expected):
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(InputError, match=expected) as error:
        load(file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)


def test_what_goes_wrong_in_an_effect_of_ones_own_is_one_line(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(USER.replace("    return ", "    raise KeyError('dust')\n    return "))
    try:
        (name,) = load(file)
        with pytest.raises(InputError, match=rf"mine.py line \d+: effect {name}: KeyError: 'dust'") as error:
            EFFECTS[name].function(np.zeros((2, 3)), None, 0.1)
    finally:
        del EFFECTS["humidity_bias"]
    assert "\n" not in str(error.value)


def test_effects_as_json(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["effects", "part_slip", "--json"])
    assert not ended.value.code
    (told,) = json.loads(capsys.readouterr().out)
    assert told["effect"] == "part_slip" and [p["unit"] for p in told["parameters"]] == ["rad", "view"]


def test_unknown_and_impossible_effects_are_refused(cells):
    with pytest.raises(InputError, match="no effect 'elbow'"):
        known("elbow")
    with pytest.raises(InputError, match="velocity_deg_s"):
        require(chain_for(cells["eye_to_hand"]), EFFECTS["latency"])


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
def placed_session(cells):
    """A session with its scans made ready once; what tests change of it the scans do not know."""
    session = session_of(cells["eye_to_hand"])
    return session, capture(session)


def fitted(measurement, name):
    """A model in which every parameter of an effect has a value and a sigma of its own."""
    size = len(measurement.parameters(EFFECTS[name]))
    values, sigmas = np.arange(1.0, size + 1) * 1e-6, np.arange(1.0, size + 1) * 1e-8
    told = fitted_of(measurement, [Term(EFFECTS[name], values)], [sigmas])
    return Model("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6), told), values, sigmas


def test_compliances_of_an_arm_without_masses_mean_the_same_in_every_session(placed_session):
    """Fitted on views that move all joints, used on views that move the wrist alone: every coefficient still bends."""
    session, own = placed_session
    full, wrist = (measurement_of(s, own) for s in (massless(session), wrist_only(massless(session))))
    model, values, sigmas = fitted(full, "joint_compliance")
    (term,) = terms_of(model, wrist)
    np.testing.assert_array_equal(term.values, values)
    np.testing.assert_array_equal(sigmas_of(model, wrist)[0], sigmas)
    assert {f.unit for f in model.effects["joint_compliance"].values()} == {"kg rad/(N m)"}
    unit, bent = unit_torques(wrist.robot, wrist.views.joints), np.zeros(wrist.views.joints.shape)
    for name, f in model.effects["joint_compliance"].items():
        joint, link = (int(number) - 1 for number in name[1:].split("_"))
        bent[:, joint] += f.value * unit[:, joint, link]
    np.testing.assert_allclose(wrist.views.sag(term.values), bent, rtol=1e-12)


def test_what_a_model_knows_is_never_dropped_or_read_in_another_unit(placed_session):
    session, own = placed_session
    with_masses, bare = (measurement_of(s, own) for s in (session, massless(session)))
    for there, here in ((with_masses, bare), (bare, with_masses)):
        with pytest.raises(InputError, match="the model's joint_compliance has c.*link masses") as error:
            terms_of(fitted(there, "joint_compliance")[0], here)
        assert "\n" not in str(error.value)
    for name, column in (("part_growth", "part_temperature_c"), ("robot_thermal_growth", "robot_temperature_c")):
        warm, timed = with_masses, measurement_of(without(session, column), own)
        assert all(p.unit.endswith("/°C") for p in warm.parameters(EFFECTS[name]))
        assert all(p.unit.endswith("/h") for p in timed.parameters(EFFECTS[name]))
        for there, here in ((warm, timed), (timed, warm)):
            terms_of(fitted(there, name)[0], there)
            with pytest.raises(InputError, match=f"{name}.g is in '1/(h|°C)'.*{column}"):
                terms_of(fitted(there, name)[0], here)


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
