"""What may be asked of a session follows its sensor."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.effects.contract import EFFECTS, missing_need, require_available
from stitch.errors import InputError
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of, sensor_kind
from stitch.session.notes import sensor_note
from stitch.session.session import Sighting

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


def test_what_shows_points_beside_and_behind_itself_has_no_lens():
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
