"""A fitted model in another session: parameters mean the same there, or it is refused."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import require_effects, run_rig
from stitch.effects import EFFECTS
from stitch.effects.contract import parameters_in
from stitch.errors import InputError
from stitch.model.model import term_of
from stitch.model.model_toml import ModelFile, bind_to_session
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.robot import unit_torques


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


def test_what_a_model_knows_is_never_dropped_or_read_in_another_unit(placed_session):
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
