"""Parameters of effects: units, and effects that a session cannot have."""

from dataclasses import replace

import pytest

from data_synth.fixtures.in_memory import session_of
from stitch.effects import EFFECTS
from stitch.effects.contract import find_effect, parameters_in, require_available
from stitch.errors import InputError
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of


def chain_for(measured):
    session = session_of(measured)
    return measurement_of(session, prepare_capture(session))


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
